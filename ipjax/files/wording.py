"""Lists in a sentence."""

from collections.abc import Sequence
from typing import Any


def abbreviate(names: Sequence[Any], most: int = 3) -> str:
    """The first names, and how many more there are: ``a, b, c and 4 more``."""
    said = ", ".join(str(name) for name in names[:most])
    return said if len(names) <= most else f"{said} and {len(names) - most} more"
