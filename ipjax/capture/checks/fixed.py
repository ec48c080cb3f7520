"""What moves with the camera: a gripper or a hand stays where it is in every image, while all else passes by."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_WIDTH = 160  # pixels of the images that are compared
_MOST = 24  # frames
_FEWEST = 4  # frames, below which nothing is told
_LEAST = 0.003  # share of the image that a fixed thing has at least


def shrink_for_fixed(rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2"]:
    """A frame as `find_fixed` takes it: small, grey, its contrast that of its surroundings."""
    height = max(round(_WIDTH * rgb.shape[0] / rgb.shape[1]), 1)
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (_WIDTH, height), interpolation=cv2.INTER_AREA)
    return grey.astype(np.float32)


def find_fixed(images: list[np.ndarray], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Where the images show something that moves with the camera.

    An edge of the scene passes by, so that its gradients point here and there, and average out; those of a fixed thing
    are the same in every frame. A plain wall does not change either, but has no edges: it is not told from a fixed
    thing without.

    Args:
      images: of `shrink_for_fixed`, from frames between which the camera moved.
      size: of the mask: width, height, pixels.

    Returns:
      A mask; empty where nothing is fixed, or there are too few frames.
    """
    width, height = size
    if len(images) < _FEWEST:
        return np.zeros((height, width), bool)
    picked = [images[i] for i in np.unique(np.linspace(0, len(images) - 1, _MOST).astype(int))]
    stack = np.stack(picked)
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 0.8) for image in stack])
    across = np.stack([cv2.Sobel(image, cv2.CV_32F, 1, 0) for image in smooth])
    down = np.stack([cv2.Sobel(image, cv2.CV_32F, 0, 1) for image in smooth])
    lasting = np.hypot(np.median(across, 0), np.median(down, 0))
    usual = np.hypot(across, down).mean(0)
    edges = (lasting > 20) & (lasting > 0.6 * usual)
    # Inside: what changes little between frames, and touches edges that last.
    change = np.median(np.abs(stack - np.median(stack, 0)), 0)
    calm = change < 0.4 * np.median(change) + 2
    region = cv2.morphologyEx((edges | calm).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(region, connectivity=4)
    fixed = np.zeros(region.shape, bool)
    for label in range(1, count):
        mine = labels == label
        area = stats[label, cv2.CC_STAT_AREA]
        rim = mine & ~(cv2.erode(mine.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0)
        # An outline that lasts: most of the rim, but for the parts at the border of the image.
        if area >= _LEAST * mine.size and rim.any() and (edges & rim).sum() > 0.25 * rim.sum():
            fixed |= mine
    grown = cv2.dilate(fixed.astype(np.uint8), np.ones((3, 3), np.uint8))
    return cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST) > 0
