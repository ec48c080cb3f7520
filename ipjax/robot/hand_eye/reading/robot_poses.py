"""A robot's poses from files: JSON, YAML, CSV or plain rows of numbers, by the names of images or in their order."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.rigid import FARTHEST, UNITS, check_unit, to_rigid
from ipjax.files.storage.parsing import parse, read_text
from ipjax.files.wording import abbreviate
from ipjax.robot.hand_eye.reading.pose_forms import Form, RawPose, read_pose, to_rotation
from ipjax.robot.hand_eye.records import HandEyeError
from ipjax.transforms import Similarity

_NAMES = {
    "name",
    "image",
    "file",
    "filename",
    "imagename",
    "imagefile",
    "imagepath",
    "frame",
    "id",
    "time",
    "timestamp",
}
_NEAREST = 5.0  # metres: no hand is farther from its base, and none in millimetres is nearer in all poses
_TURN = 2 * np.pi + 1e-3  # no angle in radians is larger


@dataclasses.dataclass(frozen=True)
class RobotPoses:
    """The poses of a robot's hand."""

    base_from_gripper: Similarity[np.ndarray]  # [n], rigid, metres
    names: tuple[str, ...] | None  # of the images that they belong to; None = they are in the images' order
    notes: tuple[str, ...] = ()  # what was decided on the way, a sentence each


def read_robot_poses(path: str | Path, form: Form | None = None) -> RobotPoses:
    """The robot's poses of a file.

    Args:
      path: JSON or YAML with a list of poses or a dictionary of them by name; CSV with or without a first row of
        names; or rows of numbers.
      form: what its numbers mean, where they do not say it themselves.

    Raises:
      HandEyeError: unreadable, no poses, numbers that may mean several things, or no rigid motions; names the file.
    """
    form = form or Form()
    try:
        text = read_text(path, "file of robot poses")
        rows, unit = _read_rows(text, form)
    except ValueError as error:
        said = str(error)
        raise HandEyeError(said if said.startswith(str(path)) else f"{path}: {said}") from None
    if not rows:
        raise HandEyeError(f"{path}: there are no poses in it")
    raw: list[RawPose] = []
    places = [f"pose {i + 1}" if name is None else f"pose {name}" for i, (name, _) in enumerate(rows)]
    for place, (_, value) in zip(places, rows, strict=True):
        try:
            raw.append(read_pose(value, form))
        except ValueError as error:
            raise HandEyeError(f"{path}: {place}: {error}") from None
    names = [name for name, _ in rows]
    if None in names and any(name is not None for name in names):
        raise HandEyeError(f"{path}: some poses have names and others have none")
    try:
        scale, notes = _find_unit(np.stack([pose.position for pose in raw]), form.unit or unit)
        degrees, more = _find_angles(raw, form.angles)
    except ValueError as error:
        raise HandEyeError(f"{path}: {error}") from None
    matrices = np.tile(np.eye(4), (len(raw), 1, 1))
    for matrix, pose, place in zip(matrices, raw, places, strict=True):
        try:
            matrix[:3, :3], matrix[:3, 3] = to_rotation(pose, degrees), scale * pose.position
            to_rigid(matrix)
        except ValueError as error:
            raise HandEyeError(f"{path}: {place}: {error}") from None
    known = None if names[0] is None else tuple(map(str, names))
    if known is not None and len(set(known)) < len(known):
        twice = next(name for name in known if known.count(name) > 1)
        raise HandEyeError(f"{path}: there are two poses of {twice}")
    return RobotPoses(to_rigid(matrices), known, (*notes, *more))


