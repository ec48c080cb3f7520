"""What an open hand hits as it moves up to an object, and what its two fingers touch as they close.

All of it in the closing frame: u along the closing axis, v across the fingers, w the approach, from the hand's base. An
object is a cloud of surface points with outward normals.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class Hand(NamedTuple):
    """An open hand; one unit of length throughout."""

    opening: Float[Array, ""]  # between the pads
    thickness: Float[Array, ""]  # of each finger, behind its pad
    breadth: Float[Array, ""]  # of each finger, along v
    root: Float[Array, ""]  # w where the fingers begin
    pad: Float[Array, ""]  # w where the pads begin
    tip: Float[Array, ""]  # w where pads and fingers end
    low: Float[Array, "k 3"]  # lowest and highest corners of the boxes that the body fills
    high: Float[Array, "k 3"]


class Touch(NamedTuple):
    """What one hand meets; the first of two is the finger at the negative end of u."""

    hits: Float[Array, "*g"]  # points in the way of fingers or body, on the whole way
    low: Float[Array, "*g"]  # the lowest and highest u between the fingers; low > high where there is nothing
    high: Float[Array, "*g"]
    facing: Float[Array, "*g 2"]  # points under each pad that face it
    cosine: Float[Array, "*g 2"]  # of the angle between their normals and the pad, the mean; 0 where there are none
    seen: Float[Array, "*g 2"]  # mean of their `seen`
    contact: Float[Array, "*g 2 3"]  # where each pad touches, closing frame: (low or high, mean v, mean w)
    centre: Float[Array, "*g"]  # by how much the hand was moved along u


def close_hands(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    seen: Float[Array, " n"],
    linear: Float[Array, "g 3 3"],
    offset: Float[Array, "g 3"],
    hand: Hand,
    retreat: Float[Array, ""],
    depth: Float[Array, ""],
    facing: Float[Array, ""],
    *,
    centred: bool = False,
    batch: int = 16,
) -> Touch:
    """Close each of many hands on one object.

    The hand comes along w from ``retreat`` away, open: what its fingers and its body sweep counts in ``hits``. The
    fingers then close over their whole length; what they meet first are the lowest and the highest u between them. A
    pad is supported by the points that lie at most ``depth`` behind that and face it.

    Args:
      points, normals, seen: of the object.
      linear, offset: the closing frame from the object's, ``linear @ point + offset``; the linear part may be scaled.
      retreat: how far the hand has come, which its swept volume reaches back.
      depth: by how much a pad gives way.
      facing: least cosine between a pad and a surface that supports it.
      centred: first move each hand along u so that both fingers have the same way to go.
      batch: hands whose work is done at once; the answer does not depend on it.
    """
    columns, turned = points.T, normals.T

    def close(matrix, shift):
        u, v, w = (_row(matrix[i], columns) + shift[i] for i in range(3))
        length = jnp.sqrt(jnp.sum(matrix[0] * matrix[0]))
        along = _row(matrix[0] / length, turned)  # cosine of each normal to u
        within = (jnp.abs(v) < hand.breadth / 2) & (w < hand.tip)
        between = within & (w > hand.root)
        ends = lambda u: _ends(u, between & (jnp.abs(u) < hand.opening / 2))
        low, high = ends(u)
        centre = jnp.zeros_like(shift[0])
        if centred:
            centre = jnp.where(low <= high, (low + high) / 2, 0)
            u = u - centre
            low, high = ends(u)
        aside = jnp.abs(u)
        in_finger = (aside >= hand.opening / 2) & (aside < hand.opening / 2 + hand.thickness)
        hit = within & in_finger & (w > hand.root - retreat)
        for low_corner, high_corner in zip(hand.low, hand.high, strict=True):
            hit |= (
                (u > low_corner[0])
                & (u < high_corner[0])
                & (v > low_corner[1])
                & (v < high_corner[1])
                & (w > low_corner[2] - retreat)
                & (w < high_corner[2])
            )
        under = between & (w > hand.pad) & (aside < hand.opening / 2)
        weights = jnp.stack(
            [under & (u <= low + depth) & (along < -facing), under & (u >= high - depth) & (along > facing)]
        ).astype(u.dtype)
        sums = jnp.sum(weights[:, None] * jnp.stack([jnp.ones_like(u), jnp.abs(along), seen, v, w]), axis=-1)
        count = sums[:, 0]
        mean = sums[:, 1:] / jnp.maximum(count, 1)[:, None]
        middle = jnp.where(count > 0, mean[:, 3], (hand.pad + hand.tip) / 2)
        contact = jnp.stack([jnp.stack([low, high]), mean[:, 2], middle], axis=-1)
        return Touch(jnp.sum(hit.astype(u.dtype)), low, high, count, mean[:, 0], mean[:, 1], contact, centre)

    return lax.map(lambda one: close(*one), (linear, offset), batch_size=batch)


def _row(row, columns):
    # Sums of products, not a matrix product, which a GPU may round.
    return row[0] * columns[0] + row[1] * columns[1] + row[2] * columns[2]


def _ends(u, inside):
    return jnp.min(jnp.where(inside, u, jnp.inf)), jnp.max(jnp.where(inside, u, -jnp.inf))
