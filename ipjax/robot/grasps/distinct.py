"""Grasps that differ: of those that are nearly one, the best."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ipjax.metrics.poses import turn_angle


def pick_distinct(
    middle: Float[Array, "g 3"],
    rotation: Float[Array, "g 3 3"],
    score: Float[Array, " g"],
    count: int,
    apart: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
) -> tuple[Int[Array, " k"], Float[Array, " k"]]:
    """The best, then the best of those that are not near it, and so on (greedy suppression of what is not maximal).

    A hand turned by half a turn about its approach closes on the same places: it is the same grasp.

    Args:
      middle: between the pads, m.
      rotation: of the closing frame.
      score: 0 or less = absent.
      apart: m and rad; grasps are near where both their places and their directions are.

    Returns:
      Indices, best first, and the score of each; -1 where there was none left.
    """

    def pick(left, _):
        best = jnp.argmax(left)
        far = jnp.sum((middle - middle[best]) ** 2, axis=-1) > apart[0] ** 2
        # The traces of both rotations: as it is, and turned about w, which flips the sign of u and v.
        dots = jnp.sum(rotation * rotation[best], axis=-2)
        flat = dots[:, 0] + dots[:, 1]
        angle = turn_angle(dots[:, 2] + jnp.abs(flat))
        near = ~(far | (angle > apart[1]))
        taken = left[best]
        left = jnp.where(near, -1, left).at[best].set(-1)
        return left, (best, jnp.where(taken > 0, taken, -1))

    _, (chosen, taken) = jax.lax.scan(pick, score, None, length=min(count, score.shape[0]))
    return chosen, taken
