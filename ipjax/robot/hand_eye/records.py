"""What hand–eye calibration is given and what it finds.

The camera is fixed to one end of the robot and the board to the other::

                 camera is on its mount      board is on its holder     robot tells (base_from_gripper)
    in-hand      the gripper                 the base (a table)         holder_from_mount
    to-hand      the base (a tripod)         the gripper                its inverse

    holder_from_mount[i] @ mount_from_camera @ camera_from_board[i] = holder_from_board

for every view i: one equation for both, with two unknown rigid motions that do not change.
"""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.transforms import Similarity

Eye = Literal["in-hand", "to-hand"]
EYES: tuple[Eye, ...] = ("in-hand", "to-hand")
ANSWERS = {"in-hand": "gripper_from_camera", "to-hand": "base_from_camera"}
BOARDS = {"in-hand": "base_from_board", "to-hand": "gripper_from_board"}


class HandEyeError(ValueError):
    """A calibration that cannot be had from what was given: one sentence that says why and what to do."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations along each of three axes."""

    rotation: float  # rad
    translation: float  # m


@dataclasses.dataclass(frozen=True)
class Views:
    """A camera's views of a board, each with the robot's pose."""

    base_from_gripper: Similarity[np.ndarray]  # [n], rigid, metres
    camera_from_board: Similarity[np.ndarray]  # [n], rigid, metres
    # Of camera_from_board: rotation (rad) and translation (m) of the board about its origin along the camera's axes, as
    # `ipjax.transforms.difference` has them; None = not known, the same for all.
    covariance: Float[np.ndarray, "n 6 6"] | None = None

    def __len__(self) -> int:
        return len(self.camera_from_board.scale)

    def take(self, images: Int[np.ndarray, " k"]) -> "Views":
        """Some of the images, with their robot poses."""
        covariance = None if self.covariance is None else self.covariance[images]
        return Views(self.base_from_gripper.take(images), self.camera_from_board.take(images), covariance)


@dataclasses.dataclass(frozen=True)
class HandEye:
    """Where the camera is mounted on a robot."""

    eye: Eye
    mount_from_camera: Similarity[np.ndarray]  # gripper_from_camera (in-hand) or base_from_camera (to-hand), metres
    holder_from_board: Similarity[np.ndarray]  # base_from_board (in-hand) or gripper_from_board (to-hand), metres
    # Of mount_from_camera: rotation (rad) and translation (m) along the mount's axes, in that order.
    covariance: Float[np.ndarray, "6 6"]
    noise: Noise  # of one view: robot and camera together, or the robot's alone where the camera's covariance is given
    used: Int[np.ndarray, " k"]  # numbers of the views that it rests on
    residual: Float[np.ndarray, "n 6"]  # rotation (rad), translation (m) by which each view's board is off, camera axes
    left_out: Float[np.ndarray, "n 6"]  # the same by an answer that does not rest on that view
    distance: Float[np.ndarray, " n"]  # the latter in standard deviations, squared and added: 6 is usual

    @property
    def counted(self) -> Bool[np.ndarray, " n"]:
        """Which views it rests on."""
        return np.isin(np.arange(len(self.distance)), self.used)

    @property
    def answer(self) -> str:
        """The name of ``mount_from_camera``, with its two frames."""
        return ANSWERS[self.eye]

    @property
    def deviations(self) -> tuple[float, float]:
        """Standard deviations of rotation (rad) and translation (m), of the whole vectors."""
        variances = np.diag(self.covariance)
        return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))
