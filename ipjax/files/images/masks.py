"""Masks as booleans: from 0/1, 0/255, probabilities, soft edges; labels need a number, photos are refused."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image

from ipjax.files.images.arrays import as_native, load_npy
from ipjax.files.images.opening import check_upright, get_orientation, open_image, undo_stretching

_LARGEST_LABEL = 63  # of an image of whole numbers, that no image of black and white stops at


def read_mask(path: str | Path, label: int | None = None) -> np.ndarray:
    """A mask as bool, height × width: the bright one of two values; soft edges are cut in the middle.

    Args:
        path: an image (a palette counts as the colours in it), or npy.
        label: the value of the object, in a file that numbers several: of a pixel, or of its entry in the palette.

    Raises:
        ValueError: missing, unreadable, several labels and none asked for, a photo; names the file.
    """
    path = Path(path)
    mask = load_npy(path) if path.suffix.lower() == ".npy" else _read_values(path, label)
    try:
        return as_mask(mask, label)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_values(path: str | Path) -> np.ndarray:
    """The numbers of a mask's image: labels as they are stored, a palette of more than two as its entries.

    Raises:
        ValueError: as `read_mask`, but for what the numbers say.
    """
    path = Path(path)
    values = _read_values(path, None)
    try:
        as_mask(values)
    except ValueError:
        labels = _read_values(path, 0)
        return labels if labels.ndim == 2 else values
    return values


def _read_values(path: Path, label: int | None) -> np.ndarray:
    image = open_image(path)
    check_upright(get_orientation(image), path)
    values = _convert(image, label)
    return undo_stretching(image, path) if label is not None and image.format == "PPM" and values.ndim == 2 else values


def _convert(image: Image.Image, label: int | None) -> np.ndarray:
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
    """A mask as booleans, from bool, 0/1, 0/255, probabilities, soft edges; one channel or several.

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
            raise ValueError(f"no pixel of the mask has the label {label}{_list_labels(mask)}")
        return found
    if mask.dtype == bool or mask.size == 0:
        return mask.astype(bool)
    if mask.dtype.kind == "f" and mask.min() >= 0 and mask.max() <= 1:
        return mask > 0.5  # probabilities
    return _threshold(mask, colours)


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


def _threshold(values: np.ndarray, colours: np.ndarray | None) -> np.ndarray:
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
    # Compression and scaling blur masks whose white is bright; of small whole numbers each is a label of its own.
    exact = values.dtype.kind in "ui" and full <= _LARGEST_LABEL
    dark, bright = (values == 0, values == full) if exact else (values <= 0.1 * full, values >= 0.9 * full)
    found = values > 0.5 * full
    if not ((values == low) | (values == high)).all():
        _check_two_values(values, full, dark, bright, found)
    if colours is not None:
        seen = colours[bright].astype(np.float64)
        other = np.abs(seen - np.median(seen, axis=0)).max(axis=-1) > 0.25 * full
        if other.mean() > 0.01:
            raise ValueError("the mask has more than two colours: is it a photo, or a picture of several objects?")
    return found


def _check_two_values(values: np.ndarray, full: float, dark: np.ndarray, bright: np.ndarray, found: np.ndarray) -> None:
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
            f"the mask has more than two values{_list_labels(values)}: is it a photo, or labels of several objects? "
            "Give a mask that is white where the object is, or the label (--mask-label)"
        )


def _list_labels(values: np.ndarray) -> str:
    kinds = np.unique(values).astype(np.float64)
    return f" ({', '.join(f'{kind:g}' for kind in kinds[:8])}{' …' if len(kinds) > 8 else ''})"


def box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int] | None:
    """x, y, width, height of the smallest box around a mask, pixels; None where the mask is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not rows.size:
        return None
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1
