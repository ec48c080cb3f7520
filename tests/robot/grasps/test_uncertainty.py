"""Poses within the uncertainty: their spread is that of the estimate, and alternatives are among them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from builders.graspable import estimate_of, from_above

from ipjax.records import Hypotheses
from ipjax.robot.grasps.uncertainty import deviation_along, sample_poses
from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation

COUNT = 4000
sample = jax.jit(lambda e: sample_poses(e, jax.random.key(0), count=COUNT))


def make_covariance(seed=0):
    part = np.random.default_rng(seed).normal(size=(6, 6)) * [[0.01]] * 3 + 0
    return part @ part.T


def test_the_spread_is_the_covariance_in_the_objects_axes():
    pose = from_above(0.2)
    known = make_covariance()
    estimate = dataclasses.replace(
        estimate_of(pose, size_std=0.004), covariance=jnp.asarray(known, jnp.float32), ambiguity=jnp.zeros(3)
    )
    found = sample(estimate)
    turned = np.asarray(vector_from_rotation(found.rotation))
    steps = np.concatenate([turned, np.asarray(found.translation)], axis=-1)
    # camera_from_object turns about x by half a turn: y and z change their signs.
    signs = np.array([1.0, -1, -1, 1, -1, -1])
    expected = known * signs * signs[:, None]
    spread = steps.T @ steps / COUNT
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((spread - expected) / scale).max() < 0.08  # 1 / √4000 = 0.016
    assert np.abs(steps.mean(0) / np.sqrt(np.diag(expected))).max() < 0.06
    growth = np.log(np.asarray(found.scale))
    np.testing.assert_allclose(growth.std(), 0.02, rtol=0.05)


def test_ambiguity_that_is_not_explained_is_a_turn_about_its_axis():
    found = sample(estimate_of(from_above(0.2), turn_std=0.01, axis_std=0.5, axis=(0.0, 0.6, 0.8)))
    turned = np.asarray(vector_from_rotation(found.rotation))
    np.testing.assert_allclose((turned @ [0, 0.6, 0.8]).std(), 0.5, rtol=0.05)
    assert (turned @ [1.0, 0, 0]).std() < 0.05
    assert np.asarray(found.translation).std() < 0.002


def test_alternatives_are_drawn_by_their_scores():
    """A box that may be turned by half a turn: it is, or it is not, and nothing between."""
    estimate = estimate_of(from_above(0.2), turn_std=1e-3, axis_std=np.pi / np.sqrt(2))
    pose = estimate.camera_from_object
    half = Similarity(rotation_from_vector(jnp.asarray([0, 0, np.pi], jnp.float32)), jnp.zeros(3), jnp.asarray(1.0))
    many = jax.tree.map(lambda *x: jnp.stack(x), pose, pose @ half, pose @ half)
    for scores, share in (([0.5, 0.5, -1.0], 0.5), ([0.5, 0.1, -1.0], 0.0), ([0.5, 0.475, -1.0], 0.269)):
        equal = dataclasses.replace(estimate, hypotheses=Hypotheses(many, jnp.asarray(scores)))
        if share < 0.4:  # the estimate tells as much ambiguity as its alternatives have
            equal = dataclasses.replace(equal, ambiguity=jnp.asarray([0, 0, np.pi * np.sqrt(share)], jnp.float32))
        turned = np.linalg.norm(np.asarray(vector_from_rotation(sample(equal).rotation)), axis=-1)
        np.testing.assert_allclose((turned > 3).mean(), share, atol=0.03)
        assert ((turned > 3) | (turned < 0.1)).all()


def test_no_uncertainty_moves_nothing():
    found = sample(estimate_of(from_above(0.2), turn_std=0.0, place_std=0.0, size_std=0.0))
    np.testing.assert_allclose(np.asarray(found.rotation), np.broadcast_to(np.eye(3), (COUNT, 3, 3)), atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.translation), 0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.scale), 1)


def test_the_deviation_along_an_axis_is_that_of_the_samples():
    known = make_covariance(1)
    estimate = dataclasses.replace(
        estimate_of(from_above(0.2), size_std=0.0), covariance=jnp.asarray(known, jnp.float32), ambiguity=jnp.zeros(3)
    )
    place, axis = jnp.asarray([[0.03, -0.02, 0.05]]), jnp.asarray([[0.6, 0.0, 0.8]])
    told = float(deviation_along(estimate, place, axis, jnp.asarray([0.04]))[0])
    moved = np.asarray(sample(estimate) @ place[None])[:, 0] - np.asarray(place)
    np.testing.assert_allclose((moved @ np.asarray(axis[0])).std(), told, rtol=0.06)
