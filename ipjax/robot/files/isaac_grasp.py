"""``isaac_grasp``: NVIDIA's YAML of grasps by name, which Isaac Sim's grasp editor and Isaac ROS read and write.

https://nvidia-isaac-ros.github.io/concepts/manipulation/isaac_grasp.html has the format: for each grasp a confidence,
a position (m), an orientation (w and xyz of a unit quaternion), and positions of joints once it holds and before. The
file does not say along which axis the fingers close: the frame is that of a link of the gripper's own description, such
as ``panda_hand``, which closes along y. Ours are written with ``closing_axis``, and read without it as the gripper's.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.storage.parsing import parse_yaml, read_text
from ipjax.files.storage.writing import write_text
from ipjax.robot.files.listing import GraspList, read_scores, turn_closing
from ipjax.robot.records import Gripper
from ipjax.transforms import Similarity, quaternion_from_rotation, rotation_from_quaternion

# Grippers whose fingers slide: the joint of one finger, by how far it is from the middle, m.
_JOINTS = {"franka": "panda_finger_joint1"}
_LINKS = {"franka": "panda_hand", "robotiq": "base_link"}


def write_isaac_grasp(path: str | Path, grasps: GraspList, gripper: Gripper, *, closing: str | None = None) -> Path:
    """Write grasps as isaac_grasp YAML; returns the path.

    Args:
        path: ends in .yaml or .yml.
        grasps: in the gripper's own axes.
        gripper: that they are for. Franka's gets its joint's positions, too; of others the joints are not known.
        closing: the axis along which the fingers close in the file's axes: x or y; None = as the gripper's own.

    Raises:
        ValueError: another axis.
        OSError: it cannot be written.
    """
    import yaml

    axis = gripper.closing if closing is None else closing
    poses = turn_closing(grasps.mesh_from_gripper, gripper.closing, axis)
    entries: dict[str, Any] = {}
    for i, name in enumerate(grasps.names):
        x, y, z, w = quaternion_from_rotation(poses.rotation[i]).tolist()
        entry: dict[str, Any] = {
            "confidence": float(grasps.score[i]),
            "position": poses.translation[i].tolist(),
            "orientation": {"w": w, "xyz": [x, y, z]},
        }
        width = float(grasps.width[i])
        if math.isfinite(width):
            entry["width_m"] = width
            if gripper.name in _JOINTS:
                entry["cspace_position"] = {_JOINTS[gripper.name]: width / 2}
                entry["pregrasp_cspace_position"] = {_JOINTS[gripper.name]: float(gripper.opening) / 2}
        entries[name] = entry
    document = {
        "format": "isaac_grasp",
        "format_version": "1.0",
        "created_with": "ipjax",
        "object_frame": grasps.object_file or "object",
        "gripper_frame": _LINKS.get(gripper.name, gripper.name),
        "object_file": grasps.object_file,
        "object_scale": float(grasps.object_scale),
        "gripper": gripper.name,
        "approach_axis": "z",
        "closing_axis": axis,
        "grasps": entries,
    }
    return write_text(path, yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))


def read_isaac_grasp(path: str | Path, gripper: Gripper, *, closing: str | None = None) -> GraspList:
    """Read isaac_grasp YAML, best first.

    Args:
        gripper: that the grasps are for.
        closing: the axis along which the fingers close in the file's axes; None = what the file says in
            ``closing_axis``, else the gripper's own.

    Returns:
        Grasps in the gripper's own axes.

    Raises:
        ValueError: unreadable, or not of this format; names the file and, where it is one grasp's, the grasp.
    """
    text = read_text(path, "file of grasps")
    try:
        return _read(parse_yaml(text), gripper, closing)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _read(document: Any, gripper: Gripper, closing: str | None) -> GraspList:
    if not isinstance(document, dict) or document.get("format") != "isaac_grasp":
        raise ValueError("not an isaac_grasp file: it has no 'format: isaac_grasp'")
    try:
        version = float(document.get("format_version", 1))
    except (TypeError, ValueError):
        raise ValueError(f"format_version is a number, not {document['format_version']!r}") from None
    if not 1 <= version < 2:
        raise ValueError(f"version {version:g} of isaac_grasp is not known: 1.0 is")
    entries = document.get("grasps")
    if not isinstance(entries, dict):
        raise ValueError("'grasps' holds the grasps by name")
    axis = closing or document.get("closing_axis") or gripper.closing
    rotations, places, scores, widths = [], [], [], []
    for name, entry in entries.items():
        what = f"grasp {str(name)!r}"
        if not isinstance(entry, dict):
            raise ValueError(f"{what}: confidence, position and orientation are expected")
        turn = entry.get("orientation")
        turn = turn if isinstance(turn, dict) else {}
        xyz = _read_numbers(turn.get("xyz"), 3, f"{what}: orientation's xyz")
        quaternion = np.array([*xyz, *_read_numbers([turn.get("w")], 1, f"{what}: orientation's w")])
        if abs(np.linalg.norm(quaternion) - 1) > 1e-2:
            raise ValueError(f"{what}: the orientation is no unit quaternion")
        rotations.append(rotation_from_quaternion(quaternion))
        places.append(_read_numbers(entry.get("position"), 3, f"{what}: position"))
        scores.append(read_scores([entry.get("confidence", 1.0)], 1, f"{what}: confidence")[0])
        widths.append(_read_width(entry, gripper))
    order = sorted(range(len(scores)), key=lambda i: -scores[i])
    count = len(order)
    poses = Similarity(
        np.asarray(rotations, np.float64).reshape(count, 3, 3)[order],
        np.asarray(places, np.float64).reshape(count, 3)[order],
        np.ones(count),
    )
    scale = _read_numbers([document.get("object_scale", 1.0)], 1, "object_scale")[0]
    if scale <= 0:
        raise ValueError(f"object_scale is positive, not {scale:g}")
    return GraspList(
        mesh_from_gripper=turn_closing(poses, str(axis), gripper.closing),
        score=np.asarray(scores, np.float64)[order],
        width=np.asarray(widths, np.float64)[order],
        names=tuple(str(name) for i in order for name in [list(entries)[i]]),
        object_file=str(document.get("object_file") or document.get("object_frame", "")),
        object_scale=float(scale),
        gripper=gripper.name,
    )


def _read_width(entry: dict[str, Any], gripper: Gripper) -> float:
    """The width between the pads that a grasp tells, m; NaN where it does not."""
    if entry.get("width_m") is not None:
        return float(_read_numbers([entry["width_m"]], 1, "width_m")[0])
    joints = entry.get("cspace_position")
    joint = _JOINTS.get(gripper.name)
    if joint is not None and isinstance(joints, dict) and joint in joints:
        return 2 * float(_read_numbers([joints[joint]], 1, joint)[0])
    return float("nan")


def _read_numbers(values: Any, count: int, what: str) -> np.ndarray:
    fits = isinstance(values, list) and len(values) == count
    if not fits or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in values):
        raise ValueError(f"{what}: {'a number is' if count == 1 else f'{count} numbers are'} expected")
    try:
        numbers = np.asarray(values, np.float64)
    except OverflowError:  # a whole number of hundreds of digits
        numbers = np.full(count, np.inf)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what}: it is not finite")
    return numbers
