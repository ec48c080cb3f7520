"""COCO's run-length masks, in which BOP, CNOS, SAM-6D and SAM keep segmentations.

https://github.com/cocodataset/cocoapi/blob/master/common/maskApi.c describes the text form.
"""

from collections.abc import Sequence

import numpy as np

from ipjax.files.images.masks import as_mask
from ipjax.files.images.opening import BYTES_PER_PIXEL
from ipjax.files.storage.budget import check_budget

_LONGEST = 55  # bits before the last five of a number: more would overflow, and without end take quadratic time


def decode_rle(segmentation: dict) -> np.ndarray:
    """Bool mask [h, w] of a COCO run-length encoding ``{"size": [h, w], "counts": …}``.

    ``counts`` is a list of run lengths, or COCO's compressed text; runs go down the columns and begin with background.
    Raises ValueError where the runs do not fill the image.
    """
    try:
        height, width = (int(x) for x in segmentation["size"])
        counts = segmentation["counts"]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise ValueError("a run-length mask needs size [height, width] and counts") from None
    # No mask is larger than an image may be.
    check_budget(BYTES_PER_PIXEL * max(height, 0) * max(width, 0), f"a run-length mask of {width} × {height} pixels")
    if isinstance(counts, str | bytes):
        counts = decode_counts(counts)
    # A list in the list would make NumPy speak of its own affairs.
    whole = isinstance(counts, list | tuple | np.ndarray) and not any(isinstance(run, list | dict) for run in counts)
    runs: np.ndarray = np.asarray(counts) if whole else np.zeros((1, 1))
    if runs.ndim != 1 or (runs.size and runs.dtype.kind not in "ui") or (runs < 0).any():
        raise ValueError("the counts of a run-length mask must be whole numbers, not negative")
    # A single run beyond the mask could make the sum overflow.
    longest = int(runs.max(initial=0))
    covered = longest if longest > max(height * width, 0) else int(runs.sum())
    if height < 1 or width < 1 or covered != height * width:
        raise ValueError(f"the runs of a mask cover {covered} pixels, its size {height} × {width} needs more or less")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(width, height).T


def encode_rle(mask: np.ndarray, *, compressed: bool = True) -> dict:
    """COCO run-length encoding of a mask [h, w]; the inverse of `decode_rle`."""
    mask = as_mask(mask)
    flat = mask.T.reshape(-1)
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    if flat.size and flat[0]:
        runs.insert(0, 0)
    return {"size": list(mask.shape), "counts": _compress(runs) if compressed else runs}


def decode_counts(text: str | bytes) -> list[int]:
    """Run lengths from COCO's text: five bits a character, from the third on as differences to the one before last.

    Raises ValueError for what is no such text.
    """
    data = text.encode("ascii", "replace") if isinstance(text, str) else text
    runs: list[int] = []
    at = 0
    while at < len(data):
        value, shift, more = 0, 0, True
        while more:
            if at >= len(data):
                raise ValueError("a compressed mask ends in the middle of a number")
            bits = data[at] - 48
            if not 0 <= bits < 64:
                raise ValueError("a compressed mask holds a character that is none of COCO's")
            if shift > _LONGEST:
                raise ValueError("a compressed mask holds a number that no image has pixels for")
            value |= (bits & 31) << shift
            more = bool(bits & 32)
            at += 1
            shift += 5
            if not more and bits & 16:
                value |= -1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
    return runs


def _compress(runs: Sequence[int]) -> str:
    text = []
    for index, run in enumerate(runs):
        value = run - (runs[index - 2] if index > 2 else 0)
        more = True
        while more:
            bits = value & 31
            value >>= 5
            more = value != -1 if bits & 16 else value != 0
            text.append(chr((bits | 32 if more else bits) + 48))
    return "".join(text)
