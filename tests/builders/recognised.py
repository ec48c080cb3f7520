"""What frames of a made scene recognise of it, without images: points at random, descriptors of their own, noise."""

import numpy as np

from ipjax.cameras import project
from ipjax.capture.poses.features import Features
from ipjax.transforms import Similarity

K = np.array([[300.0, 0, 158], [0, 302, 121], [0, 0, 1]])
SIZE = 320, 240


def look_around(count: int, seed: int = 0, arc: float = 1.5) -> Similarity[np.ndarray]:
    """``world_from_camera`` of cameras on an arc (rad) about the origin, 0.7 m away, that look at it."""
    rng = np.random.default_rng([seed, 3])
    angle = np.linspace(0, arc, count) + rng.normal(0, 0.02, count)
    height = 0.5 + rng.normal(0, 0.05, count)
    back = np.stack([np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)], axis=1)
    ahead = -back
    right = np.cross(ahead, [0.0, 0, 1])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    return Similarity(rotation, (0.7 + rng.normal(0, 0.03, (count, 1))) * back, np.ones(count))


def recognise(
    poses: Similarity[np.ndarray],
    points: int = 500,
    seed: int = 0,
    *,
    noise: float = 0.3,
    depth_noise: float = 0.002,
    unit: float = 1.0,
    missing: float = 0.2,
    strange: int = 40,
) -> list[Features]:
    """Features of each camera: of the points that it sees, and some that no other has.

    Args:
      noise: of pixels.
      depth_noise: share of the depth.
      unit: measured over true depth.
      missing: share of points without a measured depth.
      strange: features that belong to nothing.
    """
    rng = np.random.default_rng([seed, 4])
    scene = rng.uniform([-0.25, -0.25, 0], [0.25, 0.25, 0.2], (points, 3))
    looks = rng.random((points, 128)) ** 4
    found = []
    for rotation, translation in zip(poses.rotation, poses.translation, strict=True):
        local = (scene - translation) @ rotation
        pixel = project(K, local)
        seen = (pixel > 2).all(1) & (pixel < np.array(SIZE) - 3).all(1) & (rng.random(points) < 0.7)
        pixel = pixel[seen] + rng.normal(0, noise, (seen.sum(), 2))
        depth = local[seen, 2] * unit * (1 + rng.normal(0, depth_noise, seen.sum()))
        depth *= rng.random(seen.sum()) >= missing
        look = looks[seen] + 0.02 * rng.random((seen.sum(), 128))
        pixel = np.concatenate([pixel, rng.uniform(5, 230, (strange, 2))])
        depth = np.concatenate([depth, rng.uniform(0.3, 1, strange)])
        look = np.concatenate([look, rng.random((strange, 128)) ** 4])
        look /= np.linalg.norm(look, axis=1, keepdims=True)
        found.append(Features(pixel, depth, look.astype(np.float32), np.arange(len(pixel))))
    return found


def compare(
    found: Similarity[np.ndarray], truth: Similarity[np.ndarray], known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far each known pose is off once the two worlds lie over each other: metres, degrees."""
    first, second = found.translation[known], truth.translation[known]
    turn = np.linalg.svd(np.einsum("nij,nkj->ik", truth.rotation[known], found.rotation[known]))
    turn = turn[0] @ turn[2]
    shift = second.mean(0) - turn @ first.mean(0)
    apart = np.linalg.norm(first @ turn.T + shift - second, axis=1)
    rest = np.swapaxes(truth.rotation[known], 1, 2) @ (turn @ found.rotation[known])
    cosine = np.clip((np.trace(rest, axis1=1, axis2=2) - 1) / 2, -1, 1)
    return apart, np.degrees(np.arccos(cosine))
