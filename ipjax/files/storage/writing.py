"""Files that appear whole or not at all, also after a crash and with several writers."""

import contextlib
import json
import os
import re
import secrets
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Names of unfinished files: hidden, and with the ending of the file that they become.
_UNFINISHED = re.compile(r"\..*\.[0-9a-f]{12}\.part(\..*)?", re.DOTALL)
_ABANDONED = 24 * 3600  # seconds without a change, after which the writer of an unfinished file counts as killed
_SEARCH_AGAIN = 3600  # seconds until a folder is searched for abandoned files once more
_searched: dict[Path, float] = {}  # folder: when it was


@contextlib.contextmanager
def writing(path: str | Path, *, parents: bool = False) -> Iterator[Path]:
    """Write a file that appears whole or not at all, also after a crash and with several writers.

    Yields a name of its own in the same folder, with the same ending, with an empty file. When the block ends,
    what was written there is flushed to disc and gets the name ``path``; when the block fails, it is removed.

    What earlier writers left unfinished in the folder because they were killed is removed, once it is a day old.

    Args:
        path: an existing file is replaced.
        parents: make the folder, too, if it is missing.

    Raises:
        OSError: it cannot be written; the error names ``path``.
    """
    path = Path(path)
    if parents:
        path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(path.parent)
    temporary = path.with_name(f".{path.stem[:48]}.{secrets.token_hex(6)}.part{path.suffix[:16]}")
    try:
        # Opened by hand so that the system's umask decides who may read the file, as for any other.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None
    try:
        yield temporary
        publish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def publish(temporary: str | Path, path: str | Path) -> None:
    """Flush a finished file to disc and give it its name, replacing what had it; both lie in the same folder.

    Raises:
        OSError: it cannot be done.
    """
    with open(temporary, "rb+") as file:
        os.fsync(file.fileno())
    try:
        os.replace(temporary, path)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None
    with contextlib.suppress(OSError):  # the name, too; not every system lets a folder be flushed
        folder = os.open(Path(path).parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_bytes(path: str | Path, data: bytes, *, parents: bool = False) -> Path:
    """Write a file through `writing`; returns its path. Raises OSError."""
    with writing(path, parents=parents) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def write_text(path: str | Path, text: str, *, parents: bool = False) -> Path:
    """Write UTF-8 text through `writing`, line ends as they are; returns its path. Raises OSError."""
    return write_bytes(path, text.encode("utf-8"), parents=parents)


def append_json(path: str | Path, *entries: Any) -> None:
    """Append entries to a file of JSON lines; when this returns they are on disc. `read_lines` reads them.

    Where they cannot be written as a whole, as on a disc that is full, nothing of them is left in the file.

    Raises:
        ValueError: an entry has a number that JSON has not (NaN, an infinity).
        OSError: the file cannot be written.
    """
    data = "".join(json.dumps(entry, allow_nan=False) + "\n" for entry in entries).encode()
    size = os.path.getsize(path) if os.path.exists(path) else 0
    try:
        with open(path, "ab") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        with contextlib.suppress(OSError):
            os.truncate(path, size)
        raise


def read_lines(path: str | Path, *, repair: bool = False) -> list[str]:
    """The lines of a file that `append_json` wrote, without one at its end that a crash cut short.

    Args:
        repair: cut such a line off the file, too, so that what is appended next begins on a line of its own.

    Raises:
        OSError: the file cannot be read, or not be repaired.
        ValueError: it is no text.
    """
    path = Path(path)
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if repair and len(whole) < len(data):
        with open(path, "r+b") as file:
            file.truncate(len(whole))
    return whole.decode("utf-8").splitlines()


def _remove_abandoned(folder: Path) -> None:
    """Remove unfinished files that have not changed for a day; a folder is searched once an hour."""
    now = time.monotonic()
    if now - _searched.get(folder, -_SEARCH_AGAIN) < _SEARCH_AGAIN:
        return
    _searched[folder] = now
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if not _UNFINISHED.fullmatch(entry.name):
                continue
            with contextlib.suppress(OSError):
                if time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED:
                    os.unlink(entry.path)
