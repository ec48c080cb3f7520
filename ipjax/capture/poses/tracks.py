"""Features joined over frames into tracks, and what tracks are worth under given poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.cameras import project, unproject
from ipjax.capture.poses.features import Features, Match
from ipjax.capture.records import CaptureError, Tracks, Trajectory
from ipjax.files.storage.writing import writing
from ipjax.transforms import Similarity

_FIELDS = ("frame", "track", "pixel", "depth")


def join(features: Sequence[Features], matches: Sequence[Match]) -> Tracks:
    """Tracks of all matches, those that are most alike first; one that would put two points of a frame into a track is
    left out, so that a wrong match does not join what are two points of the scene."""
    start = np.concatenate([[0], np.cumsum([len(one) for one in features])])
    frames = np.repeat(np.arange(len(features)), np.diff(start))
    first = np.concatenate([start[m.first] + m.points[:, 0] for m in matches] or [np.zeros(0, int)])
    second = np.concatenate([start[m.second] + m.points[:, 1] for m in matches] or [np.zeros(0, int)])
    order = np.argsort(-np.concatenate([m.likeness for m in matches] or [np.zeros(0)]), kind="stable")
    root = list(range(int(start[-1])))
    seen = [1 << int(frame) for frame in frames]  # by which frames, as bits

    def find(node: int) -> int:
        while root[node] != node:
            root[node] = root[root[node]]
            node = root[node]
        return node

    for a, b in zip(first[order].tolist(), second[order].tolist(), strict=True):
        a, b = find(a), find(b)
        if a != b and not seen[a] & seen[b]:
            root[b] = a
            seen[a] |= seen[b]
    roots = np.array([find(node) for node in range(len(root))], int)
    _, label, size = np.unique(roots, return_inverse=True, return_counts=True)
    kept = size[label] > 1
    pixel = np.concatenate([one.pixel for one in features] or [np.zeros((0, 2))])
    depth = np.concatenate([one.depth for one in features] or [np.zeros(0)])
    return collect(frames[kept], label[kept], pixel[kept], depth[kept])


def collect(
    frame: Int[np.ndarray, " m"],
    track: Int[np.ndarray, " m"],
    pixel: Float[np.ndarray, "m 2"],
    depth: Float[np.ndarray, " m"],
) -> Tracks:
    """Tracks of these observations, numbered anew and sorted; a track that one frame alone sees is left out."""
    _, track, size = np.unique(track, return_inverse=True, return_counts=True)
    kept = size[track] > 1
    order = np.lexsort((frame[kept], track[kept]))
    numbers, track = np.unique(track[kept][order], return_inverse=True)
    return Tracks(frame[kept][order], track, pixel[kept][order], depth[kept][order], len(numbers))


def triangulate(
    tracks: Tracks, poses: Similarity[np.ndarray], K: Float[np.ndarray, "3 3"], known: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "c 3"], Bool[np.ndarray, " c"]]:
    """Of each track the point nearest to all of its rays, in the world of the poses; and whether the rays tell it.

    Args:
      poses: world_from_camera of all frames.
      known: the frames whose poses are.
    """
    rays = unproject(K, tracks.pixel, np.ones(len(tracks.pixel)))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = np.einsum("mij,mj->mi", poses.rotation[tracks.frame], rays)
    weight = known[tracks.frame].astype(np.float64)
    across = weight[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
    system, right = np.zeros((tracks.count, 3, 3)), np.zeros((tracks.count, 3))
    np.add.at(system, tracks.track, across)
    np.add.at(right, tracks.track, np.einsum("mij,mj->mi", across, poses.translation[tracks.frame]))
    values = np.linalg.eigvalsh(system)
    # Two rays at an angle a have the least eigenvalue 1 − cos a: a degree and a half, as COLMAP asks.
    told = values[:, 0] > 1 - np.cos(np.radians(1.5))
    system[~told] = np.eye(3)
    return np.linalg.solve(system, right[..., None])[..., 0], told


def reproject(
    tracks: Tracks, points: Float[np.ndarray, "c 3"], poses: Similarity[np.ndarray], K: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Of each observation, how far its point is from its pixel (pixels), and the point's depth in the frame."""
    arms = points[tracks.track] - poses.translation[tracks.frame]
    local = np.einsum("mji,mj->mi", poses.rotation[tracks.frame], arms) / poses.scale[tracks.frame][:, None]
    apart = np.linalg.norm(project(K, local) - tracks.pixel, axis=1)
    return np.where(local[:, 2] > 0, apart, np.inf), local[:, 2]


def clean(tracks: Tracks, trajectory: Trajectory, K: Float[np.ndarray, "3 3"], within: float = 8.0) -> Tracks:
    """Without what these poses, which may be rough, cannot explain: farther than ``within`` pixels from its point."""
    points, told = triangulate(tracks, trajectory.world_from_camera, K, trajectory.registered)
    apart, _ = reproject(tracks, points, trajectory.world_from_camera, K)
    kept = told[tracks.track] & (apart < within) & trajectory.registered[tracks.frame]
    return collect(*(getattr(tracks, name)[kept] for name in _FIELDS))


def write_tracks(path: str | Path, tracks: Tracks) -> Path:
    """Write tracks as an .npz file, whole or not at all; returns its path. Raises OSError."""
    with writing(path) as temporary:
        np.savez(temporary, **{name: getattr(tracks, name) for name in _FIELDS})
    return Path(path)


def read_tracks(path: str | Path) -> Tracks:
    """The tracks that `write_tracks` wrote.

    Raises:
      CaptureError: missing, or no file of tracks.
    """
    from ipjax.files.images.arrays import load_npz

    try:
        arrays = load_npz(Path(path), _FIELDS)
    except ValueError as error:
        raise CaptureError(str(error)) from None
    shapes = [getattr(arrays.get(name), "shape", None) for name in _FIELDS]
    count = len(arrays["track"]) if shapes[1] else 0
    if shapes != [(count,), (count,), (count, 2), (count,)]:
        raise CaptureError(f"{path}: it is no file of tracks; make it again with ipjax capture pose")
    return collect(*(arrays[name] for name in _FIELDS))
