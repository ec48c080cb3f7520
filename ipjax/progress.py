"""Progress bars that do not fill a log."""

import sys
from collections.abc import Iterable
from typing import Any


def bar(items: Iterable | None = None, **settings: Any) -> Any:
    """``tqdm.tqdm``; where the error stream is no terminal, it prints only every half minute."""
    from tqdm import tqdm

    if not sys.stderr.isatty():
        settings = {"mininterval": 30.0, "maxinterval": 30.0} | settings
    return tqdm(items, **settings)
