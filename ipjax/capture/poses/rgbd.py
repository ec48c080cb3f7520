"""Poses from features and depth alone, metric from the start: what finds them where pycolmap is not installed.

Pairs of frames by the points that one has measured and the other sees (perspective n points), the frames placed along
the tree of the best pairs, and then everything adjusted at once: pixels and measured depths of all tracks (`adjust`).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ipjax.cameras import project, unproject
from ipjax.capture.poses.features import FEWEST, Features, Match
from ipjax.capture.poses.scale import LEAST_SHARE, check_registered, vote
from ipjax.capture.poses.tracks import collect, join, reproject, triangulate
from ipjax.capture.records import CaptureError, Tracks, Trajectory
from ipjax.transforms import Similarity, rotation_from_vector

SOURCE = "features and depth"
PIXELS = 1.0  # standard deviation of a feature's place
DEPTH = 0.01  # of a measured depth, as a share of it
LEAST_KEPT = 0.3  # of a frame's observations that must agree with its pose
_WIDTHS = (10.0, 5.0, 3.0)  # of the robust loss, standard deviations, from coarse to fine
_REFINED = 3  # times that the motion of two frames is refined and its inliers are chosen anew
_NOISE = 0.5  # pixels by which an inlier may be off in any case


@dataclasses.dataclass(frozen=True)
class Edge:
    """How two frames stand to each other."""

    first: int
    second: int
    second_from_first: Similarity[np.ndarray]
    support: int  # points that agree


def find_by_depth(
    names: Sequence[str], features: Sequence[Features], matches: Sequence[Match], K: Float[np.ndarray, "3 3"]
) -> Trajectory:
    """The poses of the frames that hang together.

    Raises:
      CaptureError: too few do, or what was measured does not agree with them.
    """
    edges = [edge for found in matches if (edge := relate(found, features, K)) is not None]
    poses, registered = _span(edges, len(names))
    check_registered(names, registered)
    joined = _only(join(features, matches), registered)
    poses, tracks = adjust(poses, joined, K)
    before, after = (np.bincount(x.frame, minlength=len(names)) for x in (joined, tracks))
    registered &= (after >= FEWEST) & (after > LEAST_KEPT * before)
    check_registered(names, registered)
    points, told = triangulate(tracks, poses, K, registered)
    _, own = reproject(tracks, points, poses, K)
    found = vote(np.where(told[tracks.track] & registered[tracks.frame], tracks.depth, 0), own)
    # Of all that was measured, not of what was left in because it agrees.
    asked = int(((joined.depth > 0) & registered[joined.frame]).sum())
    share = 0.0 if found is None else float(found.agreeing.sum() / asked)
    if share < LEAST_SHARE:
        raise CaptureError(
            f"the poses found are wrong: only {100 * share:.0f} % of the measured depths agree with them; something "
            "may move with the camera (hide it with ignore.png), or the depth may not belong to the colours"
        )
    rotation = np.where(registered[:, None, None], poses.rotation, np.eye(3))
    translation = np.where(registered[:, None], poses.translation, 0)
    known = Similarity(rotation, translation, np.ones(len(names)))
    return Trajectory(tuple(names), known, registered, SOURCE, scale=1.0, agreement=share)


def relate(found: Match, features: Sequence[Features], K: Float[np.ndarray, "3 3"]) -> Edge | None:
    """The motion between two frames that most points agree on, whichever of the two has more depth."""
    import cv2

    one, other = features[found.first], features[found.second]
    depths = one.depth[found.points[:, 0]], other.depth[found.points[:, 1]]
    pixels = one.pixel[found.points[:, 0]], other.pixel[found.points[:, 1]]
    here = int((depths[1] > 0).sum() > (depths[0] > 0).sum())  # which of the two the points come from
    known = depths[here] > 0
    if known.sum() < FEWEST:
        return None
    points = unproject(K, pixels[here][known], depths[here][known])
    try:
        good, turn, shift, inside = cv2.solvePnPRansac(
            points, pixels[1 - here][known], K, None,
            iterationsCount=1000, reprojectionError=4.0, confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:
        return None
    if not good or inside is None or len(inside) < max(FEWEST, 0.3 * known.sum()):
        return None
    there_from_here = _refine(points, pixels[1 - here][known], K, turn, shift, inside.ravel())
    motion = there_from_here.inverse() if here else there_from_here
    return Edge(found.first, found.second, motion, len(inside))


def _refine(
    points: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    K: Float[np.ndarray, "3 3"],
    turn: np.ndarray,
    shift: np.ndarray,
    inside: np.ndarray,
) -> Similarity[np.ndarray]:
    """The motion of least reprojection error, on inliers that are chosen anew each time.

    What RANSAC returns has the least algebraic error within four pixels, which makes motions shorter than they are: by
    a tenth between frames 11° apart.
    """
    import cv2

    chosen = inside
    motion = Similarity(rotation_from_vector(turn.reshape(3)), shift.reshape(3), np.ones(()))
    for _ in range(_REFINED):
        turn, shift = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], K, None, turn, shift)
        motion = Similarity(rotation_from_vector(turn.reshape(3)), shift.reshape(3), np.ones(()))
        off = np.linalg.norm(project(K, motion @ points) - pixels, axis=1)
        chosen = np.flatnonzero(off <= max(3 * np.median(off[inside]), _NOISE))  # always half of them, at least
    return motion


def _span(edges: Sequence[Edge], count: int) -> tuple[Similarity[np.ndarray], Bool[np.ndarray, " n"]]:
    """``world_from_camera`` along the tree of the edges with the most support, from the frame that has most of it.

    Also which frames it reaches.
    """
    rotation, translation, reached = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, bool)
    weight = np.zeros(count)
    for edge in edges:
        weight[[edge.first, edge.second]] += edge.support
    reached[weight.argmax()] = bool(edges)
    while True:
        open_edges = [edge for edge in edges if reached[edge.first] != reached[edge.second]]
        if not open_edges:
            return Similarity(rotation, translation, np.ones(count)), reached
        best = max(open_edges, key=lambda edge: edge.support)
        old, new = (best.first, best.second) if reached[best.first] else (best.second, best.first)
        old_from_new = best.second_from_first.inverse() if old == best.first else best.second_from_first
        pose = Similarity(rotation[old], translation[old], np.ones(())) @ old_from_new
        rotation[new], translation[new], reached[new] = pose.rotation, pose.translation, True


def _only(tracks: Tracks, registered: Bool[np.ndarray, " n"]) -> Tracks:
    kept = registered[tracks.frame]
    return collect(tracks.frame[kept], tracks.track[kept], tracks.pixel[kept], tracks.depth[kept])


def adjust(
    poses: Similarity[np.ndarray], tracks: Tracks, K: Float[np.ndarray, "3 3"], steps: int = 10
) -> tuple[Similarity[np.ndarray], Tracks]:
    """Bundle adjustment of pixels and measured depths, robust; after each round what stays far off is left out.

    A shift that all measured depths share (the factory is wrong about where the depth camera stands) is not sought: of
    made captures the features alone told it no better than to 3 mm, which is what it is.

    Args:
      poses: world_from_camera of all frames; those that see no track stay as they are.

    Returns:
      The poses; and the tracks that agree with them.
    """
    for width in _WIDTHS:
        tracks, points = _agreeing(_State(poses, _lift(poses, tracks, K)), tracks, K, 2 * width)
        if not tracks.count:
            break
        poses, points = _descend(_State(poses, points), tracks, K, width, steps)
        tracks, _ = _agreeing(_State(poses, points), tracks, K, width)
    return poses, tracks


class _State(NamedTuple):
    """What is adjusted."""

    poses: Similarity[np.ndarray]
    points: np.ndarray


def _agreeing(state: _State, tracks: Tracks, K: np.ndarray, within: float) -> tuple[Tracks, np.ndarray]:
    """The observations that are off by so many standard deviations at most, and their points."""
    off, depth_off = _misfit(state, tracks, K)
    kept = (off < within) & (depth_off < within)
    left = collect(tracks.frame[kept], tracks.track[kept], tracks.pixel[kept], tracks.depth[kept])
    numbers, counts = np.unique(tracks.track[kept], return_counts=True)
    return left, state.points[numbers[counts > 1]]


def _lift(poses: Similarity[np.ndarray], tracks: Tracks, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "c 3"]:
    """Of each track the median of the points that its frames measured; where none did, what its rays tell."""
    told, _ = triangulate(tracks, poses, K, np.ones(len(poses.scale), bool))
    local = unproject(K, tracks.pixel, np.maximum(tracks.depth, 1e-6))
    world = np.einsum("mij,mj->mi", poses.rotation[tracks.frame], local) + poses.translation[tracks.frame]
    for track, start, end in zip(*_runs(tracks), strict=True):
        measured = tracks.depth[start:end] > 0
        if measured.any():
            told[track] = np.median(world[start:end][measured], axis=0)
    return told


def _runs(tracks: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tracks, and where the observations of each begin and end."""
    start = np.searchsorted(tracks.track, np.arange(tracks.count))
    return np.arange(tracks.count), start, np.append(start[1:], len(tracks.track))


