"""Pose errors against BOP's own numbers, and the laws they must obey."""

import json
import subprocess
import sys
from pathlib import Path

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax import metrics
from ipjax.records import Camera, Similarity

GOLDEN = Path(__file__).resolve().parent / "golden"
ERRORS = np.load(GOLDEN / "bop_pose_errors.npz")
VSD = np.load(GOLDEN / "bop_vsd.npz")
OBJECTS = (1, 2, 3, 4)


def poses(rotation, translation, dtype=np.float32) -> Similarity:
    rotation, translation = np.asarray(rotation, dtype), np.asarray(translation, dtype)
    return Similarity(jnp.asarray(rotation), jnp.asarray(translation), jnp.ones(rotation.shape[:-2], dtype))


def symmetries_of(number: int) -> tuple[np.ndarray, np.ndarray]:
    info = json.loads(str(ERRORS[f"obj{number}_info_json"]))
    continuous = [(np.array(s["axis"]), np.array(s["offset"])) for s in info.get("symmetries_continuous", [])]
    discrete = [np.array(s) for s in info.get("symmetries_discrete", [])]
    return metrics.discretise_symmetries(discrete, continuous, float(ERRORS["max_sym_disc_step"]))


def rows_of(number: int) -> tuple[np.ndarray, Similarity, Similarity]:
    rows = np.flatnonzero(ERRORS["obj_id"] == number)
    truth = poses(ERRORS["R_gt"][rows], ERRORS["t_gt"][rows])
    return rows, truth, poses(ERRORS["R_est"][rows], ERRORS["t_est"][rows])


@jax.jit
def random_rotation(key) -> jax.Array:
    q = jax.random.normal(key, (4,))
    w, x, y, z = q / jnp.linalg.norm(q)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def random_pose(seed: int) -> Similarity:
    a, b = jax.random.split(jax.random.key(seed))
    shift = jnp.array([0.0, 0.0, 0.8]) + 0.1 * jax.random.normal(b, (3,))
    return Similarity(random_rotation(a), shift, jnp.ones(()))


POINTS = jax.random.normal(jax.random.key(0), (200, 3)) * 0.05
CAMERA = Camera(jnp.array([600.0, 610.0]), jnp.array([320.0, 240.0]))


@pytest.mark.parametrize("number", OBJECTS)
def test_symmetries_are_bops(number):
    rotations, translations = symmetries_of(number)
    assert len(rotations) == int(ERRORS[f"obj{number}_n_syms"])
    chosen = ERRORS[f"obj{number}_sym_idx"]
    np.testing.assert_allclose(rotations[chosen], ERRORS[f"obj{number}_sym_R"], atol=1e-6)
    np.testing.assert_allclose(translations[chosen], ERRORS[f"obj{number}_sym_t"], atol=1e-5)


def test_symmetries_say_what_is_wrong():
    with pytest.raises(ValueError, match="16 numbers"):
        metrics.discretise_symmetries([np.eye(3)])
    with pytest.raises(ValueError, match="length 0"):
        metrics.discretise_symmetries([], [(np.zeros(3), np.zeros(3))])
    with pytest.raises(ValueError, match="positive"):
        metrics.discretise_symmetries(step=0.0)


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


def test_vsd_is_bops_up_to_a_pixel_of_the_union():
    camera = Camera.from_matrix(VSD["K"])
    taus = jnp.asarray(VSD["taus"], jnp.float32)

    def one(seen, truth, estimate, diameter):
        error = metrics.vsd(seen, truth, camera, estimate, diameter=diameter, delta=15.0, tolerances=taus)
        distances = [metrics.distances_from_camera(camera, depth) for depth in (seen, truth, estimate)]
        return error, *metrics.visibility(*distances, 15.0)

    depths = [jnp.asarray(VSD[f"depth_{name}"]) for name in ("test", "gt", "est")]
    error, visible_truth, visible_estimate = jax.jit(jax.vmap(one))(
        *depths, jnp.asarray(VSD["diameter"], dtype=jnp.float32)
    )
    union = np.maximum((VSD["visib_gt"] | VSD["visib_est"]).sum((1, 2)), 1)
    assert (np.abs(np.asarray(error) - VSD["vsd"]) * union[:, None]).max() < 1.01
    assert (np.asarray(visible_truth) != VSD["visib_gt"]).sum((1, 2)).max() <= 1
    assert (np.asarray(visible_estimate) != VSD["visib_est"]).sum((1, 2)).max() <= 1


