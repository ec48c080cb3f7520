"""One pose of a robot as controllers, ROS and scripts write it: which numbers mean what.

A matrix means itself. Four numbers of a quaternion have an order that their values do not tell, three angles a
convention: where names do not say it (``qw``, ``roll``), the user must (`Form`), for a wrong guess gives poses that
look right. Positions are in metres or millimetres, angles in radians or degrees, which their size tells.
"""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.transforms import rotation_from_quaternion, rotation_from_vector

QUATERNIONS = ("xyzw", "wxyz")
ROTATIONS = (*QUATERNIONS, "rotvec", "rpy", "three axes such as xyz (fixed) or ZYX (turning along)")
_AXES = {"x": 0, "y": 1, "z": 2}
_POSITION = ("position", "translation", "t", "xyz", "tvec", "trans", "pos", "p")
_ROTATION = ("orientation", "rotation", "quaternion", "quat", "q", "r", "rot", "rotvec", "rpy", "euler")
_MATRIX = ("matrix", "pose", "transform", "transformation", "basefromgripper", "tcppose", "otee", "value")


@dataclasses.dataclass(frozen=True)
class Form:
    """What the numbers of a file do not tell."""

    rotation: str | None = None  # one of `ROTATIONS`; None = not told
    angles: str | None = None  # "rad" or "deg"; None = by their size
    unit: str | None = None  # "m" or "mm"; None = by their size

    def __post_init__(self) -> None:
        if self.rotation is not None and not is_rotation(self.rotation):
            raise ValueError(f"rotations are written as {', '.join(ROTATIONS)}, not {self.rotation!r}")
        if self.angles not in (None, "rad", "deg") or self.unit not in (None, "m", "mm"):
            raise ValueError("angles are in rad or deg, positions in m or mm")

    @property
    def width(self) -> int:
        """How many numbers a rotation has; 0 = not told."""
        return 0 if self.rotation is None else 4 if self.rotation in QUATERNIONS else 3


@dataclasses.dataclass(frozen=True)
class RawPose:
    """The numbers of a pose, and what they are."""

    position: Float[np.ndarray, "3"]  # in the file's unit
    rotation: Float[np.ndarray, "3 3"] | Float[np.ndarray, "3"] | Float[np.ndarray, "4"]
    kind: str  # "matrix", or as `Form.rotation` has it


def is_rotation(text: str) -> bool:
    """Whether a word says how a rotation is written."""
    axes = len(text) == 3 and set(text.lower()) <= set("xyz") and (text.islower() or text.isupper())
    return text in (*QUATERNIONS, "rotvec", "rpy") or (axes and text[0] != text[1] != text[2])


def read_pose(value: Any, form: Form) -> RawPose:
    """A pose of a list of numbers, of nested lists, or of a dictionary.

    Raises:
      ValueError: it is none, or it does not say what its numbers mean.
    """
    if isinstance(value, Mapping):
        return _read_mapping({_simplify(key): item for key, item in value.items()}, form)
    numbers = _as_numbers(value)
    if numbers.size in (12, 16) and (numbers.ndim == 1 or numbers.shape[1:] == (4,)):
        return _read_matrix(numbers.reshape(-1, 4), numbers.ndim == 1)
    if numbers.ndim != 1 or numbers.size not in (6, 7):
        raise ValueError(
            f"a pose is a matrix of 4 × 4, or x, y, z and a rotation of 3 or 4 numbers, not of shape "
            f"{list(numbers.shape)}"
        )
    return RawPose(numbers[:3], numbers[3:], _check_kind(None, numbers.size - 3, form))


def to_rotation(pose: RawPose, degrees: bool) -> Float[np.ndarray, "3 3"]:
    """The rotation of a pose that `read_pose` read.

    Raises:
      ValueError: a quaternion that is not of length 1.
    """
    if pose.kind == "matrix":
        return pose.rotation
    if pose.kind in QUATERNIONS:
        length = float(np.linalg.norm(pose.rotation))
        if not 0.98 < length < 1.02:
            raise ValueError(f"a quaternion is of length 1, not {length:.4g}")
        return rotation_from_quaternion(pose.rotation if pose.kind == "xyzw" else np.roll(pose.rotation, -1))
    angles = np.deg2rad(pose.rotation) if degrees else pose.rotation
    if pose.kind == "rotvec":
        return rotation_from_vector(angles)
    axes = "xyz" if pose.kind == "rpy" else pose.kind
    turns = [rotation_from_vector(a * np.eye(3)[_AXES[axis.lower()]]) for a, axis in zip(angles, axes, strict=True)]
    first, second, third = turns if axes.isupper() else turns[::-1]  # about fixed axes the first turn is the innermost
    return first @ second @ third


