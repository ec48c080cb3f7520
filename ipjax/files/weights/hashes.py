"""Checksums of files; those of large files are remembered in the cache."""

import contextlib
import hashlib
import json
import re
import time
from pathlib import Path

from ipjax.files.storage.cache import cache_folder
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text

_CACHED_FROM = 2**22  # bytes from which a file's sha256 is remembered
_SETTLED = 2_000_000_000  # nanoseconds since the last change, after which a further one changes the file's times


def hash_file(path: str | Path) -> str:
    """The sha256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def cached_hash(path: str | Path) -> str:
    """`hash_file`, kept in the cache for a large file as long as its size and times stay the same.

    A file that was changed a moment ago is hashed and not kept: another change now could leave its times the same.
    """
    path = Path(path).resolve()
    status = path.stat()
    if status.st_size < _CACHED_FROM:
        return hash_file(path)
    state = {"path": str(path), "size": status.st_size, "changed": [status.st_mtime_ns, status.st_ctime_ns]}
    kept = cache_folder("hashes") / f"{hashlib.sha256(str(path).encode()).hexdigest()[:32]}.json"
    with contextlib.suppress(ValueError):  # missing or damaged: hashed again
        entry = read_json(kept)
        if isinstance(entry, dict) and {name: entry.get(name) for name in state} == state:
            found = entry.get("sha256")
            if isinstance(found, str) and re.fullmatch("[0-9a-f]{64}", found):
                return found
    found = hash_file(path)
    if time.time_ns() - max(state["changed"]) > _SETTLED:
        with contextlib.suppress(OSError):  # slower the next time, but no reason to fail
            write_text(kept, json.dumps(state | {"sha256": found}), parents=True)
    return found
