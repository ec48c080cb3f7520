"""Arrays as images: npy and npz files, and number types that OpenCV takes."""

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.storage.budget import check_budget


def load_npy(path: Path) -> np.ndarray:
    """The array of an npy file of numbers. Raises ValueError that names the file."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            promised = _read_promise(file)
            available = path.stat().st_size - file.tell()
            if promised > available:
                raise ValueError(f"its header promises {promised:,} bytes, and there are {available:,}")
        check_budget(3 * promised, "an array of this size")
        return np.load(path, allow_pickle=False)
    except Exception as error:  # its header is parsed as Python, which fails in many ways
        raise ValueError(f"{path}: not a readable npy file ({_first_line(error)})") from None


def load_npz(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those arrays of an npz file that it has of ``names``; what else is in it is not read.

    Raises:
        ValueError: missing, no npz file, arrays of Python objects, or more than memory allows; names the file.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    found: dict[str, np.ndarray] = {}
    name = ""
    try:
        with zipfile.ZipFile(path) as archive:
            wanted = set(names) & {member.removesuffix(".npy") for member in archive.namelist()}
            needed = 0
            for name in sorted(wanted):
                with archive.open(f"{name}.npy") as file:
                    needed += _read_promise(file)
            # A few bytes of a zip file unpack to gigabytes: what the headers promise counts, and no more is unpacked.
            check_budget(3 * needed, "arrays of this size")
            for name in sorted(wanted):
                with archive.open(f"{name}.npy") as file:
                    found[name] = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # of zip files, of compression, of headers
        inside = f"{name}: " if name else ""
        raise ValueError(f"{path}: not a readable npz file ({inside}{_first_line(error)})") from None
    return found


def _read_promise(file: Any) -> int:
    """The bytes that the header of an npy file promises; the file stands after it. Raises ValueError for objects."""
    version = np.lib.format.read_magic(file)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read_header:
        raise ValueError(f"version {version[0]}.{version[1]}")
    shape, _, dtype = read_header[version](file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, not numbers: they are pickled, and could run a program")
    promised = dtype.itemsize
    for side in shape:
        promised *= int(side)
    return promised


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def as_native(array: np.ndarray) -> np.ndarray:
    """The same numbers in this machine's byte order and in a type that OpenCV has: it looks at bytes, not at types."""
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
        return array.astype(np.float32 if array.dtype.itemsize < 4 else np.float64)
    if array.dtype.kind in "ui" and array.dtype not in (np.uint8, np.int8, np.uint16, np.int16, np.int32):
        fits = array.size == 0 or (array.min() >= -(2**31) and array.max() < 2**31)
        return array.astype(np.int32 if fits else np.float64)
    return array
