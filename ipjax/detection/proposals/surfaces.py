"""A frame made ready for cutting it up: colour, depth without holes, normals, and the steps between pixels."""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ipjax.cameras import resize, unproject

_REACH = 2  # pixels on each side of a border that are compared: edges in photos and depth are blurred over as many
_FAR = 12  # pixels; farther from the nearest measurement, depth says nothing


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """A frame at the resolution that it is cut up at."""

    lab: Float[np.ndarray, "h w 3"]  # CIE L*a*b*, L from 0 to 100
    depth: Float[np.ndarray, "h w"]  # metres, filled with the nearest; 1 everywhere where nothing is known
    known: Bool[np.ndarray, "h w"]  # where depth was measured
    trusted: Bool[np.ndarray, "h w"]  # where it was measured nearby
    points: Float[np.ndarray, "h w 3"]  # camera frame, metres, of the filled depth
    normals: Float[np.ndarray, "h w 3"]  # unit, towards the camera; smoothed
    camera: Float[np.ndarray, "3 3"]  # K of this size

    # Between a pixel and its right neighbour, and between it and its lower one.
    jump: tuple[Float[np.ndarray, "h w-1"], Float[np.ndarray, "h-1 w"]]  # of depth, as a share of it
    contrast: tuple[Float[np.ndarray, "h w-1"], Float[np.ndarray, "h-1 w"]]  # of colour, ΔE
    crease: tuple[Float[np.ndarray, "h w-1"], Float[np.ndarray, "h-1 w"]]  # 1 − cosine of normals where they meet

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.depth.shape
        return height, width


def make_surfaces(
    rgb: np.ndarray, depth: np.ndarray, camera: Float[np.ndarray, "3 3"], width: int, height: int
) -> Surfaces:
    """The frame at another size, uint8 colour and metres of depth (0 = unknown) as they come from `propose`."""
    before = (rgb.shape[1], rgb.shape[0])
    camera = resize(camera, before, (width, height))
    shrinks = width < before[0]
    rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    depth = _shrink_depth(depth, width, height)
    known = depth > 0
    filled, distance = _fill(depth)
    trusted = distance <= _FAR
    filled = cv2.medianBlur(filled, 5)
    y, x = np.indices(filled.shape, dtype=np.float32)
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    points = unproject(camera.astype(np.float32), pixels, filled.reshape(-1)).reshape(height, width, 3)
    normals = _find_normals(points)
    inverse = 1 / filled
    smooth = cv2.GaussianBlur(lab, (0, 0), 0.7)

    def between(axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        both = _both(trusted, axis)
        jump, crease = _jump(inverse, filled, axis), _crease(normals, points, axis)
        return jump * both, _contrast(smooth, axis), crease * both

    across, down = between(1), between(0)
    jump, contrast, crease = ((right, below) for right, below in zip(across, down, strict=True))
    return Surfaces(lab, filled, known, trusted, points, normals, camera, jump, contrast, crease)


def _shrink_depth(depth: np.ndarray, width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Depth at another size: of the pixels under each new one the nearest to the new one's centre that is known."""
    rows = ((np.arange(height) + 0.5) * depth.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * depth.shape[1] / width).astype(int)
    picked = depth[rows[:, None], columns].astype(np.float32)
    for dy, dx in ((0, -1), (-1, 0), (-1, -1)) if width < depth.shape[1] else ():
        other = depth[np.maximum(rows + dy, 0)[:, None], np.maximum(columns + dx, 0)]
        picked = np.where(picked > 0, picked, other)
    return np.ascontiguousarray(picked, np.float32)


def _fill(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth with the nearest measurement where there is none, and how many pixels away that is."""
    if not (depth > 0).any():
        return np.ones_like(depth), np.full(depth.shape, np.inf)
    places = ndimage.distance_transform_edt(depth <= 0, return_distances=False, return_indices=True)
    index = np.asarray(places)
    distance = np.hypot(*(index - np.indices(depth.shape)))
    return np.ascontiguousarray(depth[tuple(index)]), distance


def _find_normals(points: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Unit normals towards the camera, of points smoothed over a few pixels."""
    smooth = cv2.GaussianBlur(points, (0, 0), 1.2)
    across, down = np.gradient(smooth, axis=1), np.gradient(smooth, axis=0)
    normals = np.cross(across, down)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    normals = cv2.GaussianBlur(normals.astype(np.float32), (0, 0), 1.0)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    away = (normals * points).sum(-1, keepdims=True) > 0
    return np.where(away, -normals, normals).astype(np.float32)


def _take(image: np.ndarray, offset: int, axis: int) -> np.ndarray:
    """For each border between pixels p and p + 1, the value at p + offset; the image's rim is repeated."""
    size = image.shape[axis]
    return np.take(image, np.clip(np.arange(size - 1) + offset, 0, size - 1), axis=axis)


def _jump(inverse: np.ndarray, depth: np.ndarray, axis: int) -> np.ndarray:
    """The step in depth across each border beyond what the slope beside it explains, as a share of the depth.

    1 / z is linear along a plane's image, so a table seen at a grazing angle has no step.
    """
    before, after = _take(inverse, 1 - _REACH, axis), _take(inverse, _REACH, axis)
    slope_before = before - _take(inverse, -1 - _REACH, axis)
    slope_after = _take(inverse, _REACH + 2, axis) - after
    slope = np.where(np.abs(slope_before) < np.abs(slope_after), slope_before, slope_after) * ((2 * _REACH - 1) / 2)
    return np.abs(after - before - slope) * np.minimum(_take(depth, 0, axis), _take(depth, 1, axis))


def _contrast(lab: np.ndarray, axis: int) -> np.ndarray:
    return np.linalg.norm(_take(lab, _REACH, axis) - _take(lab, 1 - _REACH, axis), axis=-1)


def _crease(normals: np.ndarray, points: np.ndarray, axis: int) -> np.ndarray:
    """1 − cosine of the normals on both sides, where they lean towards one another: a thing meets what it stands on.

    Convex edges belong to one thing as often as not (Stein et al. 2014, locally convex patches), and count a fifth.
    """
    first, second = _take(normals, -_REACH, axis), _take(normals, _REACH + 1, axis)
    between = _take(points, _REACH + 1, axis) - _take(points, -_REACH, axis)
    concave = ((second - first) * between).sum(-1) < 0
    return (1 - (first * second).sum(-1)) * np.where(concave, np.float32(1), np.float32(0.2))


def _both(flags: np.ndarray, axis: int) -> np.ndarray:
    return _take(flags, 0, axis) & _take(flags, 1, axis)
