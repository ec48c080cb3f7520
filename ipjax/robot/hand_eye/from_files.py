"""Hand–eye calibration from files: images of a board, a camera, and a file of the robot's poses."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.cameras import project
from ipjax.capture.poses.boards import Board
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.rigid import write_rigid
from ipjax.robot.hand_eye.calibrating import Calibration, calibrate
from ipjax.robot.hand_eye.reading.observing import Observation, observe, spreads
from ipjax.robot.hand_eye.reading.pose_forms import Form
from ipjax.robot.hand_eye.reading.robot_poses import pair, read_robot_poses
from ipjax.robot.hand_eye.records import BOARDS, Eye, HandEyeError
from ipjax.robot.hand_eye.solving import tell_boards
from ipjax.transforms import Similarity


@dataclasses.dataclass(frozen=True)
class ViewError:
    """How far one view is off, by a calibration that does not rest on it."""

    name: str
    counted: bool  # whether the answer rests on it
    corners: int
    own_pixels: float  # corners against the board's pose by this image alone, root mean square
    pixels: float  # corners against where the calibration has the board, root mean square
    rotation: float  # rad, without it
    translation: float  # m, without it


@dataclasses.dataclass(frozen=True)
class Outcome:
    """A calibration from files, and what is told of it."""

    calibration: Calibration
    board: Board
    observations: list[Observation]  # of all images
    told: Similarity[np.ndarray]  # camera_from_board by the calibration, of each of its views
    views: list[ViewError]
    corner_noise: float  # pixels
    notes: list[str]

    @property
    def typical(self) -> tuple[float, float]:
        """Medians over the views that count of the errors without them: rad and m."""
        errors = [(view.rotation, view.translation) for view in self.views if view.counted]
        rotation, translation = np.median(errors, axis=0).tolist()
        return rotation, translation


def calibrate_files(
    images: Sequence[Path],
    robot_poses: Path,
    intrinsics: Intrinsics,
    board: Board,
    eye: Eye,
    *,
    form: Form | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Outcome:
    """Where the camera of these images is mounted.

    Args:
      images: in the order in which they were taken.
      robot_poses: ``base_from_gripper`` of each (see `robot_poses.read_robot_poses`).
      intrinsics: of the camera, with its lens.
      board: that they show.
      eye: "in-hand" or "to-hand".
      form: what the numbers of robot_poses mean, where they do not say it.
      progress: called with what is done, how much of it, and of how much.

    Raises:
      HandEyeError: as `read_robot_poses`, `observe` and `calibrate`.
    """
    poses = read_robot_poses(robot_poses, form)
    notes, chosen, own = list(poses.notes), np.arange(len(images)), np.arange(len(images))
    if poses.names is not None:
        chosen, own, more = pair(images, poses)
        notes += more
    elif abs(len(images) - len(poses.base_from_gripper.scale)) > 2:
        raise HandEyeError(
            f"{robot_poses}: {len(poses.base_from_gripper.scale)} poses without names do not belong to {len(images)} "
            "images: give as many, or poses by the images' names"
        )
    observations, doubts = observe([images[i] for i in chosen.tolist()], intrinsics, board, progress)
    notes += doubts
    there = [i for i, one in enumerate(observations) if one.sighting is not None]
    seen = [observations[i] for i in there]
    sightings = [one.sighting for one in seen if one.sighting is not None]
    covariance, corner_noise = spreads(seen, intrinsics)
    found = calibrate(
        Similarity[np.ndarray].stack([sighting.camera_from_board for sighting in sightings]),
        poses.base_from_gripper,
        eye,
        covariance=covariance,
        names=[one.name for one in seen],
        own=own[there],
    )
    result = found.found
    seen = [one for one in seen if one.name in found.names]  # those that have a pose
    sightings = [one.sighting for one in seen if one.sighting is not None]
    gripper = poses.base_from_gripper.take(own[there][: len(seen)])
    told = tell_boards(gripper, eye, result.mount_from_camera, result.holder_from_board)
    views = [
        ViewError(
            name,
            bool(counted),
            len(sighting.points),
            sighting.off,
            _reproject(sighting, told.take(i), intrinsics),
            float(np.linalg.norm(result.left_out[i, :3])),
            float(np.linalg.norm(result.left_out[i, 3:])),
        )
        for i, (name, counted, sighting) in enumerate(zip(found.names, result.counted, sightings, strict=True))
    ]
    return Outcome(found, board, observations, told, views, corner_noise, [*notes, *found.notes])


def to_document(outcome: Outcome) -> dict[str, Any]:
    """What JSON holds of an outcome, less the answer itself (see `write_outcome`)."""
    found = outcome.calibration.found
    turn, shift = found.deviations
    rotation, translation = outcome.typical
    return {
        "eye": found.eye,
        BOARDS[found.eye]: found.holder_from_board.to_matrix().tolist(),
        "deviation": {"rotation_deg": np.degrees(turn).item(), "translation_mm": 1000 * shift},
        "covariance": found.covariance.tolist(),
        "left_out_error": {"rotation_deg": np.degrees(rotation).item(), "translation_mm": 1000 * translation},
        "robot_noise": {
            "rotation_deg": np.degrees(found.noise.rotation).item(),
            "translation_mm": 1000 * found.noise.translation,
        },
        "corner_noise_pixels": outcome.corner_noise,
        "board": outcome.board.word,
        "board_scale": {"value": 1 + outcome.calibration.stretch, "deviation": outcome.calibration.stretch_std},
        "views": [
            {
                "name": view.name,
                "counted": view.counted,
                "corners": view.corners,
                "own_pixels": view.own_pixels,
                "pixels": view.pixels,
                "rotation_deg": np.degrees(view.rotation).item(),
                "translation_mm": 1000 * view.translation,
            }
            for view in outcome.views
        ],
        "wrong": list(outcome.calibration.wrong.values()),
        "without_board": {one.name: one.reason for one in outcome.observations if one.sighting is None},
        "notes": outcome.notes,
    }


def write_outcome(path: Path, outcome: Outcome) -> Path:
    """Write the answer under its name, with what is told of it, for `ipjax.files.rigid.read_rigid`.

    Raises:
      OSError: it cannot be written.
    """
    found = outcome.calibration.found
    return write_rigid(path, found.answer, found.mount_from_camera, **to_document(outcome))


def _reproject(sighting: Any, told: Similarity[np.ndarray], intrinsics: Intrinsics) -> float:
    off = project(intrinsics.matrix, told @ sighting.points) - sighting.pixels
    return float(np.sqrt(np.square(off).sum(-1).mean()))
