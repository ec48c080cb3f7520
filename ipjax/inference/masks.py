"""The object's mask in a frame: found by depth inside a box, and without specks."""

import cv2
import numpy as np

from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.inference.depth import to_metres


def drop_specks(mask: np.ndarray) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    """The mask without components below 2 % of the largest, which would enlarge the crop; and its bounds."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    keep = np.zeros(count, bool)
    keep[1:] = areas >= 0.02 * areas.max()
    if not keep[1:].all():
        mask = keep[np.asarray(labels, np.int64)]
    boxes = stats[keep]
    left, top = boxes[:, cv2.CC_STAT_LEFT].min(), boxes[:, cv2.CC_STAT_TOP].min()
    right = (boxes[:, cv2.CC_STAT_LEFT] + boxes[:, cv2.CC_STAT_WIDTH]).max()
    bottom = (boxes[:, cv2.CC_STAT_TOP] + boxes[:, cv2.CC_STAT_HEIGHT]).max()
    return mask, (int(left), int(top), int(right), int(bottom))


def find_nearest_object(
    depth: np.ndarray, scale: float, box: tuple[int, int, int, int], camera: Intrinsics
) -> np.ndarray:
    """The object inside a box, as a mask: the nearest run of depth that a fair share of the box's middle belongs to."""
    left, top, right, bottom = box
    inside = to_metres(depth[top:bottom, left:right], scale)
    known = inside > 0
    if not known.any():
        raise ValueError("there is no depth inside the box")
    height, width = inside.shape
    y = (np.arange(height) + 0.5) / height - 0.5
    x = (np.arange(width) + 0.5) / width - 0.5
    weight = np.exp(-(y[:, None] ** 2 + x[None, :] ** 2) / (2 * 0.25**2))
    order = np.argsort(inside[known], kind="stable")
    values, weights = inside[known][order], weight[known][order]
    middle = values[min(np.searchsorted(np.cumsum(weights), 0.5 * weights.sum()), len(values) - 1)]
    extent = max(width, height) * float(middle) / float(camera.matrix[0, 0])
    gap = max(0.1 * extent, 0.01 * float(middle))
    run = np.concatenate([[0], np.cumsum(np.diff(values) > gap)])
    share = np.bincount(run, weights=weights) / weights.sum()
    chosen = int(np.argmax(share >= min(0.2, share.max())))
    near, far = values[run == chosen][[0, -1]]
    # Where nothing but a table joins object and background, the object is no deeper than its box is large.
    centre = np.median(values[run == chosen])
    near, far = max(near, centre - extent), min(far, centre + extent)
    mask = np.zeros(depth.shape, bool)
    found = known & (inside >= near) & (inside <= far)
    if width > 8 and height > 8:
        opened = cv2.morphologyEx(found.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).view(bool)
        found = opened if opened.any() else found
    mask[top:bottom, left:right] = found
    return mask
