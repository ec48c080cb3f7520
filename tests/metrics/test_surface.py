"""Errors over the surface against BOP's own numbers, and the laws they must obey."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.poses import CAMERA, ERRORS, NONE, OBJECTS, POINTS, TURN, poses, random_pose, rows_of, symmetries_of
from hypothesis import given
from hypothesis import strategies as st

from ipjax import metrics
from ipjax.records import Camera
from ipjax.transforms import Similarity


@pytest.mark.parametrize("number", OBJECTS)
def test_pose_errors_are_bops(number):
    rows, truth, estimate = rows_of(number)
    points = jnp.asarray(ERRORS[f"obj{number}_pts"])
    symmetries = poses(*symmetries_of(number))
    camera, diameter = Camera.from_matrix(ERRORS["K"]), float(ERRORS[f"obj{number}_diameter"])

    def all_errors(truth, estimate):
        return {
            "mssd": metrics.mssd(points, symmetries, truth, estimate),
            "mspd": metrics.mspd(points, symmetries, camera, truth, estimate),
            "add": metrics.add(points, truth, estimate),
            "adi": metrics.add_s(points, truth, estimate, block=64),
            "re": jnp.rad2deg(metrics.rotation_error(truth.rotation, estimate.rotation)),
            "te": metrics.translation_error(truth.translation, estimate.translation),
            "proj": metrics.reprojection_error(points, camera, truth, estimate),
            "overlapping_sphere_projections": metrics.projections_overlap(diameter, truth, estimate),
            "spheres_overlap_3d": metrics.spheres_overlap(diameter, truth, estimate),
        }

    found = jax.jit(jax.vmap(all_errors))(truth, estimate)
    for name in ("mssd", "mspd", "add", "adi", "re", "te", "proj"):
        # 1e-4 relative is the promise; a perfect pose is 0 in BOP's float64 and within rounding of 0 here (mm, px, °).
        np.testing.assert_allclose(found[name], ERRORS[name][rows], rtol=1e-4, atol=2e-4, err_msg=name)
    for name in ("overlapping_sphere_projections", "spheres_overlap_3d"):
        np.testing.assert_array_equal(found[name], ERRORS[name][rows], err_msg=name)


closest = jax.jit(metrics.closest_symmetry, static_argnames="block")


surface_distance = jax.jit(metrics.mssd)


projection_distance = jax.jit(metrics.mspd)


average_distance = jax.jit(metrics.add)


nearest_distance = jax.jit(metrics.add_s)


turned_by = jax.jit(metrics.rotation_error)


reprojected_by = jax.jit(metrics.reprojection_error)


@given(seed=st.integers(0, 1000))
def test_branch_and_bound_equals_trying_everything(seed):
    symmetries = poses(*TURN)
    truth, estimate = random_pose(seed), random_pose(seed + 5000)
    for camera in (None, CAMERA):
        found, index = closest(POINTS, symmetries, truth, estimate, camera=camera)
        everything, _ = closest(POINTS, symmetries, truth, estimate, camera=camera, block=len(TURN[0]))
        np.testing.assert_allclose(found, everything, rtol=2e-5)
        chosen = poses(TURN[0][index][None], np.zeros((1, 3)))
        alone, _ = closest(POINTS, chosen, truth, estimate, camera=camera)
        np.testing.assert_allclose(found, alone, rtol=2e-5)


def test_the_hull_gives_the_same_surface_distance():
    hull = pytest.importorskip("scipy.spatial").ConvexHull(np.asarray(POINTS)).vertices
    symmetries = poses(np.eye(3)[None], np.zeros((1, 3)))
    for seed in range(5):
        pair = random_pose(seed), random_pose(seed + 100)
        whole, part = (metrics.mssd(p, symmetries, *pair) for p in (POINTS, POINTS[hull]))
        np.testing.assert_allclose(part, whole, rtol=1e-6)


@given(seed=st.integers(0, 1000))
def test_a_common_motion_changes_no_surface_error(seed):
    truth, estimate, motion = random_pose(seed), random_pose(seed + 1), random_pose(seed + 2)
    move = lambda pose: Similarity(
        motion.rotation @ pose.rotation, motion.rotation @ pose.translation + motion.translation, pose.scale
    )
    for error in (
        lambda a, b: surface_distance(POINTS, NONE, a, b),
        lambda a, b: average_distance(POINTS, a, b),
        lambda a, b: nearest_distance(POINTS, a, b),
        lambda a, b: turned_by(a.rotation, b.rotation),
    ):
        np.testing.assert_allclose(error(move(truth), move(estimate)), error(truth, estimate), rtol=2e-4, atol=1e-6)


@given(seed=st.integers(0, 1000))
def test_orders_among_the_errors(seed):
    truth, estimate = random_pose(seed), random_pose(seed + 1)
    worst, mean = surface_distance(POINTS, NONE, truth, estimate), average_distance(POINTS, truth, estimate)
    assert nearest_distance(POINTS, truth, estimate) <= mean + 1e-6
    assert mean <= worst + 1e-6
    assert reprojected_by(POINTS, CAMERA, truth, estimate) <= (
        projection_distance(POINTS, NONE, CAMERA, truth, estimate) + 1e-3
    )


def test_a_symmetry_of_the_truth_is_no_error():
    rotations, translations = symmetries_of(4)
    points = jnp.asarray(ERRORS["obj4_pts"])
    symmetries = poses(rotations, translations)
    truth = poses(ERRORS["R_gt"][0], ERRORS["t_gt"][0])
    turned = poses(ERRORS["R_gt"][0] @ rotations[100], ERRORS["R_gt"][0] @ translations[100] + ERRORS["t_gt"][0])
    error, index = metrics.closest_symmetry(points, symmetries, truth, turned)
    assert error < 1e-3  # mm
    assert index == 100
    assert metrics.mspd(points, symmetries, Camera.from_matrix(ERRORS["K"]), truth, turned) < 1e-3


def test_gradients_are_finite_at_a_perfect_pose():
    pose = random_pose(1)
    for error in (
        lambda t: metrics.translation_error(pose.translation, t),
        lambda t: metrics.add(POINTS, pose, Similarity(pose.rotation, t, pose.scale)),
    ):
        assert jnp.all(jnp.isfinite(jax.grad(error)(pose.translation)))


def test_float64_stays_float64(x64):
    points = jnp.asarray(np.asarray(POINTS), jnp.float64)
    pose = poses(np.eye(3), np.array([0, 0, 1.0]), np.float64)
    other = poses(np.eye(3), np.array([0, 1e-9, 1.0]), np.float64)
    error = metrics.mssd(points, poses(np.eye(3)[None], np.zeros((1, 3)), np.float64), pose, other)
    assert error.dtype == jnp.float64
    np.testing.assert_allclose(error, 1e-9, rtol=1e-6)


def test_shapes_are_named():
    script = (
        "import jax.numpy as jnp\nfrom ipjax import metrics\nfrom ipjax.records import *\n"
        "c = Camera(jnp.ones(2), jnp.ones(2)); d = jnp.ones((4, 4))\n"
        "try: metrics.vsd(d, d, c, jnp.ones((4, 5)), diameter=1., delta=1.)\n"
        "except ValueError as e: print(e)\n"
        "p = Similarity(jnp.eye(3), jnp.zeros(3), jnp.ones(()))\n"
        "try: metrics.mssd(jnp.ones((5, 3)), p, p, p)\n"
        "except ValueError as e: print(e)\n"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert "one shape" in said
    assert "symmetries must have 1 leading axis" in said


def test_an_absent_pose_is_no_perfect_one():
    points, truth = jnp.asarray(POINTS), random_pose(0)
    absent = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), truth)
    assert np.isnan(metrics.add(points, truth, absent)) and np.isnan(metrics.surface_distance(points, truth, absent))
    assert np.isnan(metrics.translation_error(truth.translation, absent.translation))
    assert not metrics.spheres_overlap(1.0, truth, absent)


def test_errors_have_a_derivative_where_they_are_nothing():
    points, truth = jnp.asarray(POINTS), random_pose(0)
    for error in (
        lambda pose: metrics.mssd(points, NONE, truth, pose),
        lambda pose: metrics.mspd(points, NONE, CAMERA, truth, pose),
    ):
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(jax.grad(error)(truth)))


def test_many_poses_have_an_error_each_or_are_refused():
    points, truth = np.asarray(POINTS, np.float64), random_pose(0).to_numpy()
    many = jax.tree.map(lambda *x: np.stack(x), truth, random_pose(1).to_numpy())
    found = metrics.add(points, truth, many)
    assert found.shape == (2,) and found[0] == 0 and found[1] == metrics.add(points, truth, random_pose(1).to_numpy())
    with pytest.raises(ValueError, match=r"jax\.vmap"):
        metrics.add_s(points, truth, many)


def test_symmetries_are_searched_from_numpys_arrays_too():
    turns, places = metrics.discretise_symmetries([], [(np.array([0, 0, 1.0]), np.zeros(3))], step=0.1)
    host = Similarity(turns.astype(np.float32), places.astype(np.float32), np.ones(len(turns), np.float32))
    points, one, other = np.asarray(POINTS), random_pose(0), random_pose(1)
    as_numpy = [jax.tree.map(np.asarray, pose) for pose in (one, other)]
    found, _ = metrics.closest_symmetry.__wrapped__(points, host, *as_numpy)
    np.testing.assert_allclose(found, metrics.mssd(jnp.asarray(points), host.to_jax(), one, other), rtol=1e-6)
    with pytest.raises(ValueError, match="one at least"):
        metrics.mssd(jnp.asarray(points), Similarity.identity((0,)), one, other)
