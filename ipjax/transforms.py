"""Similarities and rigid motions: mapping points, composing, inverting, tangents and matrices. Nowhere else.

One code for the graph and for the host. Where all arrays are NumPy's, the work is done by NumPy, in their precision:
``pose.to_numpy()`` gives doubles, in which the host composes, and ``pose.to_jax()`` brings the result back. Everything
else is JAX: it can be jitted, vmapped and differentiated, at the identity too. Leading axes are batches, and broadcast.

The tangent is a vector of 7 numbers, or of 6 for a motion that keeps the size: a rotation vector in radians, a
translation, and the logarithm of the scale. It is the tangent of the three parts, SO(3) × R³ × R₊, and not the matrix
exponential of Sim(3): the translation is not bent along the rotation. :meth:`Similarity.exp` steps away from the
identity, :func:`retract` from any pose, and the second is the first in the frame whose axes are the camera's, whose
origin is the object's centre, and whose unit is the object's diameter::

    camera_from_centre = Similarity(identity, pose.translation, pose.scale)
    retract(pose, step) = camera_from_centre @ Similarity.exp(step) @ camera_from_centre.inverse() @ pose

So a turn of the object leaves its centre where it is, and a step in translation is in diameters.
"""

from collections.abc import Sequence
from typing import Any, Generic, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from typing_extensions import TypeVar

A = TypeVar("A", jax.Array, np.ndarray, default=jax.Array)  # whose arrays: JAX's in the graph, NumPy's on the host


