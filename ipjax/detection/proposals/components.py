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


def find_basins(
    surfaces: Surfaces, levels: Sequence[float] = (0.15, 0.3, 0.5), least: int = 30
) -> Bool[np.ndarray, "n h w"]:
    """Regions that steps of depth and concave creases close in, grown until they meet on the steps' crests.

    Args:
      surfaces: the frame.
      levels: of the steps (1 = a jump by 3 % or a crease of about 50°); what is below is one region where it connects.
      least: pixels below which a region is dropped.
    """
    from skimage.segmentation import watershed

    height = np.zeros(surfaces.shape, np.float32)
    for jump, crease, (rows, columns) in zip(surfaces.jump, surfaces.crease, ((0, 1), (1, 0)), strict=True):
        step = np.maximum(jump / 0.03, crease / 0.4).astype(np.float32)
        before = height[: height.shape[0] - rows, : height.shape[1] - columns]
        np.maximum(before, step, out=before)
        np.maximum(height[rows:, columns:], step, out=height[rows:, columns:])
    found = []
    for level in levels:
        count, labels, stats, _ = cv2.connectedComponentsWithStats((height < level).view(np.uint8), connectivity=4)
        area = stats[:, cv2.CC_STAT_AREA]
        labels = np.where(area[np.asarray(labels, np.int32)] < least // 3, 0, labels).astype(np.int32)
        grown = watershed(height, labels)
        for label in np.flatnonzero(np.bincount(grown.reshape(-1), minlength=count) >= least):
            if label and area[label] >= least // 3:
                found.append(grown == label)
    return np.array(found, bool).reshape(-1, *surfaces.shape)
