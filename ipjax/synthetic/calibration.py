"""Made hand–eye calibrations: a robot, a camera on it or beside it, and its views of a board, all of it known."""

import dataclasses
from typing import Literal

import numpy as np

from ipjax.synthetic.boards import look_at_board
from ipjax.transforms import Similarity, retract


@dataclasses.dataclass(frozen=True)
class MadeCalibration:
    """What the robot and the camera tell, and the truth."""

    base_from_gripper: Similarity[np.ndarray]  # [n], metres, as the robot tells it
    camera_from_board: Similarity[np.ndarray]  # [n], metres, as the camera sees it
    mount_from_camera: Similarity[np.ndarray]  # the truth: gripper_from_camera (in-hand), base_from_camera (to-hand)
    holder_from_board: Similarity[np.ndarray]  # the truth: base_from_board (in-hand), gripper_from_board (to-hand)
    true_camera_from_board: Similarity[np.ndarray]  # [n]


def make_calibration(
    seed: int,
    count: int = 15,
    eye: Literal["in-hand", "to-hand"] = "in-hand",
    *,
    span: tuple[float, float] = (0.28, 0.2),
    distance: float = 0.5,
    tilt: float = 40.0,
    roll: float = 60.0,
    camera_noise: tuple[float, float] = (0.0, 0.0),
    robot_noise: tuple[float, float] = (0.0, 0.0),
) -> MadeCalibration:
    """A calibration as it is usually done: the board is seen from all sides.

    Args:
      seed: same seed, same calibration.
      count: of the views.
      eye: whether the camera is on the hand, or beside the robot, whose hand holds the board.
      span: width and height of the board, metres.
      distance, tilt, roll: see `ipjax.synthetic.boards.look_at_board`.
      camera_noise: standard deviations along each axis of rotation (rad) and translation (m) of camera_from_board,
        about the board's origin.
      robot_noise: the same of base_from_gripper, along the gripper's axes.
    """
    rng = np.random.default_rng(seed)
    board_from_camera = look_at_board(span, count, seed, distance=distance, tilt=tilt, roll=roll)
    mount_from_camera, holder_from_board = (
        Similarity[np.ndarray].exp(np.concatenate([rng.normal(0, 1, 3), rng.normal(middle, spread)]))
        for middle, spread in (
            (([0.05, 0, 0.06], [0.03] * 3) if eye == "in-hand" else ([0.9, 0.1, 0.6], [0.1] * 3)),
            (([0.5, 0.1, 0.05], [0.1] * 3) if eye == "in-hand" else ([-0.1, -0.1, 0.05], [0.03] * 3)),
        )
    )
    holder_from_mount = holder_from_board @ board_from_camera @ mount_from_camera.inverse()
    base_from_gripper = holder_from_mount if eye == "in-hand" else holder_from_mount.inverse()
    robot_error, camera_error = (
        np.concatenate([rng.normal(0, turn, (count, 3)), rng.normal(0, shift, (count, 3))], axis=1)
        for turn, shift in (robot_noise, camera_noise)
    )
    return MadeCalibration(
        base_from_gripper @ Similarity[np.ndarray].exp(robot_error),
        retract(board_from_camera.inverse(), camera_error),
        mount_from_camera,
        holder_from_board,
        board_from_camera.inverse(),
    )