def _locate(state: _State, tracks: Tracks) -> Float[np.ndarray, "m 3"]:
    """Each observed point in its camera."""
    arms = state.points[tracks.track] - state.poses.translation[tracks.frame]
    return np.einsum("mji,mj->mi", state.poses.rotation[tracks.frame], arms)


def _misfit(state: _State, tracks: Tracks, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each observation how far pixel and depth are off, in standard deviations; a depth that is unknown is not."""
    local = _locate(state, tracks)
    off = np.linalg.norm(project(K, local) - tracks.pixel, axis=1) / PIXELS
    known = tracks.depth > 0
    depth_off = np.abs(local[:, 2] - tracks.depth) / (DEPTH * np.where(known, tracks.depth, 1))
    return np.where(local[:, 2] > 1e-6, off, np.inf), np.where(known, depth_off, 0)


def _descend(state: _State, tracks: Tracks, K: np.ndarray, width: float, steps: int) -> _State:
    """Levenberg–Marquardt with the points eliminated (Schur complement); Cauchy's loss of this width."""

    def loss(state: _State) -> float:
        return float(sum(np.log1p((np.minimum(x, 1e6) / width) ** 2).sum() for x in _misfit(state, tracks, K)))

    here, damping = loss(state), 1e-3
    for _ in range(steps):
        move, shift = _solve(state, tracks, K, width, damping)
        # Of camera_from_world, on its left.
        rotation = state.poses.rotation @ np.swapaxes(rotation_from_vector(move[:, :3]), -1, -2)
        places = state.poses.translation - np.einsum("nij,nj->ni", rotation, move[:, 3:])
        new = _State(Similarity(rotation, places, np.ones(len(move))), state.points + shift)
        there = loss(new)
        if there < here:
            done = here - there < 1e-5 * here
            state, here, damping = new, there, max(damping / 5, 1e-7)
            if done:
                break
        else:
            damping *= 10
    return state


def _solve(
    state: _State, tracks: Tracks, K: np.ndarray, width: float, damping: float
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "c 3"]]:
    """One step: of each camera_from_world (turn, shift), and of each point."""
    from scipy import sparse

    count, seen = len(state.poses.scale), len(tracks.frame)
    local = _locate(state, tracks)
    z = np.maximum(local[:, 2], 1e-6)
    known = tracks.depth > 0
    sigma = DEPTH * np.where(known, tracks.depth, 1)
    # Three residuals of each observation, and their slopes in its place in the camera.
    depth_off = (z - tracks.depth) / sigma
    residual = np.concatenate([(project(K, local) - tracks.pixel) / PIXELS, depth_off[:, None]], axis=1)
    off, depth_off = _misfit(state, tracks, K)
    weight = 1 / (1 + (np.stack([off, off, depth_off], axis=1) / width) ** 2)
    weight[:, 2] *= known
    slope = np.zeros((seen, 3, 3))
    slope[:, 0, 0], slope[:, 1, 1] = K[0, 0] / z / PIXELS, K[1, 1] / z / PIXELS
    slope[:, :2, 2] = -slope[:, [0, 1], [0, 1]] * local[:, :2] / z[:, None]
    slope[:, 2, 2] = 1 / sigma
    cross = np.zeros((seen, 3, 3))  # of a turn: turn × place
    cross[:, [0, 1, 2], [1, 2, 0]], cross[:, [1, 2, 0], [0, 1, 2]] = local[:, [2, 0, 1]], -local[:, [2, 0, 1]]
    of_camera = np.concatenate([slope @ cross, slope], axis=2)  # m × 3 × 6
    of_point = slope @ np.swapaxes(state.poses.rotation[tracks.frame], -1, -2)

    rows = 3 * np.arange(seen)[:, None, None] + np.arange(3)[:, None]
    camera_columns = 6 * tracks.frame[:, None] + np.arange(6)
    point_columns = 3 * tracks.track[:, None] + np.arange(3)

    def spread(blocks: np.ndarray, columns: np.ndarray, width: int) -> Any:
        at = np.broadcast_to(rows, blocks.shape), np.broadcast_to(columns[:, None], blocks.shape)
        return sparse.csr_matrix((blocks.reshape(-1), tuple(x.reshape(-1) for x in at)), (3 * seen, width))

    cameras = spread(of_camera, camera_columns, 6 * count)
    points = spread(of_point, point_columns, 3 * tracks.count)
    weighted = cameras.T @ sparse.diags(weight.reshape(-1))
    system, across = (weighted @ cameras).toarray(), (weighted @ points).tocsr()
    right = weighted @ residual.reshape(-1)
    start = np.searchsorted(tracks.track, np.arange(tracks.count))
    turned = np.swapaxes(weight[..., None] * of_point, -1, -2)
    blocks = np.add.reduceat(turned @ of_point, start)
    point_right = np.add.reduceat((turned @ residual[..., None])[..., 0], start)
    for diagonal in (np.einsum("ii->i", system), np.einsum("nii->ni", blocks)):  # views
        diagonal += damping * diagonal + 1e-9 * diagonal.max() + 1e-12
    inverse = np.linalg.inv(blocks)
    gain = across @ sparse.bsr_matrix((inverse, np.arange(tracks.count), np.arange(tracks.count + 1))).tocsr()
    system -= (gain @ across.T).toarray()
    move = -np.linalg.solve(system, right - gain @ point_right.reshape(-1))
    back = point_right + (across.T @ move).reshape(-1, 3)
    return move.reshape(count, 6), -np.einsum("pij,pj->pi", inverse, back)
