"""Where ipjax keeps what it can make or fetch again: weights, compiled programs, objects of BOP meshes."""

import os
from pathlib import Path


def cache_folder(kind: str = "") -> Path:
    """The cache, or its folder for one kind of files, such as "weights"; not created here.

    The environment's IPJAX_CACHE decides, else the operating system: ``$XDG_CACHE_HOME/ipjax`` or ``~/.cache/ipjax`` on
    Linux, ``~/Library/Caches/ipjax`` on macOS, ``%LOCALAPPDATA%\\ipjax\\Cache`` on Windows.
    """
    if own := os.environ.get("IPJAX_CACHE"):
        return Path(own).expanduser() / kind
    from platformdirs import user_cache_path

    return user_cache_path("ipjax", appauthor=False) / kind
