"""Calibrations that cannot be had, and pairs that do not belong together: refused, or named, in words."""

import re

import numpy as np
import pytest

from ipjax.robot.hand_eye.calibrating import calibrate
from ipjax.robot.hand_eye.records import HandEyeError
from ipjax.synthetic.calibration import make_calibration
from ipjax.transforms import Similarity, difference

NOISY = {"camera_noise": (3e-3, 1e-3), "robot_noise": (3e-4, 2e-4)}
COUNT = 15


def exp(steps) -> Similarity[np.ndarray]:
    return Similarity[np.ndarray].exp(np.asarray(steps, np.float64))


def without(number: int) -> np.ndarray:
    return np.delete(np.arange(COUNT), number)


@pytest.mark.parametrize("eye", ["in-hand", "to-hand"])
def test_right_pairs_are_all_kept_and_a_wrong_one_is_named(eye):
    for seed in range(4):
        made = make_calibration(seed, COUNT, eye, **NOISY)
        found = calibrate(made.camera_from_board, made.base_from_gripper, eye)
        assert not found.wrong and not found.notes and len(found.found.used) == COUNT
        order = np.arange(COUNT)
        order[6] = 11  # the image of another pose
        spoiled = calibrate(made.camera_from_board.take(order), made.base_from_gripper, eye)
        assert list(spoiled.wrong) == ["000006"] and "fits the pose of 000011" in spoiled.wrong["000006"]
        off = difference(spoiled.found.mount_from_camera, made.mount_from_camera)
        assert np.linalg.norm(off[:3]) < 0.006 and np.linalg.norm(off[3:6]) < 0.005


def test_a_small_error_is_named_too():
    made = make_calibration(1, COUNT, camera_noise=(5e-4, 2e-4))
    steps = np.zeros((COUNT, 6))
    steps[3, 3:] = 0.005, 0.0, 0.003  # the arm had not come to rest
    found = calibrate(made.camera_from_board, made.base_from_gripper @ exp(steps), "in-hand")
    assert list(found.wrong) == ["000003"] and "mm" in found.wrong["000003"]


@pytest.mark.parametrize(
    ("images", "poses", "said"),
    [
        (without(7), slice(COUNT - 1), "images from 000007 on seem to belong to the pose after theirs; a pose has no"),
        (without(0), slice(COUNT - 1), "all images seem to belong to the pose after theirs"),
        (
            slice(COUNT - 1),
            without(4),
            "from 000004 on seem to belong to the pose before theirs; an image has no",
        ),
        (without(5), slice(COUNT), "images from 000005 on seem to belong to the pose after theirs"),  # counts differ
    ],
)
def test_a_shifted_pairing_is_named(images, poses, said):
    made = make_calibration(2, COUNT, **NOISY)
    with pytest.raises(HandEyeError, match=said):
        calibrate(made.camera_from_board.take(images), made.base_from_gripper.take(poses), "in-hand")


@pytest.mark.parametrize(("eye", "other"), [("in-hand", "to-hand"), ("to-hand", "in-hand")])
def test_the_wrong_direction_is_told(eye, other):
    made = make_calibration(3, COUNT, eye, **NOISY)
    with pytest.raises(HandEyeError, match=f"do not fit --eye {other}, but they fit --eye {eye}, or robot poses"):
        calibrate(made.camera_from_board, made.base_from_gripper, other)


def test_poses_of_other_images_are_refused():
    made = make_calibration(4, COUNT, **NOISY)
    order = np.random.default_rng(0).permutation(COUNT)
    with pytest.raises(HandEyeError, match=r"do not fit one another: .* of 15 views agree"):
        calibrate(made.camera_from_board.take(order), made.base_from_gripper, "in-hand")


@pytest.mark.parametrize(
    ("turns", "said"),
    [
        (np.zeros((COUNT, 3)), r"turn by no more than 0\.0°.*at least two axes, by 20°"),
        (np.outer(np.linspace(-1, 1, COUNT), [0.2, 0.3, 0.9]), r"all turn about one axis.*at least two axes, by 20°"),
    ],
)
def test_motion_that_tells_nothing_is_refused_with_what_to_do(turns, said):
    rng = np.random.default_rng(0)
    gripper = exp(np.concatenate([turns, rng.normal(0.3, 0.1, (COUNT, 3))], axis=1))
    board = gripper.inverse() @ exp(np.tile([0.1, 3, 0.2, 0.4, 0, 0.9], (COUNT, 1)))
    with pytest.raises(HandEyeError, match=said):
        calibrate(board, gripper, "in-hand")


def test_too_few_views_are_refused_and_small_turns_noted():
    made = make_calibration(5, COUNT)
    with pytest.raises(HandEyeError, match="too few views of the board, 3: 4 is the least, 15 is usual"):
        calibrate(made.camera_from_board.take(slice(3)), made.base_from_gripper.take(slice(3)), "in-hand")
    gentle = make_calibration(5, COUNT, tilt=8.0, roll=15.0, camera_noise=(1e-4, 1e-4))
    found = calibrate(gentle.camera_from_board, gentle.base_from_gripper, "in-hand")
    assert any("about a second axis" in note and "20° or more" in note for note in found.notes)


def test_a_board_of_another_size_is_noted():
    made = make_calibration(6, COUNT, camera_noise=(1e-3, 5e-4))
    seen = Similarity(made.camera_from_board.rotation, 0.95 * made.camera_from_board.translation, np.ones(COUNT))
    found = calibrate(seen, made.base_from_gripper, "in-hand")
    assert any(re.search(r"the board seems to be [56]\.\d % larger than was told", note) for note in found.notes)
