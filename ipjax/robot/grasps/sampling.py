"""Pairs of surface points that two pads can press against from opposite sides: antipodal pairs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from ipjax_kernels.antipodal import find_opposite, smooth_normals
from ipjax_kernels.positive import root
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.config import GraspConfig
from ipjax.robot.grasps.solid import Solid

_THIN = 5e-4  # m: a partner nearer than that is the same piece of surface


class Pairs(NamedTuple):
    """Where two pads may press, object frame, m."""

    middle: Float[Array, "p 3"]  # between the two points
    axis: Float[Array, "p 3"]  # unit, from the first point to the second
    valid: Bool[Array, " p"]  # False: the place is empty, there were fewer pairs


def sample_pairs(solid: Solid, opening: Float[Array, ""] | float, key: PRNGKeyArray, config: GraspConfig) -> Pairs:
    """Draw points and look along the inward normal of each for surface that faces the other way, within the opening.

    Of those on one line of sight both the nearest and the farthest count: through the wall of a bowl, and across it.

    Args:
      opening: the largest width between the pads, m.
    """
    count = solid.points.shape[0]
    anchors = min(config.anchors, count)
    first, second = jax.random.split(key)
    # Seen surface is drawn more often: Gumbel's maxima are a draw without replacement by weight.
    weight = jnp.log(1 - config.unseen * (1 - solid.seen))
    noise = jax.random.gumbel(first, (count,), solid.points.dtype)
    chosen = jax.lax.top_k(noise + weight, anchors)[1]
    start, near = solid.points[chosen], root(solid.area)
    number = lambda x: jnp.asarray(x, solid.points.dtype)
    # The mean normal around each point: a mesh that was made from a photo has rough ones.
    normals = smooth_normals(solid.points, solid.normals, start, solid.normals[chosen], 2 * near, number(0.7))
    axis = -normals
    reach = number(_THIN), number(opening - 2 * config.least_spare)
    least = jnp.cos(number(config.cone))
    nearest, farthest = find_opposite(solid.points, solid.normals, start, axis, reach, 1.2 * near, least)
    width = jnp.concatenate([nearest, farthest])
    # The second of two is new only where it is another piece of surface.
    valid = jnp.concatenate([jnp.isfinite(nearest), farthest > nearest + 3 * near])
    width = jnp.where(valid, width, 0)
    middle = jnp.concatenate([start, start]) + jnp.concatenate([axis, axis]) * width[:, None] / 2
    noise = jax.random.gumbel(second, (2 * anchors,), solid.points.dtype)
    kept = jax.lax.top_k(jnp.where(valid, noise, -jnp.inf), min(config.pairs, 2 * anchors))[1]
    return Pairs(middle[kept], jnp.concatenate([axis, axis])[kept], valid[kept])