def _read_mapping(items: Mapping[str, Any], form: Form) -> RawPose:
    for name in _MATRIX:
        if name in items:
            return read_pose(items[name], form)
    if {"x", "y", "z"} <= items.keys():
        position = _as_numbers([items[axis] for axis in "xyz"])
        kind, rotation = _find_angles(items)
    elif {"tx", "ty", "tz"} <= items.keys():
        position = _as_numbers([items[f"t{axis}"] for axis in "xyz"])
        kind, rotation = _find_angles(items)
    else:
        place = next((items[name] for name in _POSITION if name in items), None)
        turn = next((items[name] for name in _ROTATION if name in items), None)
        if isinstance(place, Mapping):
            inside = _simplified(place)
            place = [inside.get(axis) for axis in "xyz"]
        kind, rotation = _find_angles(_simplified(turn)) if isinstance(turn, Mapping) else (None, turn)
        known = place is not None and None not in place
        position = _as_numbers(place) if known else np.zeros(0)
    if rotation is None or position.shape != (3,):
        raise ValueError(
            f"x, y, z and a rotation are expected, or a matrix of 4 × 4, among its entries ({', '.join(items)})"
        )
    numbers = _as_numbers(rotation)
    if numbers.size == 9:
        return RawPose(position, numbers.reshape(3, 3), "matrix")
    if numbers.shape not in ((3,), (4,)):
        raise ValueError(f"a rotation is a matrix of 3 × 3, or 3 or 4 numbers, not of shape {list(numbers.shape)}")
    return RawPose(position, numbers, _check_kind(kind, numbers.size, form))


def _find_angles(items: Mapping[str, Any]) -> tuple[str | None, list[Any] | None]:
    """What a rotation by its names is, and its numbers in that order."""
    for names, kind in (
        (("qx", "qy", "qz", "qw"), "xyzw"),
        (("x", "y", "z", "w"), "xyzw"),
        (("roll", "pitch", "yaw"), "rpy"),
        (("rx", "ry", "rz"), None),
        (("a", "b", "c"), None),
    ):
        if set(names) <= items.keys():
            return kind, [items[name] for name in names]
    return None, None


def _check_kind(named: str | None, count: int, form: Form) -> str:
    """What a rotation of so many numbers is, by its names or as was told. Raises ValueError where neither says it."""
    if named is not None:
        return named
    if form.width == count and form.rotation is not None:
        return form.rotation
    if form.rotation is not None:
        raise ValueError(f"rotations were said to be {form.rotation}, but this one has {count} numbers")
    choices = "xyzw or wxyz" if count == 4 else "rotvec (Universal Robots), rpy (ROS), ZYX (KUKA's A, B, C) …"
    raise ValueError(f"a rotation of {count} numbers may mean several things: say which with --rotation: {choices}")


def _read_matrix(matrix: np.ndarray, flat: bool) -> RawPose:
    full = np.concatenate([matrix, [[0, 0, 0, 1.0]]]) if len(matrix) == 3 else matrix
    if flat and not full[:3, 3].any() and full[3, :3].any():
        full = full.T  # column by column, as libfranka writes O_T_EE
    if np.abs(full[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("the last row of a pose's matrix is 0 0 0 1")
    return RawPose(full[:3, 3], full[:3, :3], "matrix")


def _as_numbers(value: Any) -> np.ndarray:
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("a pose is numbers") from None
    if not np.isfinite(numbers).all():
        raise ValueError("a pose has a number that is not finite")
    return numbers


def _simplified(items: Mapping[Any, Any]) -> dict[str, Any]:
    return {_simplify(key): item for key, item in items.items()}


def _simplify(key: Any) -> str:
    return re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*", "", str(key).lower()))
