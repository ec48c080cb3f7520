"""What two frames, one after the other, say together: how much both see, and whether the given poses agree with depth."""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float

from ipjax.cameras import project, unproject
from ipjax.capture.records import CaptureFrame
from ipjax.transforms import Similarity, rotation_from_vector

_FEATURES = 1500  # of a frame
_RATIO = 0.8  # Lowe's: the best match's distance over that of the second best
_CLOSE = 3.0  # pixels within which a feature is where a motion has it
_STEP = 6  # pixels between the points whose depth is compared
_VISIBLE = 0.05  # share of the depth by which a point may lie behind what is seen: farther back it is hidden
_FEWEST = 30  # points, below which no median is told


@dataclasses.dataclass(frozen=True)
class Features:
    """SIFT features of a frame."""

    pixels: Float[np.ndarray, "n 2"]
    descriptors: Float[np.ndarray, "n 128"]
    depth: Float[np.ndarray, " n"]  # metres; 0 = unknown


@dataclasses.dataclass(frozen=True)
class PairMeasures:
    """Of two frames, the first and the one after it."""

    first: str
    second: str
    matches: int  # features that are each other's best match
    inliers: int  # of those that one motion of the camera explains
    overlap: float | None  # share of the first frame's depth that lies in the second's image; None = not known
    moved: tuple[float, float] | None  # by the features: metres, radians; None = not known
    difference: float | None  # median difference of depth under the given poses, metres; None = no poses, no depth
    inverted: float | None  # the same under the inverses of the given poses
    apart: tuple[float, float] | None  # the given motion and that of the features: metres, radians


def find_features(frame: CaptureFrame) -> Features:
    """The features of a frame, where it may be used."""
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    mask = None if frame.usable.all() else frame.usable.astype(np.uint8)
    points, descriptors = cv2.SIFT.create(_FEATURES).detectAndCompute(grey, mask)
    if descriptors is None or not len(points):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros(0))
    pixels = np.array([point.pt for point in points], np.float64)
    depth = np.zeros(len(pixels))
    if frame.depth is not None:
        # Warped depth has gaps between its pixels: the nearest of what is around will do.
        around = np.where(frame.depth > 0, frame.depth, np.float32(1e3)).astype(np.float32)
        nearest = cv2.erode(around, np.ones((3, 3), np.uint8))
        nearest[nearest >= 1e3] = 0
        x, y = np.rint(pixels).astype(int).T
        depth = nearest[np.clip(y, 0, len(nearest) - 1), np.clip(x, 0, nearest.shape[1] - 1)].astype(np.float64)
    return Features(pixels, np.asarray(descriptors, np.float32), depth)


def measure_pair(
    frames: tuple[CaptureFrame, CaptureFrame],
    features: tuple[Features, Features],
    matrix: Float[np.ndarray, "3 3"],
    world_from_camera: tuple[Similarity[np.ndarray], Similarity[np.ndarray]] | None,
) -> PairMeasures:
    """Compare two frames.

    Args:
      matrix: K of the colours.
      world_from_camera: of both, where poses were given.
    """
    matches = _match(*features)
    second_from_first, inliers = _find_motion(features, matches, matrix)
    given = inverted = apart = None
    if world_from_camera is not None:
        first, second = world_from_camera
        given = second.inverse() @ first
        inverted = second @ first.inverse()
    best = given if given is not None else second_from_first
    overlap = difference = of_inverted = None
    if frames[0].depth is not None and frames[1].depth is not None:
        if best is not None:
            overlap, _ = compare_depth(frames[0], frames[1], matrix, best)
        if given is not None and inverted is not None:
            difference = compare_depth(frames[0], frames[1], matrix, given)[1]
            of_inverted = compare_depth(frames[0], frames[1], matrix, inverted)[1]
    if given is not None and second_from_first is not None:
        step = (given.inverse() @ second_from_first).log()
        apart = (float(np.linalg.norm(step[3:6])), float(np.linalg.norm(step[:3])))
    moved = None
    if second_from_first is not None:
        step = second_from_first.log()
        moved = (float(np.linalg.norm(second_from_first.inverse().translation)), float(np.linalg.norm(step[:3])))
    return PairMeasures(
        first=frames[0].name,
        second=frames[1].name,
        matches=len(matches),
        inliers=inliers,
        overlap=overlap,
        moved=moved,
        difference=difference,
        inverted=of_inverted,
        apart=apart,
    )


