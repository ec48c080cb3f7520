"""Rigid motions as files: where a camera stands on a robot, by the name of its two frames.

::

    {"base_from_camera": [[…], […], […], […]],    4 × 4, metres, OpenCV's camera axes
     "unit": "m", …}                              may be left out; "mm" is converted; other entries are not read

A matrix is called ``a_from_b``, for it maps points of b to a, and a file that holds another one than is asked for is
refused: that of a camera on the hand is not that of one beside the robot.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.files.storage.parsing import parse, read_text
from ipjax.files.storage.writing import write_text
from ipjax.transforms import Similarity

UNITS = {"m": 1.0, "mm": 1e-3}  # metres
FARTHEST = 20.0  # metres between two frames of one robot's cell; beyond, they are millimetres


def to_rigid(matrices: Float[np.ndarray, "*b 4 4"]) -> Similarity[np.ndarray]:
    """Poses ``*b 4 4`` as rigid motions in doubles, their rotations made exactly orthonormal.

    Raises:
      ValueError: they are not finite, or stretch, shear or mirror, by a thousandth or more.
    """
    pose = Similarity[np.ndarray].from_matrix(np.asarray(matrices, np.float64))
    if np.abs(pose.scale - 1).max(initial=0) > 1e-3:
        worst = float(np.ravel(pose.scale)[np.abs(pose.scale - 1).argmax()])
        raise ValueError(f"a rigid motion keeps sizes, but one of these enlarges by {worst:.4g}")
    return Similarity(pose.rotation, pose.translation, np.ones(pose.scale.shape)).orthonormal()


def read_rigid(path: str | Path, name: str) -> Similarity[np.ndarray]:
    """A rigid motion, metres, of a JSON or YAML file.

    Args:
      path: holds the matrix under its name, or nothing but the matrix (whose name is then taken on trust).
      name: of the matrix that is wanted, for instance ``base_from_camera``.

    Raises:
      ValueError: unreadable, another matrix, not rigid, or so far away that it may be in millimetres; names the file.
    """
    text = read_text(path, f"file of {name}")
    try:
        document = parse(text)
        scale = 1.0
        if isinstance(document, dict):
            scale = _read_unit(document)
            document = _pick(document, name)
        return parse_rigid(document, scale)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse_rigid(value: Any, scale: float = 1.0) -> Similarity[np.ndarray]:
    """A rigid motion of nested lists of 4 × 4 numbers; ``scale``: metres per unit of their translation.

    Raises:
      ValueError: they are none, or so far away that they may be in millimetres.
    """
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("a rigid motion is a matrix of 4 × 4 numbers, row by row") from None
    if matrix.shape != (4, 4):
        raise ValueError(f"a rigid motion is a matrix of 4 × 4 numbers, not of shape {list(matrix.shape)}")
    pose = to_rigid(matrix)
    pose = Similarity(pose.rotation, scale * pose.translation, pose.scale)
    far = float(np.linalg.norm(pose.translation))
    if far > FARTHEST:
        raise ValueError(f'{far:.4g} m between two frames of one robot: these are millimetres; add "unit": "mm"')
    return pose


def write_rigid(path: str | Path, name: str, pose: Similarity[np.ndarray], **more: Any) -> Path:
    """Write a rigid motion in metres, whole or not at all, for `read_rigid`; returns its path.

    Args:
      path: ends in .json.
      name: of the matrix, ``a_from_b``.
      pose: one of them, rigid.
      more: other entries that JSON can hold.

    Raises:
      ValueError: a number is not finite.
      OSError: the file cannot be written.
    """
    document = {name: pose.to_matrix().tolist(), "unit": "m", **more}
    return write_text(path, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def _pick(document: dict[str, Any], name: str) -> Any:
    if name in document:
        return document[name]
    others = [key for key in document if re.fullmatch(r"\w+_from_\w+", str(key))]
    if not others:
        raise ValueError(f'it has no {name}; {{"{name}": [[…], […], […], […]]}}, in metres, is expected')
    hint = ""
    if name == "base_from_camera" and "gripper_from_camera" in others:
        hint = ": of a camera on the hand, base_from_camera = base_from_gripper @ gripper_from_camera in every pose"
    elif "_from_".join(reversed(name.split("_from_"))) in others:
        hint = ", its inverse"
    raise ValueError(f"{name} is wanted, but it has {', '.join(others)}{hint}")


def _read_unit(document: dict[str, Any]) -> float:
    unit = document.get("unit", document.get("units", "m"))
    check_unit(unit)
    return UNITS[unit]


def check_unit(unit: Any) -> None:
    """Raises ValueError where what a file says is none of `UNITS`."""
    if not isinstance(unit, str) or unit not in UNITS:
        raise ValueError(f"its unit is {unit!r}; m or mm is expected")
