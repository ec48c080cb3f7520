"""One thing is one object, one instance is found once, and turns of a symmetric shape are one pose."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from builders.detections import ellipsoid, place

from ipjax.detection.assignment import Claim, assign, overlap, same_instance, sample_surface, shared_share
from ipjax.detection.records import Reason
from ipjax.inference.batching import pad_alike
from ipjax.records import Similarity


def square(left: int, right: int) -> np.ndarray:
    mask = np.zeros((20, 60), bool)
    mask[:, left:right] = True
    return mask


def claim(index: int, mask: np.ndarray, confidence: float, x: float) -> Claim:
    return Claim(index, f"object {index}", mask, place(x, 0.0), confidence, confidence)


def test_the_surest_claim_of_a_place_holds():
    templates = [ellipsoid()[0]] * 2
    claims = [
        claim(0, square(0, 10), 0.6, -0.4),
        claim(1, square(0, 9), 0.9, -0.4),  # the same place, surer
        claim(0, square(30, 40), 0.5, 0.4),
        claim(0, square(31, 40), 0.4, 0.41),  # the same instance once more
        claim(1, square(44, 60), 0.3, 0.9),  # a second instance, of one that is wanted once
    ]
    kept, dropped = assign(claims, templates, instances=1, taken=0.5, apart=0.1)
    assert [(one.index, one.confidence) for one in kept] == [(1, 0.9), (0, 0.5)]
    told = {one.confidence: verdict for one, verdict in dropped}
    assert told[0.6].why is Reason.CLAIMED and "taken by object 1" in told[0.6].words
    assert told[0.4].why is Reason.SAME_MASK and "same instance" in told[0.4].words
    assert told[0.3].why is Reason.ENOUGH and "1 surer instance was" in told[0.3].words
    rivals = {one: verdict.rival for one, verdict in told.items()}
    assert [(one.index, one.confidence) for one in rivals.values() if one] == [(1, 0.9), (0, 0.5), (1, 0.9)]
    kept, _ = assign(claims, templates, instances=3, taken=0.5, apart=0.1)
    assert len(kept) == 3
    # The order in which they come does not matter.
    assert [id(one) for one in assign(claims[::-1], templates, instances=3, taken=0.5, apart=0.1)[0]] == [
        id(one) for one in kept
    ]


def test_turns_after_which_a_shape_looks_the_same_are_one_instance():
    templates, pose = ellipsoid()[0], place(0.0, 0.0)
    half = jnp.asarray(np.diag([-1.0, -1.0, 1.0]), jnp.float32)
    turned = dataclasses.replace(pose, rotation=pose.rotation @ half)
    assert same_instance(templates, pose, turned, 0.1)
    moved = Similarity(pose.rotation, pose.translation + jnp.array([0.9 * 0.2, 0.0, 0.0]), pose.scale)
    assert not same_instance(templates, pose, moved, 0.1)
    assert jax.tree.all(jax.tree.map(np.array_equal, pose, place(0.0, 0.0)))


def test_one_place_under_two_masks_is_one_instance():
    """Where the masks do not overlap, the poses tell."""
    claims = [claim(0, square(0, 10), 0.9, 0.0), claim(0, square(30, 40), 0.8, 0.001)]
    kept, dropped = assign(claims, [ellipsoid()[0]], instances=2, taken=0.5, apart=0.1)
    assert [one.confidence for one in kept] == [0.9]
    assert [verdict.why for _, verdict in dropped] == [Reason.SAME_PLACE]


def test_padding_is_no_surface():
    templates = ellipsoid()[0]
    few = eqx.tree_at(lambda t: t.surface, templates, jax.tree.map(lambda x: x[:300], templates.surface))
    padded = pad_alike([few, templates])[0]
    assert padded.surface.points.shape == templates.surface.points.shape
    np.testing.assert_array_equal(sample_surface(padded), sample_surface(few))


def test_shares_of_masks():
    assert shared_share(square(0, 10), square(5, 30)) == 0.5
    assert overlap(square(0, 10), square(5, 15)) == 5 / 15
    assert shared_share(square(0, 0), square(0, 10)) == overlap(square(0, 0), square(0, 0)) == 0
