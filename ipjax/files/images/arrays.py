"""Arrays as images: npy files, and number types that OpenCV takes."""

from pathlib import Path

import numpy as np

from ipjax.files.storage.budget import check_budget


def load_npy(path: Path) -> np.ndarray:
    """The array of an npy file of numbers. Raises ValueError that names the file."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            if version not in read_header:
                raise ValueError(f"version {version[0]}.{version[1]}")
            shape, _, dtype = read_header[version](file)
            if dtype.hasobject:
                raise ValueError("it holds Python objects, not numbers")
            promised = dtype.itemsize
            for side in shape:
                promised *= int(side)
            available = path.stat().st_size - file.tell()
            if promised > available:
                raise ValueError(f"its header promises {promised:,} bytes, and there are {available:,}")
        check_budget(3 * promised, "an array of this size")
        return np.load(path, allow_pickle=False)
    except Exception as error:  # its header is parsed as Python, which fails in many ways
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path}: not a readable npy file ({reason})") from None


def as_native(array: np.ndarray) -> np.ndarray:
    """The same numbers in this machine's byte order and in a type that OpenCV has: it looks at bytes, not at types."""
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
        return array.astype(np.float32 if array.dtype.itemsize < 4 else np.float64)
    if array.dtype.kind in "ui" and array.dtype not in (np.uint8, np.int8, np.uint16, np.int16, np.int32):
        fits = array.size == 0 or (array.min() >= -(2**31) and array.max() < 2**31)
        return array.astype(np.int32 if fits else np.float64)
    return array
