"""AX = XB: recovery, equivariance, errors without bias and as large as told, in both directions."""

import dataclasses

import numpy as np
import pytest

from ipjax.robot.hand_eye.records import EYES, Noise, Views
from ipjax.robot.hand_eye.solving import find_stretch, residuals, solve, start
from ipjax.synthetic.calibration import MadeCalibration, make_calibration
from ipjax.transforms import Similarity, difference, retract

NOISY = {"camera_noise": (1e-3, 1e-3), "robot_noise": (5e-4, 3e-4)}


def views_of(made: MadeCalibration, covariance: np.ndarray | None = None) -> Views:
    return Views(made.base_from_gripper, made.camera_from_board, covariance)


def exp(*step: float) -> Similarity[np.ndarray]:
    return Similarity[np.ndarray].exp(np.array(step))


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("count", [4, 15])
def test_exact_views_give_the_exact_answer(eye, count):
    made = make_calibration(count, count, eye)
    for pose, true in zip(
        (*start(views_of(made), eye), (found := solve(views_of(made), eye)).mount_from_camera, found.holder_from_board),
        2 * (made.mount_from_camera, made.holder_from_board),
        strict=True,
    ):
        np.testing.assert_allclose(pose.to_matrix(), true.to_matrix(), atol=1e-9)
    assert found.answer == {"in-hand": "gripper_from_camera", "to-hand": "base_from_camera"}[eye]
    assert max(found.deviations) < 1e-5


def test_inverted_poses_are_the_other_direction():
    made = make_calibration(1, 8, "in-hand", **NOISY)
    views = views_of(made)
    turned = dataclasses.replace(views, base_from_gripper=made.base_from_gripper.inverse())
    one, other = solve(views, "in-hand"), solve(turned, "to-hand")
    np.testing.assert_allclose(one.mount_from_camera.to_matrix(), other.mount_from_camera.to_matrix(), atol=1e-9)


@pytest.mark.parametrize("eye", EYES)
def test_other_frames_of_base_and_board_change_nothing_else(eye):
    """Moving the robot's base moves what is told in it, and no residual; a turned camera turns the answer."""
    made = make_calibration(2, 10, eye, camera_noise=(1e-3, 0.0))
    found = solve(views_of(made), eye, noise=Noise(1e-3, 1e-3))
    base = exp(0.4, -1.1, 0.2, 0.3, 0.1, -0.6)
    moved = solve(Views(base @ made.base_from_gripper, made.camera_from_board), eye, noise=Noise(1e-3, 1e-3))
    expected = found.mount_from_camera if eye == "in-hand" else base @ found.mount_from_camera
    np.testing.assert_allclose(moved.mount_from_camera.to_matrix(), expected.to_matrix(), atol=1e-8)
    np.testing.assert_allclose(moved.residual, found.residual, atol=1e-8)
    turn = exp(0, 0, 0.7, 0, 0, 0)
    turned = solve(Views(made.base_from_gripper, turn @ made.camera_from_board), eye, noise=Noise(1e-3, 1e-3))
    expected = found.mount_from_camera @ turn.inverse()
    np.testing.assert_allclose(turned.mount_from_camera.to_matrix(), expected.to_matrix(), atol=1e-8)


def test_order_does_not_matter_and_a_view_that_does_not_count_is_absent():
    made = make_calibration(3, 9, **NOISY)
    views, order = views_of(made), np.random.default_rng(0).permutation(9)
    found = solve(views, "in-hand")
    mixed = solve(views.take(order), "in-hand")
    np.testing.assert_allclose(mixed.mount_from_camera.to_matrix(), found.mount_from_camera.to_matrix(), atol=1e-7)
    wrong = views.camera_from_board.translation.copy()
    wrong[4] += 0.5
    spoiled = Views(views.base_from_gripper, Similarity(views.camera_from_board.rotation, wrong, np.ones(9)))
    counted = np.arange(9) != 4
    one, other = solve(spoiled, "in-hand", counted=counted), solve(views.take(np.flatnonzero(counted)), "in-hand")
    np.testing.assert_allclose(one.mount_from_camera.to_matrix(), other.mount_from_camera.to_matrix(), atol=1e-9)
    assert one.used.tolist() == np.flatnonzero(counted).tolist() and one.distance[4] > 1e4


