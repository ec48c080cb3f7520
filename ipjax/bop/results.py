"""BOP's result files: a line for each estimate, in millimetres and seconds; and ours, with the size in a column more.

`ResultRow` is a line as it stands. What cannot be read raises `DatasetError`: one sentence with file and line.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ipjax.bop.records import MM, DatasetError, Estimate, check_rotation
from ipjax.files.storage.writing import write_text
from ipjax.transforms import Similarity

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
SIZED_HEADER = HEADER + ",scale"  # ours: x_camera = scale · R · x_model + t


@dataclass(frozen=True)
class ResultRow:
    """A line of a BOP result file, in its own units: millimetres and seconds."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    rotation: tuple[float, ...]  # nine numbers, row-major
    translation: tuple[float, ...]  # three numbers, mm
    time: float = -1.0  # for the whole image; −1 = unknown
    line: int | None = field(default=None, compare=False)  # where it was read
    scale: float | None = field(default=None, compare=False)  # estimated over true size; None = unknown

    @property
    def camera_from_object(self) -> Similarity[np.ndarray]:
        """Metres; rigid, since BOP's errors are those of the model at its true size."""
        rotation = np.asarray(self.rotation, np.float64).reshape(3, 3)
        return Similarity(rotation, np.asarray(self.translation, np.float64) * MM, np.ones(()))


def read_results(path: str | Path, *, problems: list[str] | None = None) -> list[ResultRow]:
    """The rows of a BOP result file.

    A file of ours with the sizes (see `write_results`) has an eighth column, ``scale``.

    Raises DatasetError (file, line, what is wrong) for a wrong header, a wrong number of columns or numbers, values
    that are not finite, an R that is no rotation, rows that occur twice, or times that are negative or differ within
    an image. Give a list as ``problems`` to have such rows left out, and the sentences collected there, instead.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file") from None
    header = lines[0].strip().replace(" ", "") if lines else ""
    if header not in (HEADER, SIZED_HEADER):
        first = lines[0].strip()[:80] if lines else "nothing"
        raise DatasetError(f"{path}, line 1: the header must be {HEADER!r}, not {first!r}")
    rows: list[ResultRow] = []
    first_line: dict[tuple, int] = {}
    times: dict[tuple[int, int], tuple[float, int]] = {}
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip():
            continue
        try:
            row = _parse_row(line, number, header)
            key = (row.scene_id, row.im_id, row.obj_id, row.score, row.rotation, row.translation)
            if key in first_line:
                raise ValueError(f"the row is the same as that of line {first_line[key]}")
            time, at = times.setdefault((row.scene_id, row.im_id), (row.time, number))
            if abs(time - row.time) > 1e-3:
                raise ValueError(
                    f"time is for the whole image: {row.time:g} s here, but {time:g} s in line {at} (same image)"
                )
            first_line[key] = number
        except ValueError as error:
            message = f"{path}, line {number}: {error}"
            if problems is None:
                raise DatasetError(message) from None
            problems.append(message)
        else:
            rows.append(row)
    return rows


def write_results(path: str | Path, rows: Iterable[ResultRow], *, scales: Sequence[float] | None = None) -> Path:
    """Write a result file as BOP's toolkit does (no newline at the end), whole or not at all.

    With ``scales`` (estimated over true size, one for each row) it is no BOP file but one of ours, with a column more;
    `sized_path` says where it belongs. Raises ValueError for a scale that is not positive and finite.
    """
    if scales is None:
        return write_text(path, "\n".join([HEADER, *map(format_row, rows)]), parents=True)
    lines = [SIZED_HEADER]
    for row, scale in zip(rows, scales, strict=True):
        if not 0 < scale < math.inf:
            raise ValueError(f"scene {row.scene_id}, image {row.im_id}, object {row.obj_id}: its scale is {scale}")
        lines.append(f"{format_row(row)},{float(scale)!r}")
    return write_text(path, "\n".join(lines), parents=True)


def sized_path(path: str | Path) -> Path:
    """Where the sizes of a BOP result file are kept: next to it, as ``.sized``, not to be taken for a BOP file."""
    return Path(path).with_suffix(".sized")


def format_row(row: ResultRow) -> str:
    """One line of a result file, without its end; numbers are written so that reading them gives them back."""
    if len(row.rotation) != 9 or len(row.translation) != 3:
        raise ValueError(f"a row needs 9 and 3 numbers, got {len(row.rotation)} and {len(row.translation)}")
    numbers = (row.score, *row.rotation, *row.translation, row.time)
    if not all(math.isfinite(x) for x in numbers):
        raise ValueError(f"a result of scene {row.scene_id}, image {row.im_id}, object {row.obj_id} is not finite")
    R = " ".join(repr(float(x)) for x in row.rotation)
    t = " ".join(repr(float(x)) for x in row.translation)
    time = "-1" if row.time == -1 else repr(float(row.time))
    return f"{row.scene_id},{row.im_id},{row.obj_id},{float(row.score)!r},{R},{t},{time}"


def as_row(scene_id: int, im_id: int, estimate: Estimate, time: float = -1.0) -> ResultRow:
    """An estimate as a row: metres become millimetres. A BOP row has no place for the scale."""
    rotation = np.asarray(estimate.rotation, np.float64).reshape(9)
    translation = np.asarray(estimate.translation_m, np.float64).reshape(3) * 1000
    return ResultRow(
        scene_id, im_id, estimate.obj_id, float(estimate.score), tuple(rotation), tuple(translation), float(time)
    )


def _parse_row(line: str, number: int, header: str = HEADER) -> ResultRow:
    columns = line.strip().split(",")
    expected = header.count(",") + 1
    if len(columns) != expected:
        raise ValueError(f"{expected} columns are expected ({header}), got {len(columns)}")
    whole = []
    for name, text in zip(("scene_id", "im_id", "obj_id"), columns[:3], strict=True):
        if not re.fullmatch(r"\s*\d+\s*", text):
            raise ValueError(f"{name} must be a whole number, got {text!r}")
        whole.append(int(text))
    score = _parse_numbers(columns[3], 1, "score")[0]
    rotation = _parse_numbers(columns[4], 9, "R")
    translation = _parse_numbers(columns[5], 3, "t")
    check_rotation(rotation)
    time = _parse_numbers(columns[6], 1, "time")[0]
    if time < 0 and time != -1:
        raise ValueError(f"time must be seconds, or -1 where it is unknown, got {time:g}")
    scale = _parse_numbers(columns[7], 1, "scale")[0] if expected == 8 else None
    if scale is not None and not scale > 0:
        raise ValueError(f"scale must be positive, got {scale:g}")
    return ResultRow(whole[0], whole[1], whole[2], score, rotation, translation, time, number, scale)


def _parse_numbers(text: str, count: int, name: str) -> tuple[float, ...]:
    parts = text.split()
    if len(parts) != count:
        raise ValueError(f"{name} must hold {count} number{'s' if count > 1 else ''}, got {len(parts)}")
    try:
        numbers = tuple(float(part) for part in parts if "_" not in part)
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise ValueError(f"{name} holds something that is no number: {text.strip()[:60]!r}")
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} holds a number that is not finite: {text.strip()[:60]!r}")
    return numbers
