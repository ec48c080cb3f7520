"""Poses are told in the user's own coordinates, and a failure without numbers that are not."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from builders.estimates import make_estimate
from builders.objects import make_object

from ipjax.inference.reports import estimate_as_json, to_json
from ipjax.records import PoseEstimate, Similarity


def estimate_of(info, rotation, translation, scale) -> PoseEstimate:
    """The estimate that a perfect method would make of a mesh placed by a similarity, told for the object frame."""
    centre = np.asarray(info.mesh_centre)
    pose = Similarity(
        jnp.asarray(rotation, jnp.float32),
        jnp.asarray(scale * rotation @ centre + translation, jnp.float32),
        jnp.asarray(scale / info.mesh_scale, jnp.float32),
    )
    return make_estimate(pose)


def test_the_pose_maps_the_users_mesh_to_camera_metres():
    templates, info = make_object()
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    translation, scale = np.array([0.1, -0.2, 0.9]), 0.03
    told = json.loads(to_json(estimate_as_json(estimate_of(info, rotation, translation, scale), templates, info)))
    pose = told["camera_from_mesh"]
    np.testing.assert_allclose(pose["rotation"], rotation, atol=1e-6)
    np.testing.assert_allclose(pose["translation_m"], translation, atol=1e-6)
    assert pose["scale_m_per_mesh_unit"] == pytest.approx(scale, rel=1e-6)
    points = np.random.default_rng(4).normal(size=(6, 3))
    expected = scale * points @ rotation.T + translation
    full, rigid = np.array(pose["matrix"]), np.array(pose["rigid_matrix"])
    np.testing.assert_allclose(points @ full[:3, :3].T + full[:3, 3], expected, atol=1e-6)
    np.testing.assert_allclose((scale * points) @ rigid[:3, :3].T + rigid[:3, 3], expected, atol=1e-6)
    assert told["size_mm"]["diameter"] == pytest.approx(1e3 * scale / info.mesh_scale, rel=1e-6)
    assert told["residual_rms_mm"] == pytest.approx(4.0) and told["inliers"] == 12
    assert told["present"] and told["size_mm"]["diameter_std"] == pytest.approx(2.0)
    assert np.diag(told["covariance"])[5] == pytest.approx(4e-6) and told["agreement"]["rival"] == pytest.approx(0.6)
    np.testing.assert_allclose(info.object_from_mesh.translation, [-4.0, 8.0, -2.0])


def test_failure_is_told_without_numbers_that_are_not():
    templates, info = make_object()
    good = estimate_of(info, np.eye(3), np.zeros(3), 0.1)
    for bad in (
        dataclasses.replace(good, success=jnp.asarray(False)),
        dataclasses.replace(good, camera_from_object=Similarity(jnp.eye(3) * jnp.nan, jnp.zeros(3), jnp.asarray(1.0))),
    ):
        told = estimate_as_json(bad, templates, info)
        assert told["success"] is False and told["camera_from_mesh"] is None and told["confidence"] == 0
        to_json(told)
