"""Paths of virtual cameras: through the captured ones, around the middle of the scene, or as a file tells."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ipjax.capture.records import CaptureError
from ipjax.capture.trajectories import FORMAT, read_trajectory
from ipjax.files.rigid import to_rigid
from ipjax.files.storage.parsing import read_json
from ipjax.transforms import Similarity

# Catmull and Rom's weights of the four points around a stretch, in powers of how far along it; added up from the last:
# how much is done of the steps to the second, third and fourth.
_POINTS = np.array([[0, -0.5, 1, -0.5], [1, 0, -2.5, 1.5], [0, 0.5, 2, -1.5], [0, 0, -0.5, 0.5]])
_STEPS = np.cumsum(_POINTS[::-1], axis=0)[::-1][1:]
_FINE = 32  # steps of every stretch of a path, by which its length is measured
_TURN = 0.5  # metres of path that a turn by one radian counts
_GAP = np.deg2rad(70)  # between neighbouring cameras, above which an orbit does not go through


def smooth_path(captured: Similarity[np.ndarray], count: int) -> Similarity[np.ndarray]:
    """Cameras evenly along a smooth path that goes through all captured ones in their order, [count].

    A Catmull–Rom spline in SE(3), in the cumulative form (M.-J. Kim, M.-S. Kim and S. Y. Shin, "A general construction
    scheme for unit quaternion curves with simple high order derivatives", SIGGRAPH 1995).

    Args:
      captured: ``world_from_camera``, rigid, [n].

    Raises:
      ValueError: there are no two cameras, or nothing is asked for.
    """
    known = len(captured.scale)
    if known < 2 or count < 1:
        raise ValueError(f"a path needs two cameras or more and one view or more, not {known} and {count}")
    share = np.arange(_FINE) / _FINE
    done = _powers(share) @ _STEPS.T
    rows = np.clip(np.arange(known - 1)[:, None] + np.arange(-1, 3), 0, known - 1)
    fine = []
    for a, b, c, d in rows:
        pose = captured.take(a)
        for step, (first, second) in enumerate(((a, b), (b, c), (c, d))):
            motion = (captured.take(first).inverse() @ captured.take(second)).log()[:6]
            pose = pose @ Similarity[np.ndarray].exp(done[:, step, None] * motion)
        fine.append(pose)
    fine.append(captured.take(slice(known - 1, None)))
    path = _join(fine)
    lengths = np.linalg.norm(np.diff(path.translation, axis=0), axis=-1)
    turned = path.take(slice(None, -1)).inverse() @ path.take(slice(1, None))
    lengths = lengths + _TURN * np.linalg.norm(turned.log()[:, :3], axis=-1)
    along = np.concatenate([[0], np.cumsum(lengths)])
    wanted = np.linspace(0, along[-1], count)
    place = np.clip(np.searchsorted(along, wanted, side="right") - 1, 0, len(lengths) - 1)
    rest = (wanted - along[place]) / np.maximum(lengths[place], 1e-12)
    motion = turned.take(place).log()[:, :6]
    return (path.take(place) @ Similarity[np.ndarray].exp(np.clip(rest, 0, 1)[:, None] * motion)).orthonormal()


def orbit_path(captured: Similarity[np.ndarray], middle: Float[np.ndarray, "3"], count: int) -> Similarity[np.ndarray]:
    """Cameras on a circle about the middle of the scene, as far and as high as the captured ones are, [count].

    Where these leave out more than 70°, the path swings to and fro over the part that they saw.

    Raises:
      ValueError: there are no two cameras, or nothing is asked for.
    """
    known = len(captured.scale)
    if known < 2 or count < 1:
        raise ValueError(f"a path needs two cameras or more and one view or more, not {known} and {count}")
    up = find_up(captured)
    from_middle = captured.translation - middle
    distance = float(np.median(np.linalg.norm(from_middle, axis=-1)))
    elevation = float(np.median(np.arcsin(np.clip(from_middle @ up / np.linalg.norm(from_middle, axis=-1), -1, 1))))
    first = from_middle[0] - (from_middle[0] @ up) * up
    if np.linalg.norm(first) < 1e-6:
        first = np.eye(3)[np.abs(up).argmin()] - up[np.abs(up).argmin()] * up
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    azimuth = np.sort(np.arctan2(from_middle @ second, from_middle @ first) % (2 * np.pi))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] > _GAP:
        start, reach = azimuth[(widest + 1) % known], 2 * np.pi - gaps[widest]
        angles = start + reach * 0.5 * (1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count))
    else:
        angles = 2 * np.pi * np.arange(count) / count
    outwards = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    places = middle + distance * (np.cos(elevation) * outwards + np.sin(elevation) * up)
    return look_from(places, middle, up)


def look_from(
    places: Float[np.ndarray, "n 3"], at: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Similarity[np.ndarray]:
    """``world_from_camera`` of cameras that look at a point and are held level, [n]."""
    ahead = at - places
    ahead = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    right = np.cross(ahead, up)
    length = np.linalg.norm(right, axis=-1, keepdims=True)
    other = np.cross(ahead, np.eye(3)[np.abs(up).argmin()])  # straight from above, any side is level
    right = np.where(length > 1e-6, right, other)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return Similarity(np.stack([right, np.cross(ahead, right), ahead], -1), places, np.ones(len(places)))


def find_up(captured: Similarity[np.ndarray]) -> Float[np.ndarray, "3"]:
    """Away from where most cameras' images point down: the normal of the plane of their x axes, where they go around
    something, else the mean.
    """
    across, down = captured.rotation[:, :, 0], captured.rotation[:, :, 1].mean(0)
    values, vectors = np.linalg.eigh(across.T @ across)
    normal = vectors[:, 0] if values[1] > 0.05 * values[2] else down / np.linalg.norm(down)
    return -normal * np.sign(normal @ down or 1)


def read_path(path: str | Path) -> Similarity[np.ndarray]:
    """``world_from_camera`` [n] of a file: a list of 4 × 4 matrices in metres, a dictionary of them (in its order), or
    what `ipjax capture pose` writes.

    Raises:
      CaptureError: it is missing, or no path; names it.
    """
    try:
        document = read_json(path, "path of cameras")
        if isinstance(document, dict) and document.get("format") == FORMAT:
            trajectory = read_trajectory(path)
            return trajectory.world_from_camera.take(trajectory.registered)
        matrices = list(document.values()) if isinstance(document, dict) else document
        array = np.asarray(matrices, np.float64)
        if array.ndim != 3 or array.shape[1:] != (4, 4) or not len(array):
            raise ValueError("its entries are no 4 × 4 matrices")
        return to_rigid(array)
    except (ValueError, TypeError) as error:
        if isinstance(error, CaptureError):
            raise
        text = str(error)
        raise CaptureError(
            f"{'' if str(path) in text else f'{path}: '}{text}; "
            "give a JSON list of 4 × 4 matrices world_from_camera, in metres"
        ) from None


def _powers(share: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(share), share, share**2, share**3], -1)


def _join(poses: Sequence[Similarity[np.ndarray]]) -> Similarity[np.ndarray]:
    return Similarity(
        *(np.concatenate([getattr(p, part) for p in poses]) for part in ("rotation", "translation", "scale"))
    )
