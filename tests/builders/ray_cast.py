"""Depth images of a table with balls and blocks, by casting rays: exact, and quick where images are small."""

import numpy as np

from ipjax.transforms import Similarity

K = np.array([[150.0, 0, 79], [0, 152.0, 61], [0, 0, 1]])
SIZE = (160, 120)
BALLS = [(np.array([-0.16, 0.05, 0.06]), 0.06), (np.array([0.2, 0.12, 0.045]), 0.045)]
BLOCKS = [
    (np.array([0.05, -0.1, 0.05]), np.array([0.06, 0.035, 0.05])),
    (np.array([-0.04, 0.17, 0.08]), np.array([0.035, 0.05, 0.08])),
    (np.array([0.19, -0.05, 0.03]), np.array([0.025, 0.06, 0.03])),
]


def go_around(count: int, seed: int = 0, arc: float = 2 * np.pi) -> Similarity:
    """``world_from_camera`` of cameras around the table, which look at its middle."""
    rng = np.random.default_rng([seed, 3])
    azimuth = arc * np.arange(count) / count + rng.normal(0, 0.05, count)
    elevation, distance = rng.uniform(0.5, 1.0, count), rng.uniform(0.55, 0.75, count)
    back = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1)
    ahead = -back
    right = np.cross(ahead, [0.0, 0, 1])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    rotation = np.stack([right, np.cross(ahead, right), ahead], -1)
    return Similarity(rotation, [0, 0, 0.04] + distance[:, None] * back, np.ones(count))


def cast(world_from_camera: Similarity, *, things: bool = True, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Depth along z of every frame, ``n h w``, metres, with noise of this standard deviation."""
    rng = np.random.default_rng([seed, 4])
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(rows.shape)], -1)
    depths = []
    for rotation, start in zip(world_from_camera.rotation, world_from_camera.translation, strict=True):
        along = rays @ rotation.T
        depth = np.where(along[..., 2] < 0, -start[2] / np.minimum(along[..., 2], -1e-9), np.inf)
        for middle, radius in BALLS if things else []:
            arm = start - middle
            a, b, c = (along**2).sum(-1), along @ arm, arm @ arm - radius**2
            root = b**2 - a * c
            hit = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
            depth = np.minimum(depth, hit)
        for middle, half in BLOCKS if things else []:
            safe = np.where(np.abs(along) < 1e-9, 1e-9, along)
            one, other = (middle - half - start) / safe, (middle + half - start) / safe
            enter, leave = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
            depth = np.minimum(depth, np.where((enter < leave) & (enter > 0), enter, np.inf))
        depth = np.where(depth < 2, depth, 0)
        depths.append(np.where(depth > 0, depth + noise * rng.normal(size=depth.shape), 0))
    return np.stack(depths).astype(np.float32)