class Similarity(eqx.Module, Generic[A]):
    """``x_a = scale * rotation @ x_b + translation``; name it ``a_from_b``."""

    rotation: Float[A, "*b 3 3"]
    translation: Float[A, "*b 3"]  # units of a
    scale: Float[A, "*b"]  # units of a per unit of b

    __array_ufunc__ = None  # so that NumPy does not take a pose for an element of an array

    def __init__(
        self, rotation: Float[A, "*b 3 3"], translation: Float[A, "*b 3"], scale: Float[A, "*b"] | float | int
    ):
        """A pose of its parts; a scale that is Python's number becomes an array like the translation's."""
        if isinstance(scale, int | float) and isinstance(translation, np.ndarray | jax.Array):
            scale = _namespace(translation).asarray(scale, translation.dtype)
        given: Any = scale
        self.rotation, self.translation, self.scale = rotation, translation, given

    @overload
    def __matmul__(self, other: "Similarity[A]") -> "Similarity[A]": ...

    @overload
    def __matmul__(self, other: Float[A, "*b n 3"]) -> Float[A, "*c n 3"]: ...

    def __matmul__(self, other: Any) -> Any:
        """``a_from_b @ points_b`` maps points (rows) to frame a; ``a_from_b @ b_from_c`` is ``a_from_c``.

        Raises:
          ValueError: the points are not ``*b n 3``.
          TypeError: they are no array.
        """
        if isinstance(other, Similarity):
            return Similarity(
                _product(self.rotation, other.rotation),
                (self @ other.translation[..., None, :])[..., 0, :],
                _array(self.scale * other.scale),
            )
        if not hasattr(other, "ndim"):
            return NotImplemented  # a list, or no points at all: Python says which two it cannot combine
        if other.ndim < 2 or other.shape[-1] != 3:
            raise ValueError(f"points are rows of 3, in an array of two axes or more, not {other.shape}")
        moved = _map(self.rotation, other)
        return self.scale[..., None, None] * moved + self.translation[..., None, :]

    def inverse(self) -> "Similarity[A]":
        """``b_from_a`` of ``a_from_b``."""
        turned_back = _swap(self.rotation)
        moved = _map(turned_back, self.translation[..., None, :])[..., 0, :]
        return Similarity(turned_back, -moved / self.scale[..., None], _array(1 / self.scale))

    @staticmethod
    def identity(shape: tuple[int, ...] = (), dtype: Any = jnp.float32) -> "Similarity[jax.Array]":
        """The map that changes nothing, with leading axes ``shape``."""
        rotation = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*shape, 3, 3))
        return Similarity(rotation, jnp.zeros((*shape, 3), dtype), jnp.ones(shape, dtype))

    @staticmethod
    def exp(step: Float[A, "*b n"]) -> "Similarity[A]":
        """The similarity of a tangent: a rotation vector (rad), a translation and, if ``n`` is 7, a log scale.

        Raises:
          ValueError: ``n`` is neither 6 nor 7.
        """
        _check_step(step)
        xp = _namespace(step)
        scale = xp.exp(step[..., 6]) if step.shape[-1] == 7 else xp.ones_like(step[..., 0])
        return Similarity(rotation_from_vector(step[..., :3]), step[..., 3:6], _array(scale))

    def log(self) -> Float[A, "*b 7"]:
        """The tangent of which this is the :meth:`exp`; its rotation is at most π long."""
        xp = _namespace(self.rotation, self.translation, self.scale)
        vector = vector_from_rotation(self.rotation)
        return xp.concatenate([vector, self.translation, xp.log(self.scale)[..., None]], axis=-1)

    def to_matrix(self) -> Float[A, "*b 4 4"]:
        """``[scale * rotation, translation; 0 0 0 1]``: ``(x_a, 1) = matrix @ (x_b, 1)``."""
        xp = _namespace(self.rotation, self.translation, self.scale)
        upper = xp.concatenate([self.scale[..., None, None] * self.rotation, self.translation[..., None]], axis=-1)
        last = xp.broadcast_to(xp.asarray([0, 0, 0, 1], upper.dtype), (*upper.shape[:-2], 1, 4))
        return xp.concatenate([upper, last], axis=-2)

    @staticmethod
    def from_matrix(matrix: Float[A, "*b 4 4"]) -> "Similarity[A]":
        """The inverse of :meth:`to_matrix`. On the host a matrix of no similarity is refused; the graph does not look.

        Raises:
          ValueError: the shape is not ``*b 4 4``; or, of a NumPy array, it is not finite, sheared, stretched unevenly,
            mirrored (to a thousandth), or its last row is not 0 0 0 1.
        """
        if matrix.shape[-2:] != (4, 4):
            raise ValueError(f"a similarity is a 4 x 4 matrix, not one of shape {matrix.shape}")
        xp = _namespace(matrix)
        linear = matrix[..., :3, :3]
        scale = _array(xp.sqrt(xp.sum(linear * linear, axis=(-2, -1)) / 3))
        if isinstance(matrix, np.ndarray):
            _check_matrix(matrix, scale)
        return Similarity(linear / scale[..., None, None], matrix[..., :3, 3], scale)

    def take(self, index: Any) -> "Similarity[A]":
        """Those of many poses that ``index`` picks along the leading axis: a number, a slice, numbers, or a mask."""
        return Similarity(*(_array(x[index]) for x in (self.rotation, self.translation, self.scale)))

    @staticmethod
    def stack(poses: Sequence["Similarity[A]"]) -> "Similarity[A]":
        """Many poses as one, along a new leading axis.

        Raises:
          ValueError: there is none, or their batches differ.
        """
        if not poses:
            raise ValueError("there is no pose to stack")
        xp = _namespace(*(x for pose in poses for x in (pose.rotation, pose.translation, pose.scale)))
        parts = zip(*((pose.rotation, pose.translation, pose.scale) for pose in poses), strict=True)
        return Similarity(*(xp.stack([xp.asarray(x) for x in part]) for part in parts))

    def orthonormal(self: "Similarity[np.ndarray]") -> "Similarity[np.ndarray]":
        """The same with the nearest rotations, exact to the last digit: long products and short decimals drift."""
        left, _, right = np.linalg.svd(self.rotation)
        return Similarity(left @ right, self.translation, self.scale)

    def to_numpy(self) -> "Similarity[np.ndarray]":
        """The same in NumPy's doubles, for the host."""
        return Similarity(*(np.asarray(x, np.float64) for x in (self.rotation, self.translation, self.scale)))

    def to_jax(self, dtype: Any = jnp.float32) -> "Similarity[jax.Array]":
        """The same in JAX's arrays, for the graph."""
        return Similarity(*(jnp.asarray(x, dtype) for x in (self.rotation, self.translation, self.scale)))


