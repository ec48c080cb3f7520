"""Poses from features and depth alone, metric from the start: what finds them where pycolmap is not installed.

Pairs of frames by the points that one has measured and the other sees (perspective n points), the frames placed along
the tree of the best pairs, and then everything adjusted at once: pixels and measured depths of all tracks (`adjust`).
"""

import dataclasses
from collections.abc import Sequence

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
_WIDTHS = (10.0, 5.0, 3.0)  # of the robust loss, standard deviations, from coarse to fine


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
    edges = [edge for found in matches if (edge := _relate(found, features, K)) is not None]
    poses, registered = _span(edges, len(names))
    check_registered(names, registered)
    tracks = _only(join(features, matches), registered)
    poses, tracks = adjust(poses, tracks, K)
    seen = np.bincount(tracks.frame, minlength=len(names))
    registered &= seen >= FEWEST
    check_registered(names, registered)
    points, told = triangulate(tracks, poses, K, registered)
    _, own = reproject(tracks, points, poses, K)
    found = vote(np.where(told[tracks.track], tracks.depth, 0), own)
    if found is None or found.share < LEAST_SHARE:
        share = 0 if found is None else found.share
        raise CaptureError(
            f"the poses found are wrong: only {100 * share:.0f} % of the measured depths agree with them; something "
            "may move with the camera (hide it with ignore.png), or the depth may not belong to the colours"
        )
    rotation = np.where(registered[:, None, None], poses.rotation, np.eye(3))
    translation = np.where(registered[:, None], poses.translation, 0)
    known = Similarity(rotation, translation, np.ones(len(names)))
    return Trajectory(tuple(names), known, registered, SOURCE, scale=1.0, agreement=found.share)


def _relate(found: Match, features: Sequence[Features], K: Float[np.ndarray, "3 3"]) -> Edge | None:
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
    there_from_here = Similarity(rotation_from_vector(turn.reshape(3)), shift.reshape(3), np.ones(()))
    motion = there_from_here.inverse() if here else there_from_here
    return Edge(found.first, found.second, motion, len(inside))


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

    Args:
      poses: world_from_camera of all frames; those that see no track stay as they are.

    Returns:
      The poses; and the tracks that agree with them.
    """
    for width in _WIDTHS:
        points = _lift(poses, tracks, K)
        tracks, points = _agreeing(poses, points, tracks, K, 2 * width)
        poses, points = _descend(poses, points, tracks, K, width, steps)
    return poses, _agreeing(poses, points, tracks, K, _WIDTHS[-1])[0]


def _agreeing(
    poses: Similarity[np.ndarray], points: np.ndarray, tracks: Tracks, K: np.ndarray, within: float
) -> tuple[Tracks, np.ndarray]:
    """The observations that are off by so many standard deviations at most, and their points."""
    off, depth_off = _misfit(poses, points, tracks, K)
    kept = (off < within) & (depth_off < within)
    left = collect(tracks.frame[kept], tracks.track[kept], tracks.pixel[kept], tracks.depth[kept])
    numbers, counts = np.unique(tracks.track[kept], return_counts=True)
    return left, points[numbers[counts > 1]]


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


def _locate(poses: Similarity[np.ndarray], points: np.ndarray, tracks: Tracks) -> Float[np.ndarray, "m 3"]:
    """Each observed point in its camera."""
    arms = points[tracks.track] - poses.translation[tracks.frame]
    return np.einsum("mji,mj->mi", poses.rotation[tracks.frame], arms)


def _misfit(
    poses: Similarity[np.ndarray], points: np.ndarray, tracks: Tracks, K: np.ndarray
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Of each observation how far pixel and depth are off, in standard deviations; a depth that is unknown is not."""
    local = _locate(poses, points, tracks)
    off = np.linalg.norm(project(K, local) - tracks.pixel, axis=1) / PIXELS
    known = tracks.depth > 0
    depth_off = np.abs(local[:, 2] - tracks.depth) / (DEPTH * np.where(known, tracks.depth, 1))
    return np.where(local[:, 2] > 1e-6, off, np.inf), np.where(known, depth_off, 0)