def compare_depth(
    first: CaptureFrame,
    second: CaptureFrame,
    matrix: Float[np.ndarray, "3 3"],
    second_from_first: Similarity[np.ndarray],
) -> tuple[float, float | None]:
    """The share of the first frame's points that the second frame has in its image, and the median difference of their
    depth, metres, of those that nothing hides; None where there are too few.
    """
    assert first.depth is not None and second.depth is not None
    rows, columns = np.nonzero((first.depth > 0) & first.usable)
    picked = np.random.default_rng(0).permutation(len(rows))[: first.depth.size // _STEP**2]
    rows, columns = rows[picked], columns[picked]
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    moved = second_from_first @ unproject(matrix, pixels, first.depth[rows, columns].astype(np.float64))
    height, width = second.depth.shape
    x, y = project(matrix, moved).T
    inside = (moved[:, 2] > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    overlap = float(inside.mean()) if len(inside) else 0.0
    x, y, z = np.rint(x[inside]).astype(int), np.rint(y[inside]).astype(int), moved[inside, 2]
    seen = np.where(second.usable[y, x], second.depth[y, x], 0)
    off = np.abs(z - seen)
    # What lies far behind is hidden in the second image, and a wrong pose may not hide its errors as such.
    visible = (seen > 0) & (z < seen * (1 + _VISIBLE) + 0.05)
    return overlap, float(np.median(off[visible])) if visible.sum() >= _FEWEST else None


def _match(first: Features, second: Features) -> np.ndarray:
    """Features that are each other's best match, and clearly better than the second best: indices [m 2]."""
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.zeros((0, 2), int)
    # SIFT's descriptors are bytes of norm 512: their products are exact in float32.
    a, b = first.descriptors, second.descriptors
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * a @ b.T
    best = squared.argmin(1)
    back = squared.argmin(0)
    two = np.partition(squared, 1, axis=1)[:, :2]
    good = (back[best] == np.arange(len(a))) & (two[:, 0] < _RATIO**2 * two[:, 1])
    return np.stack([np.flatnonzero(good), best[good]], -1)


def _find_motion(
    features: tuple[Features, Features], matches: np.ndarray, matrix: np.ndarray
) -> tuple[Similarity[np.ndarray] | None, int]:
    """``second_from_first`` by the features with depth, and how many agree; without depth only how many agree."""
    if len(matches) < 8:
        return None, 0
    first, second = features[0].pixels[matches[:, 0]], features[1].pixels[matches[:, 1]]
    depth = features[0].depth[matches[:, 0]]
    if not features[0].depth.any():
        _, mask = cv2.findEssentialMat(first, second, matrix, cv2.RANSAC, 0.999, 1.5)
        return None, 0 if mask is None else int(mask.sum())
    known = depth > 0
    if known.sum() < 8:
        return None, 0
    points = unproject(matrix, first[known], depth[known])
    try:
        found, vector, shift, inliers = cv2.solvePnPRansac(
            points, second[known], matrix, None, iterationsCount=400, reprojectionError=_CLOSE, confidence=0.999
        )
    except cv2.error:
        return None, 0
    if not found or inliers is None or len(inliers) < 6:
        return None, 0
    rotation = rotation_from_vector(np.asarray(vector, np.float64).reshape(3))
    return Similarity(rotation, np.asarray(shift, np.float64).reshape(3), np.ones(())), len(inliers)
