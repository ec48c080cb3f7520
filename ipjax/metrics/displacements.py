"""How far points move from one pose to another, in space and in the image: the basis of all errors of poses."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ipjax.records import Camera
from ipjax.transforms import A, Similarity


def namespace(*values: Any) -> Any:
    """NumPy where all of these are its arrays, else JAX's."""
    return np if all(isinstance(x, np.ndarray | np.generic) for x in values) else jnp


def displacements(points: Float[A, "n 3"], first: Similarity[A], second: Similarity[A]) -> Float[A, "*b n 3"]:
    """``second @ x − first @ x``; leading axes of the poses broadcast.

    The difference of the two maps is applied once, so that coordinates a metre away do not cancel. It is no
    `Similarity`.
    """
    matrix = _matrix(second) - _matrix(first)
    return apply_matrix(matrix, points) + (second.translation - first.translation)[..., None, :]


def pixel_displacements(
    points: Float[A, "n 3"], camera: Camera | Float[np.ndarray, "3 3"], first: Similarity[A], second: Similarity[A]
) -> Float[A, "*b n 2"]:
    """How far the projections of points move, in pixels; the camera is a record in the graph, K on the host."""
    return _flat_project(camera, second @ points) - _flat_project(camera, first @ points)


def apply_matrix(matrix: Float[A, "*b 3 3"], points: Float[A, "*c n 3"]) -> Float[A, "*d n 3"]:
    """``matrix @ x`` for rows of points."""
    if namespace(matrix, points) is np:
        return points @ np.swapaxes(matrix, -1, -2)
    # Sums of products, not a matrix product: exact in float32 on every backend.
    x, y, z = (matrix[..., None, :, i] * points[..., :, i, None] for i in range(3))
    return x + y + z


def lengths(vectors: Float[A, "*b n"]) -> Float[A, "*b"]:
    """Euclidean lengths along the last axis; in JAX with a finite gradient at 0."""
    found: Any
    if namespace(vectors) is np:
        found = np.asarray(np.linalg.norm(vectors, axis=-1))
    else:
        found = square_root(jnp.sum(vectors**2, axis=-1))
    return found


def square_root(squares: Float[A, "*b"]) -> Float[A, "*b"]:
    """Roots of sums of squares; in JAX the derivative at 0 is 0. NaN stays NaN: an absent pose is no perfect one."""
    found: Any
    if namespace(squares) is np:
        found = np.asarray(np.sqrt(squares))
    else:
        zero = squares == 0
        found = jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, squares)))
    return found


def away_from_zero(depth: Any) -> Any:
    """Depths that can be divided by. Unlike ``cameras.project`` it keeps points behind the camera: BOP mirrors them."""
    xp = namespace(depth)
    tiny = xp.asarray(1e-9, depth.dtype)
    return xp.where(xp.abs(depth) < tiny, tiny, depth)


def _matrix(pose: Similarity[A]) -> Float[A, "*b 3 3"]:
    return pose.scale[..., None, None] * pose.rotation


def _flat_project(camera: Any, points: Any) -> Any:
    """Pixels up to the camera's centre, which differences do not need."""
    focal = camera.focal if isinstance(camera, Camera) else camera[[0, 1], [0, 1]]
    return focal * points[..., :2] / away_from_zero(points[..., 2:])