def _descend(
    poses: Similarity[np.ndarray], points: np.ndarray, tracks: Tracks, K: np.ndarray, width: float, steps: int
) -> tuple[Similarity[np.ndarray], np.ndarray]:
    """Levenberg–Marquardt with the points eliminated (Schur complement); Cauchy's loss of this width."""

    def loss(poses: Similarity[np.ndarray], points: np.ndarray) -> float:
        off, depth_off = _misfit(poses, points, tracks, K)
        return float(sum(np.log1p((np.minimum(x, 1e6) / width) ** 2).sum() for x in (off, depth_off)))

    here, damping = loss(poses, points), 1e-3
    for _ in range(steps):
        move, shift = _solve(poses, points, tracks, K, width, damping)
        turned = rotation_from_vector(move[:, :3])  # of camera_from_world, on its left
        rotation = poses.rotation @ np.swapaxes(turned, -1, -2)
        new = Similarity(
            rotation, poses.translation - np.einsum("nij,nj->ni", rotation, move[:, 3:]), np.ones(len(move))
        )
        there = loss(new, points + shift)
        if there < here:
            done = here - there < 1e-5 * here
            poses, points, here, damping = new, points + shift, there, max(damping / 5, 1e-7)
            if done:
                break
        else:
            damping *= 10
    return poses, points


def _solve(
    poses: Similarity[np.ndarray], points: np.ndarray, tracks: Tracks, K: np.ndarray, width: float, damping: float
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "c 3"]]:
    """One step: of each camera_from_world (turn, shift), and of each point."""
    from scipy import sparse

    count = len(poses.scale)
    local = _locate(poses, points, tracks)
    z = np.maximum(local[:, 2], 1e-6)
    known = tracks.depth > 0
    sigma = DEPTH * np.where(known, tracks.depth, 1)
    # Three residuals of each observation, and their slopes in its place in the camera.
    residual = np.concatenate(
        [(project(K, local) - tracks.pixel) / PIXELS, ((z - tracks.depth) / sigma)[:, None]], axis=1
    )
    off, depth_off = _misfit(poses, points, tracks, K)
    weight = 1 / (1 + (np.stack([off, off, depth_off], axis=1) / width) ** 2)
    weight[:, 2] *= known
    slope = np.zeros((len(z), 3, 3))
    slope[:, 0, 0], slope[:, 1, 1] = K[0, 0] / z / PIXELS, K[1, 1] / z / PIXELS
    slope[:, :2, 2] = -slope[:, [0, 1], [0, 1]] * local[:, :2] / z[:, None]
    slope[:, 2, 2] = 1 / sigma
    cross = np.zeros((len(z), 3, 3))  # of a turn: turn × place
    cross[:, [0, 1, 2], [1, 2, 0]], cross[:, [1, 2, 0], [0, 1, 2]] = (
        local[:, [2, 0, 1]],
        -local[:, [2, 0, 1]],
    )
    of_camera = np.concatenate([slope @ cross, slope], axis=2)  # m × 3 × 6
    of_point = slope @ np.swapaxes(poses.rotation[tracks.frame], -1, -2)
    weighted = weight[..., None] * of_camera
    blocks, right = np.zeros((count, 6, 6)), np.zeros((count, 6))
    for index in range(count):
        mine = tracks.frame == index
        blocks[index] = weighted[mine].reshape(-1, 6).T @ of_camera[mine].reshape(-1, 6)
        right[index] = weighted[mine].reshape(-1, 6).T @ residual[mine].reshape(-1)
    _, start, _ = _runs(tracks)
    point_weighted = np.swapaxes(weight[..., None] * of_point, -1, -2)
    point_blocks = np.add.reduceat(point_weighted @ of_point, start)
    point_right = np.add.reduceat((point_weighted @ residual[..., None])[..., 0], start)
    for some in (blocks, point_blocks):
        diagonal = np.einsum("nii->ni", some)  # a view
        diagonal += damping * diagonal + 1e-9 * diagonal.max() + 1e-12
    inverse = np.linalg.inv(point_blocks)
    mixed = np.swapaxes(weighted, -1, -2) @ of_point  # m × 6 × 3
    rows = (6 * tracks.frame[:, None, None] + np.arange(6)[:, None] + np.zeros((1, 1, 3), int)).reshape(-1)
    columns = (3 * tracks.track[:, None, None] + np.arange(3) + np.zeros((1, 6, 1), int)).reshape(-1)
    shape = 6 * count, 3 * tracks.count
    across = sparse.csr_matrix((mixed.reshape(-1), (rows, columns)), shape)
    gain = sparse.csr_matrix(((mixed @ inverse[tracks.track]).reshape(-1), (rows, columns)), shape)
    system = -(gain @ across.T).toarray()
    for index in range(count):
        at = slice(6 * index, 6 * index + 6)
        system[at, at] += blocks[index]
    move = -np.linalg.solve(system, right.reshape(-1) - gain @ point_right.reshape(-1)).reshape(count, 6)
    back = point_right + (across.T @ move.reshape(-1)).reshape(-1, 3)
    return move, -np.einsum("pij,pj->pi", inverse, back)
