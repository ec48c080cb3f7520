"""Folders that appear whole or not at all."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def writing_folder(path: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """Write a folder that appears whole or not at all, also after a crash.

    Yields an empty folder beside it, which gets the name ``path`` when the block ends, and is removed when it fails.
    What killed writers of the same folder left is removed first.

    Args:
      path: its parents are made.
      replace: a folder that is there gives way; otherwise it is an error, unless it is empty.

    Raises:
      OSError: it is there already, or cannot be written; the error names ``path``.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not replace and not (path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(f"{path}: is there already")
    for left in path.parent.glob(f".{path.name}.*.part"):
        shutil.rmtree(left, ignore_errors=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    temporary.mkdir()
    try:
        yield temporary
        if path.is_dir():
            # A folder with files in it cannot be replaced in one step: it steps aside first.
            aside = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
            os.rename(path, aside)
            os.rename(temporary, path)
            shutil.rmtree(aside, ignore_errors=True)
        else:
            os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
