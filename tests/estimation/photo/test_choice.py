"""A photo with depth chooses among the poses of its object: what was guessed behind it has no vote."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.measured_photos import photograph
from builders.photo_objects import encoder, estimate, see

from ipjax.config import Config, ScoreConfig
from ipjax.estimation.features import object_features
from ipjax.estimation.photo.choice import judge_by_photo, photo_camera
from ipjax.inference.photos.drawing import reference_from_query
from ipjax.records import Similarity
from ipjax.transforms import rotation_from_vector, vector_from_rotation


def pair(seed, angle):
    """Templates, the query, and the true pose of the object in the query's crop."""
    made, whole = photograph(seed)
    place = whole.camera_from_object.to_numpy()
    query, truth, camera_from_crop = see(seed, place.rotation, angle)
    # The ellipsoid is the same in both frames but for its size.
    larger = truth.scale / place.scale
    record = made.info.reference
    object_from_photo = made.info.object_from_mesh.to_numpy() @ record.camera_from_mesh.to_numpy().inverse()
    in_object = object_from_photo @ Similarity(place.rotation, place.translation, place.scale)
    true = camera_from_crop.inverse() @ truth @ in_object.inverse()
    assert np.isclose(true.scale, larger * made.info.measured_diameter)
    return made, query, true


def test_the_photos_camera_is_that_of_the_pose():
    made, _, true = pair(1, 30)
    reference = made.templates.reference
    wanted = reference_from_query(reference, true.to_jax())
    turn, shift = photo_camera(reference, true.to_jax())
    np.testing.assert_allclose(turn, wanted.rotation, atol=1e-5)
    np.testing.assert_allclose(shift, wanted.translation, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_the_true_pose_is_judged_best(seed):
    """Among turns of it by 20° and more, 45° from the photo."""
    made, query, true = pair(seed, 45)
    templates = made.templates
    query = eqx.tree_at(lambda q: q.patches.features, query, object_features(query.patches.features, templates))
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(12, 3))
    turns = np.deg2rad(rng.uniform(20, 180, (12, 1))) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    rotation = np.stack([true.rotation, *(true.rotation @ rotation_from_vector(turn) for turn in turns)])
    poses = Similarity(rotation, np.tile(true.translation, (13, 1)), np.full(13, true.scale)).to_jax()
    rated, overlap, colour = (
        np.asarray(x) for x in jax.jit(judge_by_photo)(encoder, templates, query, poses, Config())
    )
    assert rated.argmax() == 0
    assert overlap[0] > 0.8 and colour[0] > 0.8
    np.testing.assert_allclose(rated, overlap * np.exp(0.5 * (colour - 1)), rtol=1e-5)


def test_poses_are_chosen_by_the_photo():
    """The way of a user, 30° to 75° from the photo: at least as often right as by the guessed mesh, which has a vote
    where the object has no photo."""
    right = {True: 0, False: 0}
    for seed in range(6):
        made, query, true = pair(seed, 30 + 9 * seed)
        for kept in right:
            reference = made.templates.reference if kept else None
            templates = dataclasses.replace(made.templates, reference=reference)
            found = estimate(encoder, templates, query, jax.random.key(0), Config(), jnp.float32(true.scale))
            assert bool(found.success) and np.isfinite(float(found.confidence))
            off = found.camera_from_object.to_numpy().rotation @ true.rotation.T
            right[kept] += float(np.linalg.norm(vector_from_rotation(off))) < np.deg2rad(15)
            if kept:
                np.testing.assert_allclose(
                    found.hypotheses.score[0],
                    found.agreement.drawn * np.exp(0.5 * (found.agreement.colour - 1)),
                    rtol=1e-4,
                )
    assert right[True] >= 5 and right[True] >= right[False], right


def test_without_drawing_the_photo_is_not_asked():
    made, query, _ = pair(2, 30)
    plain = dataclasses.replace(made.templates, reference=None)
    for used, config in ((None, Config()), (encoder, Config(score=ScoreConfig(drawn=0)))):
        with_photo, without = (
            estimate(used, templates, query, jax.random.key(0), config, None) for templates in (made.templates, plain)
        )
        # Two graphs, which are compiled apart, and so round apart.
        same = lambda a, b: np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-5, atol=1e-6)
        jax.tree.map(same, with_photo, without)
