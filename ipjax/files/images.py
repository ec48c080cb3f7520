"""Reading what a sensor wrote: colour, depth and mask images.

Every reader raises one sentence of `ValueError` that names the file, and none allocates more than `storage.budget`.
Depth keeps the number type of its file; its unit is settled in `frames.frame`, by ``depth_scale`` (metres per unit).
"""

import re
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from ipjax.files.camera_files import Intrinsics, as_intrinsics, read_camera
from ipjax.files.storage.budget import check_budget

__all__ = [
    "BYTES_PER_PIXEL",
    "Intrinsics",
    "as_intrinsics",
    "as_mask",
    "as_native",
    "check_mask",
    "forget_sentinel",
    "get_orientation",
    "open_image",
    "read_camera",
    "read_depth",
    "read_mask",
    "read_rgb",
    "read_size",
]

BYTES_PER_PIXEL = 12  # of memory while an image is decoded, converted and copied
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM")  # Pillow knows more, some of which run programs
_ORIENTATION = 0x0112  # EXIF
_TURN = "ipjax orientation"  # among what Pillow knows of an image
# The largest numbers of the types that depth is stored in, also where it has become another type since.
_LARGEST = {float(2**bits - 1) for bits in (15, 16, 31, 32)}
_LARGEST |= {float(np.float32(value)) for value in (2**31 - 1, 2**32 - 1)} | {float(np.finfo(np.float32).max)}


def read_rgb(path: str | Path) -> np.ndarray:
    """A colour image as uint8, height × width × 3, as it is stored; transparency dropped.

    Raises:
        ValueError: missing, unreadable, absurd, or to be turned according to its EXIF orientation; names the file.
    """
    image = open_image(path)
    _check_upright(get_orientation(image), path)
    if image.mode.startswith("I") or image.mode == "F":
        raise ValueError(f"{path}: a one-channel image of more than 8 bits is no colour image; is this the depth?")
    return np.array(image.convert("RGB"))


def read_depth(path: str | Path) -> np.ndarray:
    """A depth image as its file stores it, in this machine's byte order: uint16 (PNG, TIFF), other integers or floats
    (TIFF, npy), height × width.

    Raises:
        ValueError: missing, unreadable, 8-bit, coloured, or turned by its EXIF orientation; names the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        depth = _load_npy(path)
    elif path.suffix.lower() == ".exr":
        raise ValueError(f"{path}: EXR is not supported; save the depth as 16-bit PNG, float TIFF or npy")
    else:
        depth = _wide_tiff(path)
        if depth is None:
            image = open_image(path)
            _check_upright(get_orientation(image), path)
            if image.mode not in ("I;16", "I;16B", "I;16L", "I;16N", "I", "F"):
                raise ValueError(f"{path}: depth must be 16-bit or float with one channel, not 8-bit {image.mode}")
            depth = _unstretched(image, path)
            if image.mode == "I" and depth.min() >= 0 and depth.max() < 65536:
                depth = depth.astype(np.uint16)
    if depth.ndim == 3 and depth.shape[-1] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"{path}: depth must be height × width, not {' × '.join(map(str, depth.shape))}")
    if depth.dtype.kind not in "uif":
        raise ValueError(f"{path}: depth must be numbers, not {depth.dtype}")
    return as_native(depth)


def read_mask(path: str | Path, label: int | None = None) -> np.ndarray:
    """A mask as bool, height × width: the bright one of two values; soft edges are cut in the middle.

    Args:
        path: an image (a palette counts as the colours in it), or npy.
        label: the value of the object, in a file that numbers several: of a pixel, or of its entry in the palette.

    Raises:
        ValueError: missing, unreadable, several labels and none asked for, a photo; names the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        mask = _load_npy(path)
    else:
        image = open_image(path)
        _check_upright(get_orientation(image), path)
        mask = _mask_values(image, label)
        if label is not None and image.format == "PPM" and mask.ndim == 2:
            mask = _unstretched(image, path)
    try:
        return as_mask(mask, label)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _mask_values(image: Image.Image, label: int | None) -> np.ndarray:
    if image.mode in ("P", "PA") and label is not None:
        return np.array(image.getchannel(0) if image.mode == "PA" else image)
    if image.mode in ("P", "PA"):
        image = image.convert("RGBA" if "transparency" in image.info or image.mode == "PA" else "RGB")
    if image.mode in ("RGBA", "LA"):
        # A cut-out photo carries its mask as transparency, which may be soft everywhere; an opaque one in its colours.
        alpha = np.array(image.getchannel("A"))
        if alpha.min() < 128:
            return alpha >= 128
        image = image.convert("L" if image.mode == "LA" else "RGB")
    if image.mode in ("1", "L", "I", "F") or image.mode.startswith("I;16"):
        return np.array(image)
    return np.array(image.convert("RGB"))


