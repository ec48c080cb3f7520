"""Windows: what lies off the planes within balls of a known diameter, for things that nothing else tells apart."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from ipjax.detection.proposals.surfaces import Surfaces

_STEP = 0.35  # of a diameter, between the places that balls begin at
_MOVES = 4  # by which each ball's centre moves to the middle of what it holds
_MOST = 150  # balls of one diameter


def find_windows(
    surfaces: Surfaces,
    off: Bool[np.ndarray, "h w"],
    diameters: Sequence[float],
    least: int = 30,
    at: Sequence[tuple[float, float]] = (),
) -> Bool[np.ndarray, "n h w"]:
    """The surface inside balls that were moved to where it is.

    Args:
      surfaces: the frame.
      off: the pixels that may belong to a window.
      diameters: of the things that are sought, metres.
      least: pixels below which a window is dropped.
      at: pixels (x, y) that balls begin at, instead of all over.
    """
    found = []
    focal = float(np.sqrt(surfaces.camera[0, 0] * surfaces.camera[1, 1]))
    for diameter in diameters:
        # Places on a grid whose step is in proportion to how large the thing is seen there.
        apart = np.maximum(_STEP * diameter * focal / surfaces.depth, 2)
        y, x = np.indices(surfaces.shape)
        begins = off & (x % apart < 1) & (y % apart < 1)
        if at:
            near = [np.hypot(x - column, y - row) <= 2 for column, row in at]
            begins = off & np.any(near, axis=0)
        begins = np.flatnonzero(begins)
        if begins.size > _MOST:
            begins = begins[np.linspace(0, begins.size - 1, _MOST).astype(int)]
        points = surfaces.points[off].astype(np.float64)
        centres = surfaces.points.reshape(-1, 3)[begins].astype(np.float64)
        for _ in range(_MOVES):
            inside = _inside(points, centres, diameter).astype(np.float64)
            centres = inside @ points / np.maximum(inside.sum(1, keepdims=True), 1)
        _, first = np.unique(np.round(centres / (0.1 * diameter)), axis=0, return_index=True)
        for centre in centres[np.sort(first)]:
            mask = np.zeros(surfaces.shape, np.uint8)
            mask[off] = _inside(points, centre[None], diameter)[0]
            count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
            if count > 1:
                largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
                if stats[largest, cv2.CC_STAT_AREA] >= least:
                    found.append(labels == largest)
    return np.array(found, bool).reshape(-1, *surfaces.shape)


def _inside(points: np.ndarray, centres: np.ndarray, diameter: float) -> np.ndarray:
    """Which points lie in each ball."""
    square = (points**2).sum(-1) - 2 * centres @ points.T + (centres**2).sum(-1, keepdims=True)
    return square <= (diameter / 2) ** 2