def pair(images: Sequence[Path], poses: RobotPoses) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Which image belongs to which pose by name: numbers of both, and what was left over, in sentences.

    Raises:
      HandEyeError: no image has the name of a pose.
    """
    assert poses.names is not None
    by_name: dict[str, int] = {}
    for number, name in enumerate(poses.names):
        stem = Path(name).stem if "." in name and not re.fullmatch(r"[\d.]+", name) else name
        for key in (name, Path(name).name, stem, *_as_number(stem)):
            by_name.setdefault(key, number)
    found = []
    for path in images:
        keys = (path.name, path.stem, *_as_number(path.stem))
        found.append(next((by_name[key] for key in keys if key in by_name), -1))
    numbers = np.array(found)
    if (numbers < 0).all():
        raise HandEyeError(
            f"no image has the name of a pose: images are called {images[0].name} …, poses {poses.names[0]} …"
        )
    if len(set(numbers[numbers >= 0].tolist())) < (numbers >= 0).sum():
        twice = next(n for n in found if n >= 0 and found.count(n) > 1)
        raise HandEyeError(f"two images have the name of pose {poses.names[twice]}; give one of them")
    notes = [f"{path.stem}: there is no pose of this name" for path, n in zip(images, found, strict=True) if n < 0]
    unused = [name for number, name in enumerate(poses.names) if number not in found]
    if unused:
        notes.append(f"no image of the pose of {abbreviate(unused, 6)}")
    used = np.flatnonzero(numbers >= 0)
    return used, numbers[used], notes


def _as_number(stem: str) -> tuple[str, ...]:
    """The one number in a name, under which 7, 007 and img_7 are the same."""
    numbers = re.findall(r"\d+", stem)
    return (f"#{int(numbers[0])}",) if len(numbers) == 1 else ()


def _read_rows(text: str, form: Form) -> tuple[list[tuple[str | None, Any]], str | None]:
    """Names (None = in order) and what is said of each pose; and the unit, where the file tells it."""
    if not text.strip():
        raise ValueError("the file is empty")
    if text.lstrip()[0] not in "[{" and not re.match(r"\s*(-\s|[\w./\"']+\s*:(\s|$))", text):
        return _read_table(text, form), None
    document, unit = parse(text), None
    if isinstance(document, Mapping):
        unit = document.get("unit", document.get("units"))
        if unit is not None:
            check_unit(unit)
        inner = next((document[key] for key in ("poses", "base_from_gripper", "robot_poses") if key in document), None)
        document = {k: v for k, v in document.items() if k not in ("unit", "units")} if inner is None else inner
    if isinstance(document, Mapping):
        return [(str(name), value) for name, value in document.items()], unit
    if not isinstance(document, list):
        raise ValueError("a list of poses, or a dictionary of them by the images' names, is expected")
    return [_take_name(item) for item in document], unit


def _take_name(item: Any) -> tuple[str | None, Any]:
    if isinstance(item, Mapping):
        for key in item:
            if re.sub(r"[^a-z]", "", str(key).lower()) in _NAMES and isinstance(item[key], str | int | float):
                return str(item[key]), {k: v for k, v in item.items() if k != key}
    return None, item


def _read_table(text: str, form: Form) -> list[tuple[str | None, Any]]:
    lines = [line.split("#")[0].strip() if not line.startswith("#") else line[1:].strip() for line in text.splitlines()]
    comment = [line.startswith("#") for line in text.splitlines()]
    mark = ";" if ";" in text else "," if "," in text else None
    table: list[list[str]] = []
    heads: list[str] | None = None
    for number, (line, is_comment) in enumerate(zip(lines, comment, strict=True), 1):
        cells = [cell.strip().strip("\"'") for cell in line.split(mark)] if line else []
        cells = cells[:-1] if cells and cells[-1] == "" else cells
        words = [cell for cell in cells if not _is_number(cell)]
        if not cells or (is_comment and (table or len(words) < 6)):
            continue
        if len(words) >= 3 and not table and heads is None:
            heads = cells
        elif is_comment:
            continue
        elif len(words) > 1 or (words and words[0] != cells[0]):
            raise ValueError(f"line {number}: numbers are expected, not {line[:60]!r}")
        elif heads is not None and len(cells) != len(heads):
            raise ValueError(f"line {number}: {len(cells)} entries, but the first row names {len(heads)}")
        else:
            table.append(cells)
    if heads is not None:
        return [_take_name(dict(zip(heads, row, strict=True))) for row in table]
    if table and all(len(row) == 4 and all(map(_is_number, row)) for row in table) and len(table) % 4 == 0:
        numbers = np.array(table, np.float64)  # matrices, one below the other
        return [(None, numbers[i : i + 4]) for i in range(0, len(table), 4)]
    return [_split_row(row, form) for row in table]


def _split_row(row: list[str], form: Form) -> tuple[str | None, Any]:
    """The name, where there is one before the numbers, and the numbers."""
    usual = (12, 16) if not form.width else (12, 16, 3 + form.width)
    if not _is_number(row[0]) or (len(row) not in usual and len(row) - 1 in usual):
        return row[0], [float(cell) for cell in row[1:]]
    return None, [float(cell) for cell in row]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _find_unit(positions: np.ndarray, unit: str | None) -> tuple[float, list[str]]:
    """Metres per unit, and what was decided."""
    far = float(np.linalg.norm(positions, axis=1).max())
    if unit is None:
        if _NEAREST < far <= FARTHEST:
            raise ValueError(f"positions up to {far:.3g} from the base may be metres or millimetres: say --unit")
        unit = "m" if far <= _NEAREST else "mm"
        return UNITS[unit], [f"robot positions are taken for millimetres (up to {far:.0f})"] if unit == "mm" else []
    if UNITS[unit] * far > FARTHEST:
        raise ValueError(f"a hand {UNITS[unit] * far:.0f} m from its base: the positions are not in {unit}")
    return UNITS[unit], []


def _find_angles(raw: Sequence[RawPose], angles: str | None) -> tuple[bool, list[str]]:
    """Whether angles are in degrees, and what was decided."""
    given = [np.abs(pose.rotation).max() for pose in raw if pose.kind not in ("matrix", "xyzw", "wxyz")]
    if not given:
        return False, []
    if angles is None:
        unit = "degrees" if max(given) > _TURN else "radians"
        return unit == "degrees", [f"robot angles are taken for {unit} (up to {max(given):.3g})"]
    if angles == "rad" and max(given) > 2 * _TURN:
        raise ValueError(f"angles up to {max(given):.4g} are not in radians")
    return angles == "deg", []