def retract(start: Similarity[A], step: Float[A, "*b n"]) -> Similarity[A]:
    """Move by a tangent vector (rotation in rad, translation in diameters, log scale) about the object's centre.

    Args:
      start: ``camera_from_object``; the object's centre is its origin, and the scale its diameter.
      step: 7 numbers, or 6 for a motion that keeps the scale.

    Raises:
      ValueError: ``step`` has neither 6 nor 7 numbers.
    """
    _check_step(step)
    xp = _namespace(step)
    rotation = _product(rotation_from_vector(step[..., :3]), start.rotation)
    translation = start.translation + start.scale[..., None] * step[..., 3:6]
    scale = start.scale * xp.exp(step[..., 6]) if step.shape[-1] == 7 else start.scale
    return Similarity(rotation, translation, _array(scale))


def difference(start: Similarity[A], end: Similarity[A]) -> Float[A, "*b 7"]:
    """The step that :func:`retract` takes from ``start`` to ``end``: rad, diameters of ``start``, and a logarithm."""
    xp = _namespace(start.rotation, end.rotation)
    vector = vector_from_rotation(_product(end.rotation, _swap(start.rotation)))
    shift = (end.translation - start.translation) / start.scale[..., None]
    return xp.concatenate([vector, shift, xp.log(end.scale / start.scale)[..., None]], axis=-1)


def rotation_from_vector(vector: Float[A, "*b 3"]) -> Float[A, "*b 3 3"]:
    """Rodrigues' formula, with a series near zero so that it and its derivative stay finite."""
    xp = _namespace(vector)
    squared = xp.sum(vector * vector, axis=-1)
    small = squared < 1e-6
    safe = xp.where(small, xp.ones_like(squared), squared)
    angle = xp.sqrt(safe)
    sine = xp.where(small, 1 - squared / 6, xp.sin(angle) / angle)
    cosine = xp.where(small, 0.5 - squared / 24, (1 - xp.cos(angle)) / safe)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = xp.zeros_like(x)
    rows = [xp.stack(row, axis=-1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])]
    cross = xp.stack(rows, axis=-2)
    outer = vector[..., :, None] * vector[..., None, :]
    sine, cosine, squared = (value[..., None, None] for value in (sine, cosine, squared))
    return xp.eye(3, dtype=vector.dtype) * (1 - cosine * squared) + sine * cross + cosine * outer