def as_mask(mask: Any, label: int | None = None) -> np.ndarray:
    """Booleans from whatever masks come as: bool, 0/1, 0/255, probabilities, soft edges; one channel or several.

    Args:
        mask: height × width, or height × width × channels, of which a fourth is dropped.
        label: the value of the object, where the mask numbers several.

    Raises:
        ValueError: wrong shape, not finite, more than two values that are no soft edge (labels, a photo).
    """
    mask = as_native(np.asarray(mask))
    colours = None
    if mask.ndim == 3 and mask.shape[-1] in (1, 3, 4):
        mask = mask[..., :3]
        if mask.shape[-1] == 3 and not (mask == mask[..., :1]).all():
            colours = mask
        mask = mask.max(axis=-1)
    if mask.ndim != 2:
        raise ValueError(f"the mask must be height × width, not {' × '.join(map(str, mask.shape)) or 'a number'}")
    if mask.dtype.kind not in "buif":
        raise ValueError(f"the mask must be numbers, not {mask.dtype}")
    if mask.dtype.kind == "f" and not np.isfinite(mask).all():
        raise ValueError("the mask has values that are not finite")
    if label is not None:
        if colours is not None:
            raise ValueError(f"the mask has colours, so that it has no label {label}")
        found = mask == label
        if not found.any():
            raise ValueError(f"no pixel of the mask has the label {label}{_labels(mask)}")
        return found
    if mask.dtype == bool or mask.size == 0:
        return mask.astype(bool)
    if mask.dtype.kind == "f" and mask.min() >= 0 and mask.max() <= 1:
        return mask > 0.5  # probabilities
    return _cut(mask, colours)


def check_mask(mask: np.ndarray) -> None:
    """Refuse a mask that covers the whole image or looks inverted.

    Raises:
        ValueError: in words.
    """
    if mask.size and mask.all():
        raise ValueError("the mask covers all of the image: nothing tells the object from its background")
    if min(mask.shape, default=0) >= 3:
        border = np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
        if border.mean() > 0.75:
            raise ValueError(
                f"the mask covers {border.mean():.0%} of the image's border and {mask.mean():.0%} of the image: "
                "it looks inverted; the object must be white, all else black"
            )


def _cut(values: np.ndarray, colours: np.ndarray | None) -> np.ndarray:
    """Numbers as booleans, where they are of two kinds, with a soft edge between them at most."""
    low, high = values.min(), values.max()
    if low < 0:
        raise ValueError(f"the mask has negative values, down to {low:g}")
    if high == 0:
        return np.zeros(values.shape, bool)
    # What counts as full: the type's white where it is (nearly) there, else the largest value.
    full = float(high)
    for white in (255, 65535):
        if 0.9 * white <= high <= white and (values.dtype.kind == "f" or np.iinfo(values.dtype).max >= white):
            full = float(white)
            break
    if low == high:
        return np.ones(values.shape, bool)
    if low > 0.1 * full:
        raise ValueError(
            f"the mask has no black: its values go from {low:g} to {high:g}; the object must be white, all else black"
        )
    dark, bright = values <= 0.1 * full, values >= 0.9 * full
    found = values > 0.5 * full
    if not ((values == low) | (values == high)).all():
        _check_two_kinds(values, full, dark, bright, found)
    if colours is not None:
        seen = colours[bright].astype(np.float64)
        other = np.abs(seen - np.median(seen, axis=0)).max(axis=-1) > 0.25 * full
        if other.mean() > 0.01:
            raise ValueError("the mask has more than two colours: is it a photo, or a picture of several objects?")
    return found


