"""What a worker has done of a shard, frame by frame, so that it can be killed at any moment and go on."""

import errno
import os
from collections.abc import Sequence
from pathlib import Path

from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines
from ipjax.labelling.entries import Entry

_FULL = (errno.ENOSPC, errno.EDQUOT)


class Ledger:
    """Entries of frames in their order, a line each, whole batches at a time; then those that were tried again.

    What a crash left of a batch is cut off, so that the batches after it are those of an undisturbed run.

    Args:
        path: of the file.
        frames: of the shard.
        batch: frames that are labelled at a time.

    Raises:
        ValueError: a line is damaged.
    """

    def __init__(self, path: Path, frames: int, batch: int):
        self.path, self.frames = path, frames
        lines = read_lines(path, repair=True) if path.is_file() else []
        kept = lines if len(lines) >= frames else lines[: len(lines) // batch * batch]
        if len(kept) < len(lines):
            os.truncate(path, sum(len(line.encode()) + 1 for line in kept))
        try:
            self.entries: list[Entry] = [_parse(line) for line in kept]
        except ValueError as error:
            raise ValueError(f"{path}: damaged ({error}); remove it to label this shard again") from None

    @property
    def done(self) -> int:
        """Frames that were labelled, or found to be bad."""
        return min(len(self.entries), self.frames)

    def append(self, entries: Sequence[Entry]) -> None:
        """Keep entries; when this returns they are on disc. Raises OSError, and then nothing of them is kept."""
        append_json(self.path, *entries)
        self.entries += entries

    def to_try_again(self) -> list[int]:
        """The places of bad frames that have not been tried a second time."""
        tried = {entry["name"] for entry in self.entries[self.frames :]}
        return [
            place
            for place, entry in enumerate(self.entries[: self.frames])
            if entry["error"] and entry["name"] not in tried
        ]

    def collect(self) -> list[Entry]:
        """The last entry of every frame, in the order of the frames."""
        again = {entry["name"]: entry for entry in self.entries[self.frames :]}
        return [again.get(entry["name"], entry) for entry in self.entries[: self.frames]]


def _parse(line: str) -> Entry:
    entry = parse_json(line)
    if not isinstance(entry, dict) or not {"name", "error"} <= entry.keys():
        raise ValueError("a line is no frame")
    return entry


def in_words(error: OSError, folder: Path) -> OSError:
    """An error of writing; of a disc that is full, in a sentence that says what to do."""
    if error.errno not in _FULL:
        return error
    said = "the disk is full: free some space and run the same command again; all labels that are finished are kept"
    return OSError(error.errno, said, str(folder))