def rotation_from_quaternion(quaternion: Float[A, "*b 4"]) -> Float[A, "*b 3 3"]:
    """The rotation of a quaternion x, y, z, w of any length; of four zeros the one that turns nothing."""
    xp = _namespace(quaternion)
    largest = xp.max(xp.abs(quaternion), axis=-1, keepdims=True)
    quaternion = quaternion / xp.where(largest > 0, largest, xp.ones_like(largest))  # no square overflows
    squared = xp.sum(quaternion * quaternion, axis=-1)
    twice = 2 / xp.where(squared > 0, squared, xp.ones_like(squared))
    x, y, z, w = (quaternion[..., i] for i in range(4))
    rows = [
        [1 - twice * (y * y + z * z), twice * (x * y - w * z), twice * (x * z + w * y)],
        [twice * (x * y + w * z), 1 - twice * (x * x + z * z), twice * (y * z - w * x)],
        [twice * (x * z - w * y), twice * (y * z + w * x), 1 - twice * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: Float[A, "*b 3 3"]) -> Float[A, "*b 4"]:
    """The unit quaternion x, y, z, w of a rotation, with w ≥ 0; its derivative is finite. At π either sign may come.

    The rotation gives all products of two parts: those with the largest part are a multiple of the quaternion that is
    never small, so that no angle is special (S. W. Shepperd, Quaternion from Rotation Matrix, Journal of Guidance and
    Control 1(3), 1978).
    """
    xp = _namespace(rotation)
    (a, b, c), (d, e, f), (g, h, i) = ([rotation[..., row, column] for column in range(3)] for row in range(3))
    rows = [
        [1 + a - e - i, b + d, c + g, h - f],
        [b + d, 1 - a + e - i, f + h, c - g],
        [c + g, f + h, 1 - a - e + i, d - b],
        [h - f, c - g, d - b, 1 + a + e + i],
    ]  # 4 q qᵀ, q = (x, y, z, w)
    products = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = xp.argmax(xp.stack([rows[k][k] for k in range(4)], axis=-1), axis=-1)
    chosen = xp.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = chosen / xp.sqrt(xp.sum(chosen * chosen, axis=-1, keepdims=True))
    return xp.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def vector_from_rotation(rotation: Float[A, "*b 3 3"]) -> Float[A, "*b 3"]:
    """The rotation vector, of length 0 to π; it and its derivative are finite at zero. At π either sign may come."""
    xp = _namespace(rotation)
    quaternion = quaternion_from_rotation(rotation)
    vector, w = quaternion[..., :3], quaternion[..., 3:]
    squared = xp.sum(vector * vector, axis=-1, keepdims=True)
    small = squared < 1e-6
    sine = xp.sqrt(xp.where(small, xp.ones_like(squared), squared))  # of half the angle
    ratio = xp.where(small, squared / xp.where(small, w * w, xp.ones_like(w)), xp.zeros_like(w))
    series = (1 - ratio / 3 + ratio * ratio / 5) / xp.where(small, w, xp.ones_like(w))
    return 2 * vector * xp.where(small, series, xp.arctan2(sine, w) / sine)


def _namespace(*values: Any) -> Any:
    """NumPy where all of these are its arrays, else JAX's."""
    return np if all(isinstance(x, np.ndarray | np.generic) for x in values) else jnp


def _array(value: Any) -> Any:
    """An array: NumPy makes scalars of arrays without axes."""
    return np.asarray(value) if isinstance(value, np.generic) else value


def _swap(matrix: Any) -> Any:
    return _namespace(matrix).swapaxes(matrix, -1, -2)


def _map(rotation: Any, points: Any) -> Any:
    """Rows of points, each turned by the rotation."""
    xp = _namespace(rotation, points)
    if xp is np:
        return points @ _swap(rotation)  # the sums below would hold nine products of every point
    # Sums of products, not a matrix product: exact in float32 on every backend, and faster for three columns.
    return xp.sum(rotation[..., None, :, :] * points[..., :, None, :], axis=-1)


def _product(left: Any, right: Any) -> Any:
    if _namespace(left, right) is np:
        return left @ right
    return jnp.matmul(left, right, precision="highest")  # without it a GPU may round what it multiplies to 11 bits


def _check_step(step: Any) -> None:
    if step.shape[-1] not in (6, 7):
        raise ValueError(f"a tangent has 7 numbers, or 6 without the scale, not {step.shape[-1]}")


def _check_matrix(matrix: np.ndarray, scale: Any) -> None:
    """Raise ValueError for matrices that are no similarities."""
    if not np.isfinite(matrix).all():
        raise ValueError("the matrix is not finite")
    if not (np.abs(matrix[..., 3, :] - [0, 0, 0, 1]) < 1e-6).all():
        raise ValueError("the last row of the matrix of a similarity is 0 0 0 1")
    if not (scale > 0).all():
        raise ValueError("the matrix maps everything to one point")
    rotation = matrix[..., :3, :3] / scale[..., None, None]
    if np.abs(rotation @ _swap(rotation) - np.eye(3)).max(initial=0) > 1e-3:
        raise ValueError("the matrix shears, or stretches one axis more than another")
    if (np.linalg.det(rotation) < 0).any():
        raise ValueError("the matrix mirrors")
