"""Components: what stands off the planes of a frame, cut where depth jumps."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from ipjax.detection.proposals.surfaces import Surfaces


def find_components(
    surfaces: Surfaces,
    off: Bool[np.ndarray, "h w"],
    jumps: Sequence[float] = (0.006, 0.012, 0.025),
    erosions: Sequence[int] = (0, 1, 2),
    least: int = 30,
) -> Bool[np.ndarray, "n h w"]:
    """Connected pieces of what is ``off`` all planes.

    Args:
      surfaces: the frame.
      off: the pixels that may belong to a piece.
      jumps: shares of the depth; at a greater step pieces are cut apart.
      erosions: pixels by which pieces are made thinner before they are told apart, and thicker afterwards.
      least: pixels below which a piece is dropped.
    """
    found = []
    for jump in jumps:
        cut = off.copy()
        across, down = surfaces.jump[0] > jump, surfaces.jump[1] > jump
        # The farther side of a jump is cut away: the nearer one is the rim of what stands in front.
        depth = surfaces.depth
        behind = depth[:, :-1] > depth[:, 1:]
        cut[:, :-1] &= ~(across & behind)
        cut[:, 1:] &= ~(across & ~behind)
        behind = depth[:-1] > depth[1:]
        cut[:-1] &= ~(down & behind)
        cut[1:] &= ~(down & ~behind)
        for erosion in erosions:
            core = cut.view(np.uint8)
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * erosion + 1, 2 * erosion + 1))
            if erosion:
                core = cv2.erode(core, kernel)
            count, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
            for label in range(1, count):
                if stats[label, cv2.CC_STAT_AREA] < least:
                    continue
                piece = (labels == label).view(np.uint8)
                grown = cv2.dilate(piece, kernel if erosion else np.ones((3, 3), np.uint8))
                found.append(grown.view(bool) & off)
    return np.array(found, bool).reshape(-1, *off.shape)
