"""Grippers as data: two that are common, and one's own as JSON."""

import math
from pathlib import Path
from typing import Any

from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text
from ipjax.robot.records import Gripper

# Measures of Franka's own mesh of the hand and the fingers (franka_description), and of its data sheet.
FRANKA_HAND = Gripper(
    name="franka",
    closing="y",
    opening=0.08,
    reach=0.1034,
    pad=(0.018, 0.021),
    finger=(0.054, 0.015),
    boxes=(((0.0, 0.0, 0.02), (0.0316, 0.1025, 0.0459)),),
    force=70.0,
)
# Measures of Robotiq's manual; the body as it is while the fingers are open. It closes with 20 to 235 N.
ROBOTIQ_2F_85 = Gripper(
    name="robotiq",
    closing="y",
    opening=0.085,
    reach=0.145,
    pad=(0.0375, 0.022),
    finger=(0.055, 0.014),
    boxes=(((0.0, 0.0, 0.0465), (0.0375, 0.0375, 0.0465)), ((0.0, 0.0, 0.09), (0.0135, 0.0735, 0.0225))),
    force=100.0,
)
GRIPPERS = {"franka": FRANKA_HAND, "robotiq": ROBOTIQ_2F_85}

_FORMAT = "ipjax gripper 1"
_LONGEST = 2.0  # m: of any length of a hand; beyond, they are millimetres
_FIELDS = {
    "opening_m": ("opening", "the largest width between the pads"),
    "reach_m": ("reach", "from the origin along z to the middle of the pads"),
    "pad_m": ("pad", "length along z and breadth across"),
    "finger_m": ("finger", "length along z to the tip and thickness"),
    "force_n": ("force", "the force with which it closes"),
}


def read_gripper(name: str | Path) -> Gripper:
    """One of :data:`GRIPPERS` by its name, or one's own from a JSON file such as :func:`write_gripper` makes.

    Raises:
      ValueError: neither; or the file is not readable, lacks something or has impossible numbers. Says which.
    """
    if str(name) in GRIPPERS:
        return GRIPPERS[str(name)]
    path = Path(name)
    if not path.is_file():
        raise ValueError(f"{name}: neither {', '.join(GRIPPERS)} nor a file of a gripper")
    try:
        return parse_gripper(read_json(path, "file of a gripper"))
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None


def parse_gripper(entry: Any) -> Gripper:
    """A gripper of what :func:`describe_gripper` gave.

    Raises:
      ValueError: it lacks something, or has impossible numbers; says which.
    """
    if not isinstance(entry, dict) or entry.get("format") != _FORMAT:
        raise ValueError(f'a gripper is a JSON object with "format": "{_FORMAT}"')
    closing = entry.get("closing")
    if closing not in ("x", "y"):
        raise ValueError(f'\'closing\' is the axis along which the fingers close, "x" or "y", not {closing!r}')
    values: dict[str, Any] = {}
    for key, (field, what) in _FIELDS.items():
        many = 2 if field in ("pad", "finger") else 1
        numbers = _read_numbers(entry.get(key), many, f"'{key}' ({what})")
        if min(numbers) <= 0:
            raise ValueError(f"'{key}' ({what}) is positive, not {entry[key]!r}")
        if field != "force" and max(numbers) > _LONGEST:
            raise ValueError(f"'{key}' ({what}): {max(numbers):g} m are no hand's: lengths are in metres")
        values[field] = numbers if many == 2 else numbers[0]
    if values["pad"][0] > values["finger"][0]:
        raise ValueError("'pad_m': the pads are longer along z than the fingers that they are on, 'finger_m'")
    given = entry.get("boxes", [])
    if not isinstance(given, list) or not all(isinstance(box, dict) for box in given):
        raise ValueError("'boxes' is a list of the body's boxes, each with 'centre_m' and 'half_sizes_m'")
    boxes = []
    for i, box in enumerate(given):
        centre, half = (_read_numbers(box.get(k), 3, f"box {i}: '{k}'") for k in ("centre_m", "half_sizes_m"))
        if min(half) <= 0:
            raise ValueError(f"box {i}: 'half_sizes_m' are positive, not {box['half_sizes_m']!r}")
        boxes.append((centre, half))
    return Gripper(name=str(entry.get("name", "gripper")), closing=closing, boxes=tuple(boxes), **values)


def describe_gripper(gripper: Gripper) -> dict[str, Any]:
    """A gripper as plain JSON, each length named with its unit."""
    entry: dict[str, Any] = {"format": _FORMAT, "name": gripper.name, "closing": gripper.closing}
    for key, (field, _) in _FIELDS.items():
        value = getattr(gripper, field)
        entry[key] = [float(x) for x in value] if isinstance(value, tuple) else float(value)
    entry["boxes"] = [
        {"centre_m": [float(x) for x in centre], "half_sizes_m": [float(x) for x in half]}
        for centre, half in gripper.boxes
    ]
    return entry


def write_gripper(path: str | Path, gripper: Gripper) -> Path:
    """Write a gripper as JSON, to be read by :func:`read_gripper`; returns the path. Raises OSError."""
    from ipjax.inference.reports import to_json

    return write_text(path, to_json(describe_gripper(gripper)))


def _read_numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    values = [value] if count == 1 else value
    fits = isinstance(values, list) and len(values) == count
    if not fits or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in values):
        wanted = "a number" if count == 1 else f"a list of {count} numbers"
        raise ValueError(f"{what} is {wanted}, in metres or newtons, not {value!r}")
    try:
        finite = all(math.isfinite(x) for x in values)
    except OverflowError:  # a whole number of hundreds of digits
        finite = False
    if not finite:
        raise ValueError(f"{what} is finite, not {str(value)[:40]}")
    return tuple(float(x) for x in values)
