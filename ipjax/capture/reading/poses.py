"""Poses of cameras as people have them: matrices by name, lists of times with quaternions, files of sixteen numbers."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.records import CaptureError
from ipjax.capture.trajectories import FORMAT, read_trajectory
from ipjax.files.rigid import to_rigid
from ipjax.files.storage.parsing import read_json, read_text
from ipjax.transforms import Similarity, rotation_from_quaternion, rotation_from_vector, vector_from_rotation

NEAR = 0.02  # seconds between two times that are of one moment


def read_named_poses(path: Path, names: Sequence[str]) -> Similarity[np.ndarray]:
    """``world_from_camera`` of these frames, of ``{"NAME": 4 × 4, …}`` or of a trajectory that ipjax wrote.

    Raises:
      CaptureError: unreadable, no rigid motions, or some frames are not in it.
    """
    try:
        document = read_json(path, "file of poses")
    except ValueError as error:
        raise CaptureError(str(error)) from None
    if isinstance(document, dict) and document.get("format") == FORMAT:
        trajectory = read_trajectory(path)
        matrices: dict[str, Any] = {
            name: matrix
            for name, matrix, known in zip(
                trajectory.names, trajectory.world_from_camera.to_matrix(), trajectory.registered, strict=True
            )
            if known
        }
    elif isinstance(document, dict):
        matrices = document
    else:
        raise CaptureError(f'{path}: {{"NAME": [[…], […], […], […]], …}} is expected, world_from_camera of every frame')
    missing = [name for name in names if name not in matrices]
    if missing:
        more = "" if len(missing) == 1 else f" and of {len(missing) - 1} more"
        raise CaptureError(f"{path}: there is no pose of {missing[0]}{more}; give those of all frames, or none")
    return stack_matrices([matrices[name] for name in names], [f"{path}: {name}" for name in names])


def read_matrix_file(path: Path) -> np.ndarray:
    """4 × 4 of a text file with sixteen numbers row by row. Raises CaptureError that names it."""
    try:
        numbers = [float(word) for word in read_text(path, "file of a pose").replace(",", " ").split()]
    except ValueError as error:
        said = str(error)
        raise CaptureError(said if str(path) in said else f"{path}: {said}") from None
    if len(numbers) not in (12, 16):
        raise CaptureError(f"{path}: {len(numbers)} numbers are no pose; a matrix of 4 × 4 is expected")
    return np.array([*numbers, 0, 0, 0, 1][:16]).reshape(4, 4)


def stack_matrices(matrices: Sequence[Any], where: Sequence[str]) -> Similarity[np.ndarray]:
    """Poses of matrices 4 × 4, rigid. Raises CaptureError that begins with the place of the one that is none."""
    found = []
    for matrix, place in zip(matrices, where, strict=True):
        try:
            array = np.asarray(matrix, np.float64)
            if array.shape != (4, 4):
                raise ValueError(f"a pose is a matrix of 4 × 4, not of shape {list(array.shape)}")
            to_rigid(array[None])
        except (TypeError, ValueError) as error:
            raise CaptureError(f"{place}: {error}") from None
        found.append(array)
    return to_rigid(np.stack(found))


def read_timed_poses(path: Path) -> tuple[np.ndarray, Similarity[np.ndarray]]:
    """Times (seconds) and poses of a file in TUM's form: ``time tx ty tz qx qy qz qw``, metres; in its order.

    Raises:
      CaptureError: unreadable, another form, or not rigid.
    """
    rows = []
    try:
        lines = read_text(path, "file of poses").splitlines()
    except ValueError as error:
        raise CaptureError(str(error)) from None
    for number, line in enumerate(lines, 1):
        words = re.split(r"[\s,]+", line.split("#")[0].strip())
        if words == [""]:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 8 or not np.isfinite(row).all() or not 0.5 < np.linalg.norm(row[4:]) < 2:
            raise CaptureError(
                f"{path}: line {number}: time tx ty tz qx qy qz qw is expected, not {line.strip()[:60]!r}"
            )
        rows.append(row)
    if not rows:
        raise CaptureError(f"{path}: there are no poses in it")
    table = np.array(rows)
    rotation = rotation_from_quaternion(table[:, 4:])
    return table[:, 0], Similarity(rotation, table[:, 1:4], np.ones(len(table)))


def interpolate(
    times: np.ndarray, poses: Similarity[np.ndarray], wanted: np.ndarray
) -> tuple[Similarity[np.ndarray], np.ndarray]:
    """Poses at other times, between the two around; where only one of these is near, it is taken.

    Args:
      times: of the poses, seconds.
      wanted: seconds.

    Returns:
      The poses, and which of them are known: those with a pose within `NEAR`.
    """
    order = np.argsort(times, kind="stable")
    times = times[order]
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    before, after = after - 1, np.minimum(after, len(times) - 1)
    to_before, to_after = np.abs(wanted - times[before]), np.abs(wanted - times[after])
    span = np.maximum(times[after] - times[before], 1e-9)
    share = np.clip((wanted - times[before]) / span, 0, 1)
    # Over a gap of the motion capture a straight line would invent the camera's way.
    one_side = np.maximum(to_before, to_after) > NEAR
    share = np.where(one_side, np.round(share), share)[:, None]
    first, second = order[before], order[after]
    turned = np.swapaxes(poses.rotation[first], -1, -2) @ poses.rotation[second]
    rotation = poses.rotation[first] @ rotation_from_vector(share * vector_from_rotation(turned))
    translation = (1 - share) * poses.translation[first] + share * poses.translation[second]
    return Similarity(rotation, translation, np.ones(len(wanted))), np.minimum(to_before, to_after) <= NEAR
