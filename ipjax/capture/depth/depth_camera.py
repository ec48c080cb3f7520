"""The depth camera of a capture, solved once: where it stands beside the colour camera, its focal length, its scale.

Two things tell it, point to plane, over many frames at once. What stereo between the colour images is sure of must lie
on the raw depth; and the raw depth of one frame, carried into another by the colour camera's poses, must lie on that
one's (as in hand-eye calibration: R. Y. Tsai and R. K. Lenz, 1989). Stereo alone feels every error of the poses several
times over; raw depth alone cannot tell a shift along the axis about which the camera goes around.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ipjax.cameras import project, unproject
from ipjax.capture.depth.rigs import TOLD, UNTOLD, Rig, SolvedRig, decide, difference, leave
from ipjax.transforms import Similarity, rotation_from_vector

WIDTHS = (0.04, 0.02, 0.01, 0.006, 0.004)  # of the robust kernel, metres, from coarse to fine
_STEPS = 4  # of Gauss-Newton at each width
# Errors of a pose are common to all points of a frame, or of a pair: however many there are, they count as so many.
_COUNT_STEREO, _COUNT_RAW = 30.0, 30.0
_FINEST = 0.0005  # metres: no residual is taken to be more exact
_FEWEST = 500  # points of the stereo
_SAMPLES = 800  # points of a raw image that are carried into others
_ANGLES = (20, 45, 75, 110)  # degrees between the views of a pair: the nearest to each of these


@dataclasses.dataclass(frozen=True)
class Evidence:
    """One frame: its raw depth, where it stood, and the points that stereo is sure of."""

    raw: Float[np.ndarray, "hd wd"]  # metres along z, 0 = unknown
    world_from_camera: Similarity[np.ndarray]
    points: Float[np.ndarray, "k 3"]  # in the colour camera, metres
    weight: Float[np.ndarray, " k"]  # 1 / variance relative to the others


@dataclasses.dataclass(frozen=True)
class _Surface:
    """A raw depth image for look-ups."""

    depth: Float[np.ndarray, "hd wd"]  # averaged
    slope: Float[np.ndarray, "2 hd wd"]  # of depth along x, y; per pixel
    smooth: Bool[np.ndarray, "hd wd"]  # known, and without a jump
    rows: np.ndarray  # of some of its pixels, those whose normals are rare among them
    columns: np.ndarray


@dataclasses.dataclass(frozen=True)
class _Problem:
    points: Sequence[tuple[np.ndarray, np.ndarray]]  # of each frame: points in the colour camera, weights
    surfaces: Sequence[_Surface]
    poses: Sequence[Similarity[np.ndarray]]
    pairs: Sequence[tuple[int, int]]
    start: Rig
    prior: Float[np.ndarray, "8"]

    def without(self, left_out: set[int]) -> "_Problem":
        """The same from fewer frames."""
        none = np.zeros((0, 3)), np.zeros(0)
        points = [none if k in left_out else item for k, item in enumerate(self.points)]
        pairs = [pair for pair in self.pairs if not left_out & set(pair)]
        return dataclasses.replace(self, points=points, pairs=pairs)


def solve_rig(
    evidence: Sequence[Evidence], start: Rig, *, told: bool, first: Rig | None = None, leave_out: bool = True
) -> SolvedRig:
    """Rotation, translation, focal length and scale of the depth camera, over all frames given.

    Args:
      start: the factory's rig, or one at the colour camera's place where nothing is known.
      told: whether `start` is the factory's; it is then kept where the solution is not to be trusted.
      first: where the search begins, if an earlier solution is known; `start` by default.
      leave_out: solve again without some frames each time, for an honest deviation.
    """
    enough = sum(len(item.points) for item in evidence)
    if enough < _FEWEST:
        note = f"stereo is sure of {enough} points only, too few to solve the depth camera: its rig is left as it was"
        return leave(start, note)
    poses = [item.world_from_camera for item in evidence]
    problem = _Problem(
        [(item.points, item.weight) for item in evidence],
        [_smooth(item.raw, start) for item in evidence],
        poses,
        _pair(poses),
        start,
        TOLD if told else UNTOLD,
    )
    rig, hessian = _descend(problem, first or start, WIDTHS if first is None else WIDTHS[2:])
    deviation = np.sqrt(np.diag(np.linalg.inv(hessian)))
    if leave_out and len(evidence) >= 4:
        # Errors of a frame's pose are common to all its points, which the curvature does not know: leave frames out.
        folds = np.array_split(np.arange(len(evidence)), min(len(evidence), 4))
        left = [_descend(problem.without({*map(int, fold)}), rig, WIDTHS[-1:])[0] for fold in folds]
        apart = np.array([difference(other, rig) for other in left])
        jackknife = np.sqrt((len(folds) - 1) / len(folds) * np.sum((apart - apart.mean(0)) ** 2, axis=0))
        deviation = np.maximum(deviation, jackknife)
    elif leave_out:
        deviation = np.maximum(deviation, problem.prior)  # from so few frames nothing tells how wrong their poses are
    agreement, spread = _judge(problem, rig)
    return decide(rig, start, told, deviation, agreement, spread, _judge(problem, start)[1])


def _descend(problem: _Problem, first: Rig, widths: Sequence[float]) -> tuple[Rig, Float[np.ndarray, "8 8"]]:
    """Gauss-Newton over the eight numbers, robust (Geman-McClure), wide to narrow; the rig, and its information."""
    rig, information = first, np.diag(1 / problem.prior**2)
    for width in widths:
        for _ in range(_STEPS):
            information = np.diag(1 / problem.prior**2)
            slope = _away(rig, problem.start) / problem.prior**2
            for rows, offsets, weights in (_stack(_against_stereo(problem, rig)), _stack(_against_raw(problem, rig))):
                if not len(offsets):
                    continue
                near = np.abs(offsets) < 3 * width
                noise = max(1.4826 * float(np.median(np.abs(offsets[near]))) if near.any() else width, _FINEST)
                each = weights / (1 + (offsets / width) ** 2) ** 2 / noise**2
                information += (rows * each[:, None]).T @ rows
                slope += rows.T @ (each * offsets)
            step = -np.linalg.solve(information, slope)
            rig = _move(rig, step)
            if np.abs(step[:6]).max() < 2e-6:
                break
    return rig, information


# A step is of depth_from_colour: its rotation is turned from the left, its translation shifted; then log focal length
# and log scale.


def _move(rig: Rig, step: Float[np.ndarray, "8"]) -> Rig:
    back = rig.colour_from_depth.inverse()
    turn = rotation_from_vector(step[:3])
    moved = Similarity(turn @ back.rotation, back.translation + step[3:6], np.ones(()))
    K = rig.depth_camera.copy()
    K[[0, 1], [0, 1]] *= np.exp(step[6])
    return Rig(K, moved.inverse(), float(rig.scale * np.exp(step[7])))


def _away(rig: Rig, start: Rig) -> Float[np.ndarray, "8"]:
    """The step from the start to a rig."""
    back, first = rig.colour_from_depth.inverse(), start.colour_from_depth.inverse()
    turn = (back @ first.inverse()).log()[:3]
    focal = np.log(rig.depth_camera[0, 0] / start.depth_camera[0, 0])
    return np.concatenate([turn, back.translation - first.translation, [focal, np.log(rig.scale / start.scale)]])


def _against_stereo(problem: _Problem, rig: Rig):
    """Slopes, distances and weights of the stereo's points, for each frame that has any."""
    back = rig.colour_from_depth.inverse()
    for (points, weight), surface in zip(problem.points, problem.surfaces, strict=True):
        if not len(points):
            continue
        moved = back @ points
        normals, places, known = _look_up(moved, surface, rig)
        turned = moved - back.translation
        offset = (normals * (moved - places)).sum(1)
        focal = (normals[:, :2] * places[:, :2]).sum(1)
        rows = np.column_stack([np.cross(turned, normals), normals, focal, -(normals * places).sum(1)])
        yield rows[known], offset[known], _share(weight[known], _COUNT_STEREO)


