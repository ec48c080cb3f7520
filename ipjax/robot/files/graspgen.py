"""GraspGen's JSON of the grasps of one object, as its data sets and its trainer have it.

The documents of https://github.com/NVlabs/GraspGen have the format: ``object`` with file and scale, ``grasps`` with
``transforms`` (4 × 4, of the gripper's base link, object's frame) and ``object_in_gripper``, which says of each whether
it holds. The approach is +z and the fingers close along x, whatever the gripper: those that close along
y, as Franka's, are turned here, in both directions.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.rigid import to_rigid
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text
from ipjax.inference.reports import to_json
from ipjax.robot.files.listing import GraspList, read_scores, turn_closing
from ipjax.robot.records import Gripper

CLOSING = "x"  # the axis along which fingers close in these files


def write_graspgen(path: str | Path, grasps: GraspList, gripper: Gripper) -> Path:
    """Write grasps as GraspGen's JSON, with their scores and widths beside; returns the path.

    Args:
        grasps: in the gripper's own axes.
        gripper: that they are for.

    Raises:
        OSError: it cannot be written.
    """
    poses = turn_closing(grasps.mesh_from_gripper, gripper.closing, CLOSING)
    document = {
        "object": {"file": grasps.object_file, "scale": float(grasps.object_scale)},
        "gripper": {"name": gripper.name, "approach_axis": "z", "closing_axis": CLOSING},
        "grasps": {
            "transforms": poses.to_matrix().tolist(),
            "object_in_gripper": [bool(score > 0) for score in grasps.score],
            "confidence": [float(x) for x in grasps.score],
            "width_m": [float(x) if np.isfinite(x) else None for x in grasps.width],
        },
    }
    return write_text(path, to_json(document))


def read_graspgen(path: str | Path, gripper: Gripper) -> GraspList:
    """Read GraspGen's JSON, best first; without scores a grasp has 1 where it holds, else 0.

    Args:
        gripper: that the grasps are for.

    Returns:
        Grasps in the gripper's own axes.

    Raises:
        ValueError: unreadable, or not of this format; names the file.
    """
    document = read_json(path, "file of grasps")
    try:
        return _read(document, gripper)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _read(document: Any, gripper: Gripper) -> GraspList:
    entry = document.get("grasps") if isinstance(document, dict) else None
    if not isinstance(entry, dict) or "transforms" not in entry:
        raise ValueError("not GraspGen's grasps: 'grasps' with 'transforms' is expected")
    try:
        matrices = np.asarray(entry["transforms"], np.float64).reshape(-1, 4, 4)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("'transforms' is a list of 4 × 4 matrices") from None
    try:
        poses = to_rigid(matrices)
    except ValueError as error:
        raise ValueError(f"'transforms': {error}") from None
    count = len(matrices)
    holds = entry.get("confidence", entry.get("object_in_gripper", [1.0] * count))
    scores = read_scores(holds, count, "'confidence' or 'object_in_gripper'")
    widths = entry.get("width_m", [None] * count)
    if not isinstance(widths, list) or len(widths) != count:
        raise ValueError(f"'width_m': a number, or null, is expected for each of the {count} grasps")
    about = document.get("object")
    about = about if isinstance(about, dict) else {}
    try:
        width = np.array([np.nan if x is None else float(x) for x in widths])
        scale = float(about.get("scale", 1.0))
    except (TypeError, ValueError, OverflowError):
        raise ValueError("'width_m' and the object's 'scale' are numbers") from None
    if not 0 < scale < np.inf:
        raise ValueError(f"the object's 'scale' is positive and finite, not {scale:g}")
    order = np.argsort(-scores, kind="stable")
    return GraspList(
        mesh_from_gripper=turn_closing(poses.take(order), CLOSING, gripper.closing),
        score=scores[order],
        width=width[order],
        names=tuple(f"grasp_{i}" for i in order),
        object_file=str(about.get("file", "")),
        object_scale=scale,
        gripper=gripper.name,
    )