def test_vsd_of_nothing_is_one_and_of_the_truth_zero():
    depth = jnp.zeros((8, 8)).at[2:5, 2:5].set(0.5)
    far = jnp.full((8, 8), 1.0)
    call = lambda seen, truth, estimate: metrics.vsd(seen, truth, CAMERA, estimate, diameter=0.1, delta=0.015)
    np.testing.assert_array_equal(call(far, jnp.zeros((8, 8)), jnp.zeros((8, 8))), np.ones(10))
    np.testing.assert_array_equal(call(far, depth, depth), np.zeros(10))
    np.testing.assert_array_equal(call(jnp.full((8, 8), jnp.nan), depth, depth), np.zeros(10))  # nothing measured
    np.testing.assert_array_equal(call(jnp.full((8, 8), 0.2), depth, depth), np.ones(10))  # hidden
    np.testing.assert_array_equal(call(far, depth, jnp.zeros((8, 8))), np.ones(10))  # estimate outside the image


TURN = metrics.discretise_symmetries([], [(np.array([0, 0, 1]), np.zeros(3))], 0.05)
closest = jax.jit(metrics.closest_symmetry, static_argnames="block")
surface_distance = jax.jit(metrics.mssd)
projection_distance = jax.jit(metrics.mspd)
average_distance = jax.jit(metrics.add)
nearest_distance = jax.jit(metrics.add_s)
turned_by = jax.jit(metrics.rotation_error)
reprojected_by = jax.jit(metrics.reprojection_error)
NONE = poses(np.eye(3)[None], np.zeros((1, 3)))


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


def test_scale_is_part_of_the_pose():
    pose = random_pose(3)
    unit = Similarity(pose.rotation, pose.translation, jnp.asarray(0.25))
    symmetries = poses(np.eye(3)[None], np.zeros((1, 3)))
    assert metrics.mssd(POINTS, symmetries, unit, unit) == 0
    assert metrics.add_s(POINTS, unit, unit) < 1e-6
    larger = Similarity(pose.rotation, pose.translation, jnp.asarray(0.275))
    np.testing.assert_allclose(
        metrics.mssd(POINTS, symmetries, unit, larger), 0.025 * jnp.max(jnp.linalg.norm(POINTS, axis=-1)), rtol=1e-4
    )
    np.testing.assert_allclose(metrics.scale_error(unit.scale, larger.scale), 0.1, rtol=1e-5)


sized = jax.jit(metrics.sized_errors)


@given(
    seed=st.integers(0, 1000),
    factor=st.floats(0.5, 2.0),
    size=st.floats(0.05, 5.0),
    centre=hnp.arrays(np.float32, 3, elements=st.floats(-0.125, 0.125, width=32)),
)
def test_a_wrong_size_alone_is_an_error_as_large_as_the_size_is_wrong(seed, factor, size, centre):
    """True rotation, size wrong by a factor about any point c: |f − 1| · |x − c|, largest and mean."""
    truth = random_pose(seed)
    truth = Similarity(truth.rotation, truth.translation, jnp.asarray(size, jnp.float32))
    kept = truth.rotation @ jnp.asarray(centre)
    estimate = Similarity(
        truth.rotation, truth.translation + size * (1 - factor) * kept, jnp.asarray(factor * size, jnp.float32)
    )
    found = sized(0.4, POINTS, NONE, truth, estimate)
    arms = np.linalg.norm(np.asarray(POINTS) - centre, axis=-1) / 0.4
    np.testing.assert_allclose(found.mssd, abs(factor - 1) * arms.max(), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found.add, abs(factor - 1) * arms.mean(), rtol=1e-3, atol=1e-5)
    assert found.add_s <= found.add + 1e-5
    np.testing.assert_allclose(found.size, abs(factor - 1), atol=1e-5)


