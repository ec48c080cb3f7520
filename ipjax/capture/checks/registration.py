"""Whether depth is registered to the colours: edges of depth are sought among the edges of the photo.

Where something stands before something else, its outline is an edge in both images. The shift at which most outlines of
depth fall on edges of the photo, over all frames, is how far the two are apart.
"""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float

_REACH = 40  # pixels: farther shifts are not sought
_STEP = 0.06  # share of the depth by which what lies behind is farther
_FEWEST = 300  # pixels of outlines, below which nothing can be said


@dataclasses.dataclass(frozen=True)
class Shift:
    """Where depth lies relative to the colours."""

    across: float  # pixels by which depth has to be moved to the right to lie on the photo
    down: float
    gain: float  # how much stronger the photo's edges are there than where depth lies now, in spreads of all shifts
    here: float  # how much stronger they are where depth lies now than elsewhere, in the same spreads
    certain: bool  # both halves of the frames agree, and the edges stand out

    @property
    def length(self) -> float:
        """Pixels."""
        return float(np.hypot(self.across, self.down))


class EdgeCorrelation:
    """Gathers, frame by frame, how strong the photo's edges are on the outlines of depth, for every shift."""

    def __init__(self):
        self._sums = [np.zeros((2 * _REACH + 1, 2 * _REACH + 1)) for _ in range(2)]
        self._weights = [0.0, 0.0]
        self._frames = 0

    def add(self, rgb: np.ndarray, depth: np.ndarray) -> None:
        """Take another frame into account; depth in metres, of the photo's size."""
        outline = find_outlines(depth)
        half = self._frames % 2
        self._frames += 1
        count = float(outline.sum())
        if count < 20:
            return
        edges = _strength(rgb)
        height, width = outline.shape
        shape = [cv2.getOptimalDFTSize(height + _REACH), cv2.getOptimalDFTSize(width + _REACH)]
        spectrum = np.fft.rfft2(edges, shape) * np.conj(np.fft.rfft2(outline.astype(np.float32), shape))
        everywhere = np.fft.irfft2(spectrum, shape)
        rows = np.arange(-_REACH, _REACH + 1) % shape[0]
        columns = np.arange(-_REACH, _REACH + 1) % shape[1]
        self._sums[half] += everywhere[np.ix_(rows, columns)]
        self._weights[half] += count

    def find_shift(self) -> Shift | None:
        """The best shift; None where there are too few outlines."""
        if sum(self._weights) < _FEWEST or min(self._weights) <= 0:
            return None
        weights = np.array(self._weights)
        maps = [
            cv2.GaussianBlur(total / weight, (0, 0), 1.0) for total, weight in zip(self._sums, weights, strict=True)
        ]
        both = np.tensordot(weights / weights.sum(), np.stack(maps), 1)
        across, down = _find_peak(both)
        spread = 1.4826 * np.median(np.abs(both - np.median(both)))
        here = both[_REACH - 1 : _REACH + 2, _REACH - 1 : _REACH + 2].max()
        halves = [np.array(_find_peak(image)) for image in maps]
        apart = max(np.linalg.norm(half - [across, down]) for half in halves)
        stands_out = (both.max() - np.median(both)) > 5 * spread
        gain, now = ((value / max(spread, 1e-9)) for value in (both.max() - here, here - np.median(both)))
        return Shift(across, down, float(gain), float(now), bool(stands_out and apart < 3))


def find_outlines(depth: Float[np.ndarray, "h w"]) -> np.ndarray:
    """Pixels of a near surface at its outline: before what is farther, or before the shadow of the depth camera."""
    depth = depth.astype(np.float32)
    known = depth > 0
    # Depth that was warped has gaps between its pixels, which are no edges.
    ring = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    filled = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, ring) > 0
    nearest = np.where(known, depth, np.float32(1e3))
    nearest = np.where(known, depth, cv2.erode(nearest, ring))
    nearest = np.where(filled & (nearest < 1e3), nearest, 0)
    wide = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (25, 25))
    farthest = cv2.dilate(nearest, wide)
    before = (nearest > 0) & (farthest > nearest * (1 + _STEP))
    behind = np.where(nearest > 0, nearest, np.float32(1e3))
    beside = cv2.dilate(behind, np.ones((3, 3), np.uint8)) > nearest * (1 + _STEP)
    outline = before & beside
    # An outline that is a single pixel, or the end of a blot of unknown depth on a plane, is none: nothing lies behind.
    outline[:3], outline[-3:], outline[:, :3], outline[:, -3:] = False, False, False, False
    return outline


def _strength(rgb: np.ndarray) -> np.ndarray:
    """The strength of edges, relative to what is around, so that no pattern outweighs all outlines."""
    smooth = cv2.GaussianBlur(rgb, (0, 0), 1.0).astype(np.float32)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    slope = np.hypot(across, down).max(-1)
    around = cv2.GaussianBlur(slope, (0, 0), 15)
    strength = np.minimum(slope / (around + 8), 3)
    return strength - strength.mean()


def _find_peak(image: np.ndarray) -> tuple[float, float]:
    """Where an image is largest, between its pixels: (across, down) from its middle."""
    row, column = np.unravel_index(np.argmax(image), image.shape)
    row, column = (int(np.clip(x, 1, 2 * _REACH - 1)) for x in (row, column))
    patch = image[row - 1 : row + 2, column - 1 : column + 2]
    off = []
    for a, b, c in ((patch[1, 0], patch[1, 1], patch[1, 2]), (patch[0, 1], patch[1, 1], patch[2, 1])):
        bend = a - 2 * b + c
        off.append(float(np.clip(0.5 * (a - c) / bend, -0.5, 0.5)) if bend < 0 else 0.0)
    return column - _REACH + off[0], row - _REACH + off[1]