def _against_raw(problem: _Problem, rig: Rig):
    """The same of raw points that are carried from one frame into another."""
    back = rig.colour_from_depth.inverse()
    for one, other in problem.pairs:
        source, target = problem.surfaces[one], problem.surfaces[other]
        place, facing = _lift(source, rig, source.rows, source.columns)
        between = problem.poses[other].inverse() @ problem.poses[one]
        inside = between @ (rig.colour_from_depth @ place)
        moved = back @ inside
        turn = back.rotation @ between.rotation @ back.rotation.T
        normals, places, known = _look_up(moved, target, rig)
        known &= ((facing @ turn.T) * normals).sum(1) > 0.7
        offset = (normals * (moved - places)).sum(1)
        carried = normals @ turn  # the target's normal, in the source
        arm = place - back.translation
        rows = np.column_stack(
            [
                np.cross(moved - back.translation, normals) - np.cross(arm, carried),
                normals - carried,
                (normals[:, :2] * places[:, :2]).sum(1) - (carried[:, :2] * place[:, :2]).sum(1),
                (carried * place).sum(1) - (normals * places).sum(1),
            ]
        )
        yield rows[known], offset[known], _share(np.ones(known.sum()), _COUNT_RAW)


def _share(weights, count):
    return weights * min(count / max(weights.sum(), 1e-9), 1)