@given(seed=st.integers(0, 1000), grow=st.floats(0.0, 0.9))
def test_sized_errors_forgive_symmetries_and_nothing_else(seed, grow):
    """A symmetric pose of the wrong size is as wrong as the true pose of the wrong size; more so the more it is off."""
    symmetries, truth = poses(*TURN), random_pose(seed)
    turn = jnp.asarray(TURN[0][seed % len(TURN[0])], jnp.float32)
    errors = []
    for rotation in (truth.rotation, truth.rotation @ turn):
        for factor in (1 + grow, 1 + grow + 0.1):
            estimate = Similarity(rotation, truth.translation, jnp.asarray(factor, jnp.float32))
            errors.append(float(sized(0.4, POINTS, symmetries, truth, estimate).mssd))
    reach = float(jnp.max(jnp.linalg.norm(POINTS, axis=-1))) / 0.4
    np.testing.assert_allclose(errors, [grow * reach, (grow + 0.1) * reach] * 2, rtol=1e-3, atol=1e-5)


def test_sized_errors_are_bops_at_the_true_size_and_can_be_mapped():
    """One estimate after another, or all at once; where every size is right, BOP's own numbers in diameters."""
    rows, truth, estimate = rows_of(2)
    points, symmetries = jnp.asarray(ERRORS["obj2_pts"]), poses(*symmetries_of(2))
    diameter = float(ERRORS["obj2_diameter"])
    run = lambda t, e: metrics.sized_errors(diameter, points, symmetries, t, e)
    found = jax.jit(jax.vmap(run))(truth, estimate)
    for name, golden in (("mssd", "mssd"), ("add", "add"), ("add_s", "adi")):
        np.testing.assert_allclose(getattr(found, name), ERRORS[golden][rows] / diameter, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(found.size, np.zeros(len(rows)))
    expected = [np.mean(np.asarray(found.mssd) < t) for t in metrics.THRESHOLDS]
    np.testing.assert_allclose(metrics.average_recall(found.mssd), np.mean(expected), atol=1e-6)


def test_the_size_is_right_strictly_within_its_tolerance():
    found = jax.vmap(metrics.scale_error, (None, 0))(jnp.ones(()), jnp.asarray([1.0, 0.985, 1.03, 0.93, 1.3]))
    np.testing.assert_allclose(
        metrics.recall(found, jnp.asarray(metrics.SIZE_TOLERANCES, jnp.float32)), [0.4, 0.6, 0.8]
    )


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-3, 1.0, 3.0, np.pi - 1e-4, np.pi])
def test_rotation_error_is_accurate_at_both_ends(angle):
    rotation, _ = metrics.discretise_symmetries([], [(np.array([1.0, 2.0, 3.0]), np.zeros(3))], np.pi)
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = rotation[0] + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    error = metrics.rotation_error(jnp.eye(3), jnp.asarray(turn, jnp.float32))
    np.testing.assert_allclose(error, angle, atol=1e-6)


def test_gradients_are_finite_at_a_perfect_pose():
    pose = random_pose(1)
    for error in (
        lambda t: metrics.translation_error(pose.translation, t),
        lambda t: metrics.add(POINTS, pose, Similarity(pose.rotation, t, pose.scale)),
    ):
        assert jnp.all(jnp.isfinite(jax.grad(error)(pose.translation)))


def area_by_integration(errors: np.ndarray, limit: float) -> float:
    """The toolbox's curve, sampled: between two errors it takes the higher accuracy."""
    grid = (np.arange(100_000) + 0.5) / 100_000 * limit
    ordered = np.sort(errors[errors <= limit])
    following = np.searchsorted(ordered, grid, side="left") + 1
    return float(np.mean(np.minimum(following, len(ordered))) / len(errors))


@given(hnp.arrays(np.float32, 12, elements=st.floats(0, 0.25, width=32)))
def test_area_under_accuracy_is_an_integral(errors):
    found = metrics.area_under_accuracy(jnp.asarray(errors), 0.1)
    np.testing.assert_allclose(found, area_by_integration(errors, 0.1), atol=1e-3)


def test_area_under_accuracy_by_hand():
    area = lambda *errors: float(metrics.area_under_accuracy(jnp.asarray(errors, dtype=jnp.float32)))
    assert area(0.0, 0.0) == 1.0
    assert area(jnp.inf, 0.2) == 0.0
    assert area(0.05) == pytest.approx(1.0)  # the higher value: PoseCNN's toolbox, not the plain integral
    assert area(0.05, jnp.inf) == pytest.approx(0.5)
    assert area() == 0.0


def test_recall_is_strict():
    errors = jnp.array([0.0, 5.0, 10.0, jnp.inf, jnp.nan])
    np.testing.assert_allclose(metrics.recall(errors, jnp.array([5.0, 10.0, 100.0])), [0.2, 0.4, 0.6])


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
