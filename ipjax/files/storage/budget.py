"""How much memory one file may take, estimated from its first bytes or its text before anything is allocated.

A file of a few bytes can promise gigabytes.
"""

import os
from pathlib import Path

_MB = 2**20
_DEFAULT = 640 * _MB
_MAX_HEADER = 8 * _MB  # of a safetensors file; a thousand tensors take 0.1 MB


def budget() -> int:
    """Bytes of memory that one file may take: 640 MB, or the environment's IPJAX_FILE_BUDGET in MB.

    Raises:
        ValueError: IPJAX_FILE_BUDGET is no positive number.
    """
    given = os.environ.get("IPJAX_FILE_BUDGET", "").strip()
    if not given:
        return _DEFAULT
    if not given.isdigit() or int(given) == 0:
        raise ValueError(f"IPJAX_FILE_BUDGET is a whole number of MB, not {given!r}")
    return int(given) * _MB


def check_budget(needed: int, what: str) -> None:
    """Refuse what would take more memory than one file may.

    Args:
        needed: bytes, estimated before they are allocated.
        what: begins the sentence, such as "mug.png: an image of 60000 × 60000 pixels".

    Raises:
        ValueError: too much; names the budget and how to raise it.
    """
    allowed = budget()
    if needed > allowed:
        raise ValueError(
            f"{what} would take {-(-needed // _MB):,} MB of memory, more than the {allowed // _MB:,} MB allowed for "
            "one file; reduce it, or set IPJAX_FILE_BUDGET (MB) if you trust it"
        )


def check_tensors(path: str | Path, needed: int) -> None:
    """Refuse tensors that would take more memory than their file could fill: many may share one place in it.

    Files of weights may be larger than the budget of other files. Honest tensors take at most the size of their file,
    and twice that where two names share one.

    Args:
        needed: bytes of all tensors.

    Raises:
        ValueError: too much; names the file.
    """
    size = Path(path).stat().st_size
    if needed > 2 * size + _MB:
        raise ValueError(
            f"{path}: its tensors would take {-(-needed // _MB):,} MB of memory, but the file has only "
            f"{-(-size // _MB):,} MB"
        )


def read_safetensors_header(path: str | Path) -> int:
    """The length of the description at the head of a safetensors file, bytes, before anything parses it.

    Raises:
        ValueError: longer than the file, or than any valid file needs; does not name the file.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
    if length > min(_MAX_HEADER, max(Path(path).stat().st_size - 8, 0)):
        raise ValueError(f"it would begin with {length:,} bytes of description")
    return length
