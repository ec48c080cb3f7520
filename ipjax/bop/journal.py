"""What a run over a data set has finished, kept so that it can be killed at any moment and go on."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipjax.bop.records import DatasetError
from ipjax.bop.results import ResultRow
from ipjax.files.storage.locks import locked
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines


@dataclass(frozen=True)
class Done:
    """A finished image: its rows with their scales, and what went wrong, if anything."""

    rows: list[tuple[ResultRow, float]]
    seconds: float
    error: str | None


class Journal:
    """What has been done, a line of JSON per image, appended and flushed to disc as a whole.

    A line that a crash cut short is dropped. Raises DatasetError where the file belongs to other settings and
    ``restart`` is "never".
    """

    def __init__(self, path: Path, head: Mapping[str, Any], restart: str = "never"):
        self.path = path
        self.restart = restart
        if restart == "always":
            path.unlink(missing_ok=True)
        self.done: dict[tuple[int, int], Done] = {}
        head = json.loads(json.dumps(head))
        if path.is_file():
            lines = read_lines(path, repair=True)
            if lines and self._read(lines, head):
                return
            path.unlink()
        append_json(path, head)

    def append(
        self, image: tuple[int, int], rows: list[tuple[ResultRow, float]], seconds: float, error: str | None
    ) -> None:
        """Record an image; when this returns it is on disc."""
        estimates = [[r.obj_id, r.score, list(r.rotation), list(r.translation), s] for r, s in rows]
        append_json(self.path, {"image": list(image), "seconds": seconds, "error": error, "estimates": estimates})
        self.done[image] = Done(rows, seconds, error)

    def _read(self, lines: list[str], head: Mapping[str, Any]) -> bool:
        """Take over the finished images; False where other settings made them and a restart is allowed."""
        differs: list[str] = []
        for number, line in enumerate(lines, start=1):
            try:
                entry = parse_json(line)
                if number == 1:
                    differs = list_differences(entry, head)
                else:
                    scene, image = entry["image"]
                    rows = [
                        (ResultRow(scene, image, obj, s, tuple(R), tuple(t), entry["seconds"]), scale)
                        for obj, s, R, t, scale in entry["estimates"]
                    ]
                    self.done[scene, image] = Done(rows, entry["seconds"], entry["error"])
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise DatasetError(
                    f"{self.path}, line {number}: damaged ({error}); delete the line to redo it"
                ) from None
            if number == 1 and differs:
                if self.restart == "changed":
                    return False
                what = ", ".join(differs[:3]) + (" …" if len(differs) > 3 else "")
                raise DatasetError(
                    f"{self.path}: these results were made with other settings ({what}); choose another folder, or "
                    "restart"
                )
        return True


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """One run at a time in a folder; the lock goes with the process, however it ends."""
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(folder / ".lock", wait=False))
        except BlockingIOError:
            raise DatasetError(f"{folder}: another run is writing here") from None
        yield


def list_differences(old: Any, new: Any, where: str = "") -> list[str]:
    """The names of what differs in two dictionaries of plain JSON."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return [] if old == new else [where]
    names = [name for name in {**new, **old} if where or name in new]
    return [d for n in names for d in list_differences(old.get(n), new.get(n), f"{where}.{n}" if where else n)]