def _check_two_kinds(values: np.ndarray, full: float, dark: np.ndarray, bright: np.ndarray, found: np.ndarray) -> None:
    """Refuse labels and photos: labels are flat, an edge is steep, and compression disturbs what is near one only."""
    import cv2

    def near(region: np.ndarray, reach: int) -> np.ndarray:
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        return cv2.dilate(np.ascontiguousarray(region).view(np.uint8), kernel).view(bool)

    between = ~dark & ~bright
    smooth = np.ascontiguousarray(values, np.float32)
    span = cv2.dilate(smooth, np.ones((3, 3))) - cv2.erode(smooth, np.ones((3, 3)))
    stray = between & (span <= 0.02 * full)
    for side, opposite in ((dark, ~dark), (bright, ~bright)):
        inside = values[side]
        kinds, counts = np.unique(inside, return_counts=True)
        if len(kinds) > 1:
            stray |= side & (values != kinds[counts.argmax()]) & ~near(opposite, 16)
    mostly_edge = between.sum() > 6 * bright.sum() + 200
    if mostly_edge or stray.sum() > max(8, 0.001 * found.sum()):  # fewer are dirt
        raise ValueError(
            f"the mask has more than two values{_labels(values)}: is it a photo, or labels of several objects? "
            "Give a mask that is white where the object is, or the label (--mask-label)"
        )


def _labels(values: np.ndarray) -> str:
    kinds = np.unique(values).astype(np.float64)
    return f" ({', '.join(f'{kind:g}' for kind in kinds[:8])}{' …' if len(kinds) > 8 else ''})"


def as_native(array: np.ndarray) -> np.ndarray:
    """The same numbers in this machine's byte order and in a type that OpenCV has: it looks at bytes, not at types."""
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
        return array.astype(np.float32 if array.dtype.itemsize < 4 else np.float64)
    if array.dtype.kind in "ui" and array.dtype not in (np.uint8, np.int8, np.uint16, np.int16, np.int32):
        fits = array.size == 0 or (array.min() >= -(2**31) and array.max() < 2**31)
        return array.astype(np.int32 if fits else np.float64)
    return array


def forget_sentinel(depth: np.ndarray) -> tuple[np.ndarray, str]:
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
        strange = others is np.max and float(extreme) in _LARGEST
        if not strange and rest.size and same.sum() >= 0.05 * depth.size:
            strange = extreme >= 1.5 * others(rest) if others is np.max else extreme <= 0.2 * others(rest)
        if strange:
            found.append(extreme)
            values = rest
        if values.size == 0:
            break
    if not found:
        return depth, ""
    depth = depth.copy()
    said = []
    for extreme in found:
        same = depth == extreme
        said.append(f"{extreme:g} on {same.mean():.0%} of the pixels")
        depth[same] = 0
    return depth, f"depth of {' and '.join(said)} is taken for unknown"


def read_size(path: str | Path) -> tuple[int, int]:
    """(width, height) of an image, from its header.

    Raises:
        ValueError: missing or no image; names the file.
    """
    return open_image(path, load=False).size