@pytest.mark.parametrize("eye", EYES)
def test_errors_have_no_bias_and_are_as_large_as_told(eye):
    """Fifteen views, 3 mrad and 1 mm (of the whole vectors); the mean of signed errors within chance of zero."""
    axis = 1 / np.sqrt(3)
    steps, told, noise = [], [], []
    for seed in range(40):
        made = make_calibration(seed, 15, eye, camera_noise=(3e-3 * axis, 1e-3 * axis))
        found = solve(views_of(made), eye)
        step = difference(found.mount_from_camera, made.mount_from_camera)[:6]
        told.append(step @ np.linalg.solve(found.covariance, step))
        # Along the camera's axes, which every seed mounts in another way: a bias would lie along them.
        steps.append((made.mount_from_camera.inverse() @ found.mount_from_camera).log()[:6])
        noise.append((found.noise.rotation, found.noise.translation))
    steps = np.array(steps)
    assert np.degrees(np.median(np.linalg.norm(steps[:, :3], axis=1))) < 0.1
    assert 1000 * np.median(np.linalg.norm(steps[:, 3:], axis=1)) < 1.5
    assert (np.abs(steps.mean(0)) < 4 * steps.std(0) / np.sqrt(40)).all()
    assert 4.5 < np.mean(told) < 8.5  # six, if the covariance is right
    np.testing.assert_allclose(np.mean(noise, 0), [3e-3 * axis, 1e-3 * axis], rtol=0.1)


def test_noise_of_the_robot_is_told_from_that_of_the_camera():
    """Each view's own covariance is used: better than alike for all, and the robot's noise comes out."""
    better, noise = [], []
    for seed in range(8):
        made = make_calibration(seed, 15, robot_noise=(1e-3, 5e-4))
        rng = np.random.default_rng(seed)
        size = np.array([8e-3, 8e-3, 1e-3, 3e-4, 3e-4, 2e-3])  # a board's tilt and distance are known worst
        seen = retract(made.camera_from_board, rng.normal(0, size, (15, 6)))
        covariance = np.tile(np.diag(size**2), (15, 1, 1))
        found = solve(Views(made.base_from_gripper, seen, covariance), "in-hand")
        alike = solve(Views(made.base_from_gripper, seen), "in-hand")
        errors = [difference(f.mount_from_camera, made.mount_from_camera) for f in (found, alike)]
        better.append([np.linalg.norm(error[part]) for error in errors for part in (slice(3), slice(3, 6))])
        noise.append((found.noise.rotation, found.noise.translation))
    rotation, translation, alike_rotation, alike_translation = np.median(better, 0)
    assert rotation < 0.9 * alike_rotation and translation < 0.9 * alike_translation
    np.testing.assert_allclose(np.median(noise, 0), [1e-3, 5e-4], rtol=0.25)


def test_what_is_left_out_is_foretold():
    """The error without a view, by one formula, is that of a calibration without it."""
    views = views_of(make_calibration(5, 8, **NOISY))
    found = solve(views, "in-hand")
    for number in (0, 5):
        rest = solve(views, "in-hand", noise=found.noise, counted=np.arange(8) != number)
        np.testing.assert_allclose(found.left_out[number], rest.left_out[number], atol=3e-6)
        np.testing.assert_allclose(found.distance[number], rest.distance[number], rtol=0.01)
        off = residuals(views, "in-hand", rest.mount_from_camera, rest.holder_from_board)
        np.testing.assert_allclose(rest.left_out[number], off[number], atol=1e-12)


def test_a_board_printed_too_small_is_measured():
    stretches = []
    for seed in range(6):
        made = make_calibration(seed, 15, **NOISY)
        seen = made.camera_from_board
        views = Views(made.base_from_gripper, Similarity(seen.rotation, seen.translation * 1.03, np.ones(15)))
        stretch, deviation = find_stretch(views, solve(views, "in-hand"))
        stretches.append(stretch)
        assert abs(stretch + 0.03 / 1.03) < 5 * deviation and deviation < 0.01
    assert abs(np.mean(stretches) + 0.03 / 1.03) < 0.002
