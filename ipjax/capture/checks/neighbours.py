"""What two frames, one after the other, say together: how much both see, and whether given poses fit the depth."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ipjax.cameras import project, unproject
from ipjax.capture.poses.features import Features, Match, verify
from ipjax.capture.poses.rgbd import relate
from ipjax.capture.records import CaptureFrame
from ipjax.transforms import Similarity

_POINTS = 8000  # of a frame, whose depth is compared
_VISIBLE = 0.05  # share of the depth by which a point may lie behind what is seen: farther back it is hidden
_FEWEST = 30  # points, below which no median is told


@dataclasses.dataclass(frozen=True)
class PairMeasures:
    """Of two frames, the first and the one after it."""

    first: str
    second: str
    matches: int  # features that one motion of the camera explains
    overlap: float | None  # share of the first frame's depth that the second sees, too; None = not known
    moved: tuple[float, float] | None  # by the features and their depth: metres, radians; None = not known
    differences: tuple[float | None, ...]  # median differences of depth under each reading of the given poses, metres


def measure_pair(
    frames: tuple[CaptureFrame, CaptureFrame],
    features: Sequence[Features],
    found: Match,
    matrix: Float[np.ndarray, "3 3"],
    readings: Sequence[tuple[Similarity[np.ndarray], Similarity[np.ndarray]]],
) -> PairMeasures:
    """Compare two frames.

    Args:
      found: their matches by descriptors alone; its indices are those of `features`.
      matrix: K of the colours.
      readings: world_from_camera of both, in each way in which the given poses may be meant, the plain one first.
    """
    agreeing = verify(found, features, matrix)
    edge = relate(agreeing, features, matrix)
    motions = [second.inverse() @ first for first, second in readings]
    motion = motions[0] if motions else None if edge is None else edge.second_from_first
    has_depth = frames[0].depth is not None and frames[1].depth is not None
    overlap = None
    if motion is not None and has_depth:
        overlap, _ = compare_depth(frames[0], frames[1], matrix, motion)
    moved = None
    if edge is not None:
        turn = float(np.linalg.norm(edge.second_from_first.log()[:3]))
        moved = (float(np.linalg.norm(edge.second_from_first.inverse().translation)), turn)
    return PairMeasures(
        first=frames[0].name,
        second=frames[1].name,
        matches=len(agreeing),
        overlap=overlap,
        moved=moved,
        differences=tuple(
            compare_depth(frames[0], frames[1], matrix, motion)[1] if has_depth else None for motion in motions
        ),
    )


def compare_depth(
    first: CaptureFrame,
    second: CaptureFrame,
    matrix: Float[np.ndarray, "3 3"],
    second_from_first: Similarity[np.ndarray],
) -> tuple[float, float | None]:
    """The share of the first frame's points that lie in the second's image and are hidden by nothing there, and the
    median difference of their depth, metres; None where there are too few.
    """
    assert first.depth is not None and second.depth is not None
    rows, columns = np.nonzero((first.depth > 0) & first.usable)
    picked = np.random.default_rng(0).permutation(len(rows))[:_POINTS]
    rows, columns = rows[picked], columns[picked]
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    moved = second_from_first @ unproject(matrix, pixels, first.depth[rows, columns].astype(np.float64))
    height, width = second.depth.shape
    x, y = project(matrix, moved).T
    inside = (moved[:, 2] > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y, z = np.rint(x[inside]).astype(int), np.rint(y[inside]).astype(int), moved[inside, 2]
    seen = np.where(second.usable[y, x], second.depth[y, x], 0)
    # What lies far behind is hidden in the second image: its difference says nothing of the poses.
    hidden = (seen > 0) & (z > seen * (1 + _VISIBLE) + 0.05)
    off = np.abs(z - seen)[(seen > 0) & ~hidden]
    overlap = float((~hidden).sum() / max(len(inside), 1))
    return overlap, float(np.median(off)) if len(off) >= _FEWEST else None