def open_image(path: str | Path, *, load: bool = True, max_side: int | None = None) -> Image.Image:
    """An image of one of the usual formats, decoded if its header promises no more pixels than memory allows.

    Args:
        path: PNG, JPEG, TIFF, BMP, WebP, GIF or PPM.
        load: decode it, too.
        max_side: a JPEG with a longer side may be decoded at a fraction of its size, not below this one.

    Raises:
        ValueError: missing, none of these, broken or too large; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")
            image = Image.open(file, formats=_FORMATS)
            if not load:
                return image
            width, height = image.size
            needed = 0
            if max_side is not None and image.format in ("JPEG", "MPO") and max(image.size) > max_side:
                # A progressive file is held as a whole whatever comes out of it.
                needed = 6 * width * height if image.info.get("progressive") else 0
                image.draft(None, (max_side, max_side))
            needed += BYTES_PER_PIXEL * image.size[0] * image.size[1]
            check_budget(needed, f"an image of {width} × {height} pixels")
            turn = get_orientation(image)
            image.load()  # which turns a TIFF and forgets that it did
            image.info[_TURN] = turn
    except UnidentifiedImageError:
        raise ValueError(f"{path}: not an image") from None
    except Image.DecompressionBombError:
        raise ValueError(f"{path}: more than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels; reduce it") from None
    except MemoryError:
        raise ValueError(f"{path}: out of memory") from None
    except Exception as error:  # decoders of many formats fail in many ways
        said = str(error).strip().splitlines() or [type(error).__name__]
        known = isinstance(error, ValueError) and "allowed for one file" in said[0]
        raise ValueError(f"{path}: {said[0]}" if known else f"{path}: broken image ({said[0]})") from None
    return image


def get_orientation(image: Image.Image) -> int:
    """How EXIF says that an image is to be turned, 1 (as it is) to 8."""
    if image.info.get(_TURN, 1) != 1:
        return image.info[_TURN]
    try:
        turn = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # whatever a broken block of EXIF raises
        return 1
    return turn if isinstance(turn, int) and 1 <= turn <= 8 else 1


def _check_upright(turn: int, path: str | Path) -> None:
    if 2 <= turn <= 8:
        raise ValueError(
            f"{path}: its EXIF orientation ({turn}) says that it is to be shown turned, which depth, mask and camera "
            "know nothing of; save it without, all of them the same way up"
        )


def _wide_tiff(path: Path) -> np.ndarray | None:
    """Depth from a TIFF of a number type that Pillow does not know (64-bit floats, signed 16 bits); None = no such."""
    tags = _tiff_tags(path)
    if tags is None:
        return None
    width, height, bits, samples, kind = (tags[number] for number in (256, 257, 258, 277, 339))
    if samples != 1 or (bits, kind) in ((8, 1), (16, 1), (32, 3), (32, 2)) or bits < 16:
        return None
    import cv2

    _check_upright(tags[_ORIENTATION], path)
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


def _unstretched(image: Image.Image, path: Path) -> np.ndarray:
    """The numbers of a decoded image as its file has them: Pillow stretches those of a PGM to all of 8 or 16 bits."""
    values = np.array(image)
    if image.format != "PPM" or image.mode not in ("L", "I"):
        return values
    with path.open("rb") as file:
        words = re.sub(rb"#[^\r\n]*", b" ", file.read(65536)).split(None, 4)
    full = 255 if image.mode == "L" else 65535
    if words[0] not in (b"P2", b"P5") or int(words[3]) == full:
        return values
    return np.round(values * (int(words[3]) / full)).astype(values.dtype)


def _tiff_tags(path: Path) -> dict[int, int] | None:
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
    tags = {256: 0, 257: 0, 258: 1, 277: 1, 339: 1, _ORIENTATION: 1}
    for at in range(0, len(block) - 11, 12):
        tag, kind, number = struct.unpack(order + "HHI", block[at : at + 8])
        if tag in tags and kind in (3, 4) and number == 1:
            (tags[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), block, at + 8)
    return tags


def _load_npy(path: Path) -> np.ndarray:
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
            there = path.stat().st_size - file.tell()
            if promised > there:
                raise ValueError(f"its header promises {promised:,} bytes, and there are {there:,}")
        check_budget(3 * promised, "an array of this size")
        return np.load(path, allow_pickle=False)
    except Exception as error:  # its header is parsed as Python, which fails in many ways
        said = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path}: not a readable npy file ({said})") from None
