"""The depth camera of a capture: stereo of some of its frames, and the rig that explains their raw depth."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ipjax.capture.depth.depth_camera import Evidence, solve_rig
from ipjax.capture.depth.rigs import Rig, SolvedRig, decide, leave
from ipjax.capture.depth.stereo import StereoDepth, Views, sweep_view
from ipjax.capture.depth.warping import smooth_depth, warp

FIRST, SECOND = 8, 12  # frames that are swept through all of their depth, and about what the raw depth says


def solve_depth_camera(
    views: Views,
    read_raw: Callable[[int], Float[np.ndarray, "hd wd"]],
    start: Rig,
    *,
    told: bool,
    look: Callable[[int], StereoDepth] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SolvedRig:
    """Solve the depth camera in two rounds: by stereo that knows nothing of it, then by stereo along its raw depth.

    The first round finds it from anywhere. In the second, windows lie along the surfaces that the raw depth has by
    then, so that stereo is two to three times as exact, and far fewer windows reach across borders.

    Args:
      read_raw: from a place among the views to its raw depth, metres, 0 where unknown or where the gripper is.
      start, told: as `solve_rig` takes them.
      look: from a place among the views to its stereo through all of the depth, if that is kept; by default it is made.
    """
    if len(views.indices) < 3:
        return leave(start, "fewer than three frames have poses: the depth camera's rig is left as it was")
    first, second = (spread(len(views.indices), count) for count in (FIRST, SECOND))
    total = len(first) + len(second)
    look = look or (lambda place: sweep_view(views, place))
    evidence = []
    for done, place in enumerate(first):
        evidence.append(_gather(views, place, read_raw(place), look(place)))
        if progress is not None:
            progress(done + 1, total)
    rough = solve_rig(evidence, start, told=told, leave_out=False)
    if not np.isfinite(rough.spread):
        return rough
    evidence = []
    for done, place in enumerate(second):
        raw = read_raw(place)
        base = smooth_depth(warp(raw, rough.solution, views.K, views.size))
        evidence.append(_gather(views, place, raw, sweep_view(views, place, base=base)))
        if progress is not None:
            progress(len(first) + done + 1, total)
    solved = solve_rig(evidence, start, told=told, first=rough.solution)
    if not np.isfinite(solved.spread):
        return solved
    return _confirm(solved, rough, start, told)


def spread(count: int, wanted: int) -> Sequence[int]:
    """So many places, evenly from all."""
    return [int(k) for k in np.unique(np.linspace(0, count, min(wanted, count), endpoint=False).astype(int))]


def _confirm(solved: SolvedRig, rough: SolvedRig, start: Rig, told: bool) -> SolvedRig:
    """Stereo along the raw depth cannot be far from it; only the first round can tell that the two disagree."""
    return decide(
        solved.solution,
        start,
        told,
        solved.deviation,
        rough.agreement,
        max(rough.spread, solved.spread),
        rough.spread_before,
    )


def _gather(views: Views, place: int, raw: Float[np.ndarray, "hd wd"], found: StereoDepth) -> Evidence:
    points = views.lift(found.depth)[found.sure]
    # Errors of the poses, a few millimetres in depth, are in all of them: the sharpest peaks do not count for all.
    weight = 1 / (0.002**2 + found.deviation[found.sure] ** 2) * 0.002**2
    return Evidence(raw.astype(np.float64), views.pose(place), points, weight)
