"""The pose of a camera from image points of known points: closed minimal fits, and a robust refinement (Gauss–Newton).

Image points are rays: (x / z, y / z) in the camera's axes, without a unit. All rotations map to the camera's axes.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ipjax_kernels.positive import root
from ipjax_kernels.rigid import descend


class Weak(NamedTuple):
    """Weak-perspective poses: ``ray = scale · (rotation @ point)[:2] + offset``; the batch axes last."""

    rotation: Float[Array, "3 3 *b"]
    offset: Float[Array, "2 *b"]
    scale: Float[Array, "*b"]  # one over the distance, 1 / the points' unit
    success: Bool[Array, "*b"]  # the three points determine it


def weak_perspective(points: Float[Array, "3 3 n"], rays: Float[Array, "3 2 n"]) -> Weak:
    """The two poses that put three points onto their rays, under weak perspective; mirrors of each other (Necker).

    Both leave the same image; which of them is the camera's, only other evidence tells.

    Args:
      points: corner, coordinate, set.
      rays: corner, coordinate, set.

    Returns:
      Poses with the axes (mirror, set). Sets whose points or rays coincide, or lie on a line, have no success; the
      numbers are finite.

    T. D. Alter, "3-D pose from 3 points using weak-perspective", 1994; the unknowns are the depths of the second and
    third corner relative to the first.
    """
    first, second = points[1] - points[0], points[2] - points[0]
    image_first, image_second = rays[1] - rays[0], rays[2] - rays[0]
    dot = lambda a, b: jnp.sum(a * b, axis=0)
    aa, bb, ab = dot(first, first), dot(second, second), dot(first, second)
    pp, qq, pq = dot(image_first, image_first), dot(image_second, image_second), dot(image_first, image_second)
    area, image_area = aa * bb - ab**2, pp * qq - pq**2
    determined = (area > 1e-4 * aa * bb) & (image_area > 1e-6 * pp * qq) & (pp > 0) & (qq > 0)
    # (k aa − pp) (k bb − qq) = (k ab − pq)² for k = scale²; the larger root leaves both depths real.
    safe = jnp.where(determined, area, 1)
    half = (aa * qq + bb * pp - 2 * ab * pq) / (2 * safe)
    squared = half + root(half**2 - image_area / safe)
    squared = jnp.where(determined, squared, 1)
    depth_first = root(squared * aa - pp)
    depth_second = root(squared * bb - qq) * jnp.where(squared * ab - pq < 0, -1, 1)
    scale = root(squared)
    rotations, offsets = [], []
    for side in (1, -1):
        moved_first = jnp.concatenate([image_first, side * depth_first[None]])
        moved_second = jnp.concatenate([image_second, side * depth_second[None]])
        rotation = _turn_between(_frame(first, second), _frame(moved_first, moved_second))
        rotations.append(rotation)
        offsets.append(rays[0] - scale * jnp.sum(rotation[:2] * points[0][None], axis=1))
    both = lambda x: jnp.broadcast_to(x, (2, *x.shape))
    return Weak(jnp.stack(rotations, axis=2), jnp.stack(offsets, axis=1), both(scale), both(determined))


def _frame(first, second):
    """Three orthonormal axes (axis, coordinate, set) of two vectors; of two on a line, some."""
    across = jnp.cross(first, second, axis=0)
    length = lambda x: root(jnp.sum(x * x, axis=0))
    unit = lambda x: x / jnp.where(length(x) > 1e-12, length(x), 1)
    ahead, up = unit(first), unit(across)
    return jnp.stack([ahead, up, jnp.cross(ahead, up, axis=0)])


def _turn_between(before, after):
    return jnp.sum(after[:, :, None] * before[:, None, :], axis=0)


class Resection(NamedTuple):
    """The pose of a camera, and how well points agree with it."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]  # in the points' unit
    loss: Float[Array, ""]  # weighted mean of the robust losses, in [0, 1]
    information: Float[Array, "6 6"]  # of (turn about the points' centre, shift), in the camera's axes


@partial(jax.jit, static_argnames="steps")
def refine_resection(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    points: Float[Array, "k 3"],
    rays: Float[Array, "k 2"],
    weight: Float[Array, "k"],
    width: Float[Array, ""] | float,
    *,
    steps: int = 10,
) -> Resection:
    """A camera's pose, moved until the points are seen along their rays: ``steps`` of damped Gauss–Newton.

    The loss of a pair is Geman–McClure's ρ = r² / (r² + width²) of its distance r between rays. A step that does not
    lower the sum is not taken, and the next one is damped more. Points behind the camera cost the most, 1.

    Args:
      rotation, translation: the start, camera from points.
      weight: of each pair; 0 = absent.
      width: rays' unit.
    """
    total = jnp.sum(weight)
    share = weight / jnp.where(total > 1e-12, total, 1)
    middle = jnp.sum(share[:, None] * points, axis=0)
    # Turned about their centre, so that turn and shift are as independent as they can be.
    points = points - middle
    translation = translation + jnp.sum(rotation * middle[None], axis=1)
    width = jnp.asarray(width, points.dtype)

    def evaluate(rotation, translation):
        turned = jnp.sum(rotation[None] * points[:, None, :], axis=-1)
        x, y, z = jnp.moveaxis(turned + translation, -1, 0)
        ahead = z > 1e-3 * jnp.maximum(translation[2], 1e-9)
        inverse = 1 / jnp.where(ahead, z, 1)
        offset = jnp.stack([x * inverse, y * inverse], axis=-1) - rays
        squared = jnp.sum(offset**2, axis=-1) / width**2
        loss = jnp.where(ahead, squared / (1 + squared), 1)
        # Iteratively reweighted: ρ'(r²) as the weight of each square.
        each = jnp.where(ahead, share / (1 + squared) ** 2, 0)
        zero = jnp.zeros_like(x)
        by_point = jnp.stack(
            [
                jnp.stack([inverse, zero, -x * inverse**2], axis=-1),
                jnp.stack([zero, inverse, -y * inverse**2], axis=-1),
            ],
            axis=1,
        )  # k 2 3
        by_turn = jnp.cross(turned[:, None, :], by_point)  # d(ω × p) = ω · (p × ·)
        slopes = jnp.concatenate([by_turn, by_point], axis=-1) / width
        hessian = jnp.einsum("kia,kib,k->ab", slopes, slopes, each, precision="highest")
        slope = jnp.einsum("kia,ki,k->a", slopes, offset / width, each, precision="highest")
        return jnp.sum(share * loss), hessian, slope

    rotation, translation, (loss, hessian, _) = descend(evaluate, rotation, translation, longest=0.5, steps=steps)
    translation = translation - jnp.sum(rotation * middle[None], axis=1)
    return Resection(rotation, translation, loss, hessian)