def _stack(parts):
    rows, offsets, weights = zip(*parts, strict=True) if (parts := list(parts)) else ([], [], [])
    if not rows:
        return np.zeros((0, 8)), np.zeros(0), np.zeros(0)
    return np.concatenate(rows), np.concatenate(offsets), np.concatenate(weights)


def _look_up(points, surface, rig):
    """Where points of the depth camera's frame fall on a raw surface: normals, places, whether it is known there."""
    column, row = np.round(project(rig.depth_camera, points)).astype(int).T
    height, width = surface.depth.shape
    known = (points[:, 2] > 0.05) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
    known &= surface.smooth[row, column]
    places, normals = _lift(surface, rig, row, column)
    return normals, places, known


def _lift(surface, rig, row, column):
    """Points and normals of a raw surface, in the depth camera."""
    pixels = np.stack([column, row], -1).astype(float)
    places = unproject(rig.depth_camera, pixels, rig.scale * surface.depth[row, column])
    rays = places / np.maximum(places[:, 2:], 1e-6)
    along = surface.slope[:, row, column] * rig.scale
    focal = rig.depth_camera[[0, 1], [0, 1]]
    # The normal of z(x, y): tangents along x and y, crossed.
    across = rays * along[0][:, None] + places[:, 2:] * [1 / focal[0], 0, 0]
    down = rays * along[1][:, None] + places[:, 2:] * [0, 1 / focal[1], 0]
    normals = np.cross(across, down)
    return places, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _pair(poses: Sequence[Similarity[np.ndarray]]) -> list[tuple[int, int]]:
    """For every frame those whose directions of view are nearest to certain angles from its own."""
    ahead = np.array([pose.rotation[:, 2] for pose in poses])
    angles = np.rad2deg(np.arccos(np.clip(ahead @ ahead.T, -1, 1)))
    pairs = set()
    for one in range(len(poses)):
        others = np.delete(np.arange(len(poses)), one)
        if len(others):
            pairs |= {(one, int(others[np.abs(angles[one, others] - angle).argmin()])) for angle in _ANGLES}
    return sorted(pairs)


def _judge(problem: _Problem, rig: Rig) -> tuple[float, float]:
    """The share of the stereo's points that agree, to three of the narrowest widths, and their median distance."""
    _, offsets, _ = _stack(_against_stereo(problem, rig))
    near = np.abs(offsets) < 3 * WIDTHS[-1]
    return (float(near.mean()), float(np.median(np.abs(offsets[near])))) if near.any() else (0.0, np.inf)


def _smooth(raw: Float[np.ndarray, "hd wd"], rig: Rig, sigma: float = 1.5) -> _Surface:
    known = (raw > 0).astype(float)
    share = ndimage.gaussian_filter(known, sigma)
    depth = ndimage.gaussian_filter(raw * known, sigma) / np.maximum(share, 1e-6)
    slope = np.stack([ndimage.sobel(depth, axis=1), ndimage.sobel(depth, axis=0)]) / 8
    high = ndimage.maximum_filter(np.where(raw > 0, raw, 0), 5)
    low = ndimage.minimum_filter(np.where(raw > 0, raw, np.inf), 5)
    smooth = (share > 0.7) & (raw > 0) & (high - low < 0.04 * depth)
    surface = _Surface(depth, slope, smooth, *np.nonzero(smooth))
    if not len(surface.rows):
        return surface
    # As many points of every direction of the normal as there are: a plane alone tells three numbers of six.
    _, normals = _lift(surface, rig, surface.rows, surface.columns)
    cell = np.ravel_multi_index(tuple(np.clip((normals * 3 + 3).astype(int), 0, 5).T), (6, 6, 6))
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    rng = np.random.default_rng(0)
    chance = np.minimum(_SAMPLES / len(count) / count, 1)[cell]
    chosen = rng.uniform(size=len(cell)) < chance
    return dataclasses.replace(surface, rows=surface.rows[chosen], columns=surface.columns[chosen])
