"""Depth images, in the number type of their file; `ipjax.frame` converts the unit by ``depth_scale``."""

import struct
from pathlib import Path

import numpy as np

from ipjax.files.images.arrays import as_native, load_npy
from ipjax.files.images.opening import ORIENTATION, check_upright, get_orientation, open_image, undo_stretching
from ipjax.files.storage.budget import check_budget

# The largest numbers of the types that depth is stored in, also where it has become another type since.
_LARGEST_NUMBERS = {float(2**bits - 1) for bits in (15, 16, 31, 32)}
_LARGEST_NUMBERS |= {float(np.float32(value)) for value in (2**31 - 1, 2**32 - 1)} | {float(np.finfo(np.float32).max)}


def read_depth(path: str | Path, content: bytes | None = None) -> np.ndarray:
    """A depth image as its file stores it, in this machine's byte order: uint16 (PNG, TIFF), other integers or floats
    (TIFF, npy), height × width.

    Args:
        path: of the file.
        content: of the file, where it lies in another, such as an archive: a PNG.

    Raises:
        ValueError: missing, unreadable, 8-bit, coloured, or turned by its EXIF orientation; names the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy" and content is None:
        depth = load_npy(path)
    elif path.suffix.lower() == ".exr":
        raise ValueError(f"{path}: EXR is not supported; save the depth as 16-bit PNG, float TIFF or npy")
    else:
        depth = _read_wide_tiff(path) if content is None else None
        if depth is None:
            image = open_image(path, content=content)
            check_upright(get_orientation(image), path)
            if image.mode not in ("I;16", "I;16B", "I;16L", "I;16N", "I", "F"):
                raise ValueError(f"{path}: depth must be 16-bit or float with one channel, not 8-bit {image.mode}")
            depth = undo_stretching(image, path) if content is None else np.array(image)
            if image.mode == "I" and depth.min() >= 0 and depth.max() < 65536:
                depth = depth.astype(np.uint16)
    if depth.ndim == 3 and depth.shape[-1] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"{path}: depth must be height × width, not {' × '.join(map(str, depth.shape))}")
    if depth.dtype.kind not in "uif":
        raise ValueError(f"{path}: depth must be numbers, not {depth.dtype}")
    return as_native(depth)


def remove_sentinel(depth: np.ndarray) -> tuple[np.ndarray, str]:
    """Depth without a number that stands for "unknown": one extreme value on many pixels.

    The largest number of its type (65535) is one wherever it occurs; another value is where it fills a twentieth of the
    image and is far beyond (half as much again) or below (a fifth of) all others.

    Args:
        depth: height × width, numbers, any unit; 0 and what is negative or not finite is unknown already.

    Returns:
        The depth with 0 in these pixels (the array itself where there are none), and a sentence, or "".
    """
    known = depth > 0
    if depth.dtype.kind == "f":
        known &= np.isfinite(depth)
    values = depth[known]
    if values.size == 0:
        return depth, ""
    found = []
    for others in (np.max, np.min):
        extreme = others(values)
        same = values == extreme
        rest = values[~same]
        is_sentinel = others is np.max and float(extreme) in _LARGEST_NUMBERS
        if not is_sentinel and rest.size and same.sum() >= 0.05 * depth.size:
            is_sentinel = extreme >= 1.5 * others(rest) if others is np.max else extreme <= 0.2 * others(rest)
        if is_sentinel:
            found.append(extreme)
            values = rest
        if values.size == 0:
            break
    if not found:
        return depth, ""
    depth = depth.copy()
    counts = []
    for extreme in found:
        same = depth == extreme
        counts.append(f"{extreme:g} on {same.mean():.0%} of the pixels")
        depth[same] = 0
    return depth, f"depth of {' and '.join(counts)} is taken for unknown"


def _read_wide_tiff(path: Path) -> np.ndarray | None:
    """Depth from a TIFF of a number type that Pillow does not know (64-bit floats, signed 16 bits); None = no such."""
    tags = _read_tiff_tags(path)
    if tags is None:
        return None
    width, height, bits, samples, kind = (tags[number] for number in (256, 257, 258, 277, 339))
    if samples != 1 or (bits, kind) in ((8, 1), (16, 1), (32, 3), (32, 2)) or bits < 16:
        return None
    import cv2

    check_upright(tags[ORIENTATION], path)
    check_budget(3 * (bits // 8) * width * height, f"{path}: an image of {width} × {height} pixels")
    level = cv2.utils.logging.getLogLevel()
    try:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it prints what it cannot read
        depth = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        depth = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if depth is None or depth.shape[:2] != (height, width):
        name = {1: "unsigned", 2: "signed", 3: "floating-point"}.get(kind, "unknown")
        raise ValueError(f"{path}: a TIFF of {bits}-bit {name} numbers cannot be read; save it as 16-bit or float32")
    return depth


def _read_tiff_tags(path: Path) -> dict[int, int] | None:
    """Of a TIFF's first image: width (256), height (257), bits (258) and samples (277) per pixel, kind of number (339:
    1 unsigned, 2 signed, 3 float), orientation (274); None where it is no classic TIFF."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(8)
            order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
            if order is None or len(head) < 8:
                return None
            (start,) = struct.unpack(order + "I", head[4:])
            if not 8 <= start <= size - 2:
                return None
            file.seek(start)
            (count,) = struct.unpack(order + "H", file.read(2))
            block = file.read(12 * count)
    except (OSError, struct.error):
        return None
    tags = {256: 0, 257: 0, 258: 1, 277: 1, 339: 1, ORIENTATION: 1}
    for at in range(0, len(block) - 11, 12):
        tag, kind, number = struct.unpack(order + "HHI", block[at : at + 8])
        if tag in tags and kind in (3, 4) and number == 1:
            (tags[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), block, at + 8)
    return tags
