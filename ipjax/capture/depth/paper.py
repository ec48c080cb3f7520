"""Depth aligned to colours as the paper does it: RobotP's Algorithm 1 (H. Yuan et al., Sensors 2021).

The depth camera's image is laid over the colours as if both cameras stood in the same place, and every patch of the
depth that stereo estimated looks for the captured patch that has its depth and its normals. The paper's estimate is
COLMAP's, without a scale; here it is the plane sweep's.
"""

import dataclasses

import jax
import numpy as np
from ipjax_kernels.depth.propagation import propagate_offsets
from jaxtyping import Float, Int
from scipy import ndimage

from ipjax.cameras import unproject

REACH = 0.06  # of the image's width: offsets that are tried
_UNIT = 0.015  # metres: two depths that differ by more have nothing in common
_AGREE = 0.01  # of the scale: votes that agree
_LEAST = 0.5  # cost above which a patch found nothing


@dataclasses.dataclass(frozen=True)
class PaperDepth:
    """Captured depth in the pixels of the colours."""

    depth: Float[np.ndarray, "h w"]  # metres along z, 0 = unknown
    offsets: Int[np.ndarray, "h w 2"]  # x, y: from a pixel to the captured one
    cost: Float[np.ndarray, "h w"]  # of the patches, in [0, 1]
    scale: float  # captured metres per unit of the estimated depth
    agreement: float  # share of votes for that scale


def align_as_paper(
    captured: Float[np.ndarray, "h w"],
    estimated: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    *,
    seed: int = 0,
) -> PaperDepth:
    """Algorithm 1: a metric scale by RANSAC, patches with depth and normals, an offset map by PatchMatch, the mapping.

    Args:
      captured: laid over the colours, metres along z, 0 = unknown.
      estimated: in the colours' pixels, in any unit, 0 = unknown.
      K: of the colours.
    """
    scale, agreement = find_scale(captured, estimated, seed=seed)  # 1
    scaled = scale * estimated
    offsets, cost = propagate_offsets(  # 2 to 8
        scaled.astype(np.float32),
        find_normals(scaled, K).astype(np.float32),
        captured.astype(np.float32),
        find_normals(captured, K).astype(np.float32),
        jax.random.key(seed),
        reach=REACH * captured.shape[1],
        unit=_UNIT,
    )
    offsets, cost = np.asarray(offsets), np.asarray(cost, np.float64)
    rows, columns = np.indices(captured.shape)
    height, width = captured.shape
    row = np.clip(rows + offsets[..., 1], 0, height - 1)
    column = np.clip(columns + offsets[..., 0], 0, width - 1)
    found = (estimated > 0) & (cost < _LEAST)
    return PaperDepth(np.where(found, captured[row, column], 0), offsets, cost, scale, agreement)  # 9


def find_scale(
    captured: Float[np.ndarray, "h w"], estimated: Float[np.ndarray, "h w"], *, seed: int = 0, tries: int = 200
) -> tuple[float, float]:
    """Captured metres per unit of the estimated depth, by RANSAC over ratios, and the share of them that agree."""
    both = (captured > 0) & (estimated > 0)
    if not both.any():
        return 1.0, 0.0
    ratios = (captured[both] / estimated[both]).astype(np.float64)
    drawn = np.random.default_rng(seed).choice(ratios, min(tries, len(ratios)), replace=False)
    ordered = np.sort(ratios)
    inside = np.searchsorted(ordered, drawn * (1 + _AGREE)) - np.searchsorted(ordered, drawn * (1 - _AGREE))
    best = drawn[inside.argmax()]
    agree = np.abs(ratios / best - 1) < _AGREE
    return float(np.median(ratios[agree])), float(agree.mean())


def lay_over(
    raw: Float[np.ndarray, "hd wd"],
    depth_camera: Float[np.ndarray, "3 3"],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
) -> Float[np.ndarray, "h w"]:
    """Raw depth at the rays of another camera in the same place: nothing is known of where they stand."""
    width, height = size
    rows, columns = np.mgrid[:height, :width]
    rays = unproject(K, np.stack([columns, rows], -1).reshape(-1, 2).astype(float), np.ones(width * height))
    pixels = rays[:, :2] * depth_camera[[0, 1], [0, 1]] + depth_camera[:2, 2]
    column, row = np.round(pixels).astype(int).T
    inside = (column >= 0) & (column < raw.shape[1]) & (row >= 0) & (row < raw.shape[0])
    found = raw[np.clip(row, 0, raw.shape[0] - 1), np.clip(column, 0, raw.shape[1] - 1)]
    return np.where(inside, found, 0).reshape(height, width)


def find_normals(depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "h w 3"]:
    """Normals towards the camera of a depth image that is averaged a little; zero where it is unknown."""
    known = depth > 0
    share = ndimage.gaussian_filter(known.astype(float), 1.5)
    mean = ndimage.gaussian_filter(np.where(known, depth, 0).astype(float), 1.5) / np.maximum(share, 1e-6)
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    points = unproject(K, np.stack([columns, rows], -1).reshape(-1, 2).astype(float), mean.reshape(-1))
    points = points.reshape(height, width, 3)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return np.where(known[..., None], normals, 0)
