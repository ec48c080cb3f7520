"""Large planes of a frame: tables, floors and walls, on which things stand and before which they are seen."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ipjax.detection.proposals.surfaces import Surfaces

_TRIALS = 300  # planes through three points
_JUDGES = 2500  # points that they are judged by
_ALIKE = 0.85  # cosine between the normal at a point and that of its plane


def find_planes(
    surfaces: Surfaces, most: int, tolerance: float, least_share: float, seed: int = 0
) -> list[Float[np.ndarray, "4"]]:
    """Planes by RANSAC, the largest first; each is sought among what the others left.

    Args:
      surfaces: the frame.
      most: how many are sought.
      tolerance: metres, at a depth of one metre, that a point of a plane may lie off it; grows with z^1.5.
      least_share: of the frame, below which a plane is no support but a face of a thing.
      seed: of the points that are drawn.

    Returns:
      For each (n, d) with n · x + d = 0 for its points, n of unit length and towards the camera: metres in front of the
      plane are n · x + d.
    """
    rng = np.random.default_rng(seed)
    points = surfaces.points.reshape(-1, 3).astype(np.float64)
    normals = surfaces.normals.reshape(-1, 3)
    allowed = tolerance * points[:, 2] ** 1.5
    free = surfaces.known.reshape(-1).copy()
    found = []
    for _ in range(most):
        left = np.flatnonzero(free)
        if left.size < max(least_share * free.size, 50):
            break
        plane = _find_plane(rng, points, normals, allowed, left)
        if plane is None:
            break
        for _ in range(3):  # fitted to what it holds
            inside = left[_lies_on(plane, points[left], normals[left], allowed[left])]
            if inside.size < 3:
                break
            plane = _fit(points[inside], allowed[inside])
        on = _lies_on(plane, points, normals, allowed) & surfaces.trusted.reshape(-1)
        if (on & free).sum() < least_share * free.size:
            break
        found.append(plane)
        free &= ~on
    return found


def mark_planes(surfaces: Surfaces, planes: list[Float[np.ndarray, "4"]], tolerance: float) -> Bool[np.ndarray, "h w"]:
    """The pixels that lie on any of the planes, at whatever resolution these were found."""
    points, normals = surfaces.points.reshape(-1, 3), surfaces.normals.reshape(-1, 3)
    allowed = tolerance * points[:, 2] ** 1.5
    marked = np.zeros(surfaces.shape, bool)
    for plane in planes:
        on = (_lies_on(plane, points, normals, allowed) & surfaces.trusted.reshape(-1)).reshape(surfaces.shape)
        # Normals beside an edge are those of both sides; what lies on the plane between others that do does, too.
        near = np.abs(points @ plane[:3] + plane[3]) < allowed
        closed = cv2.morphologyEx(on.view(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        marked |= closed.view(bool) & near.reshape(surfaces.shape)
    return marked


def _lies_on(plane, points, normals, allowed) -> np.ndarray:
    """A slice through things has points near it, too, but not with its normal."""
    return (np.abs(points @ plane[:3] + plane[3]) < allowed) & (np.abs(normals @ plane[:3]) > _ALIKE)


def _find_plane(rng, points, normals, allowed, left) -> np.ndarray | None:
    """The plane through three of the points that most of the others lie on."""
    three = points[rng.choice(left, (_TRIALS, 3))]
    across = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    length = np.linalg.norm(across, axis=-1)
    good = length > 1e-8
    if not good.any():
        return None
    across = across[good] / length[good, None]
    offset = -(across * three[good, 0]).sum(-1)
    judges = rng.choice(left, min(_JUDGES, left.size), replace=False)
    near = np.abs(points[judges] @ across.T + offset) < allowed[judges, None]
    near &= np.abs(normals[judges] @ across.T) > _ALIKE
    best = near.sum(0).argmax()
    return np.append(across[best], offset[best])


def _fit(points: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Total least squares, each point by what it is allowed to be off."""
    weight = 1 / allowed**2
    middle = (weight[:, None] * points).sum(0) / weight.sum()
    centred = points - middle
    _, vectors = np.linalg.eigh((centred * weight[:, None]).T @ centred)
    normal = vectors[:, 0]
    offset = -normal @ middle
    return np.append(normal, offset) * (1 if offset > 0 else -1)  # the camera is at the origin
