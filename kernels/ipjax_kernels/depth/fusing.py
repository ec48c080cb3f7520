"""Depth images of one view, from several sources, into one: by votes, then by weighted means of what agrees."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@partial(jax.jit, static_argnames=("fill", "overrule"))
def fuse_depth(
    stack: Float[Array, "n h w"],
    weight: Float[Array, "n"],
    *,
    gate: float = 0.012,
    floor: float = 0.004,
    fill: int = 2,
    overrule: int = 3,
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """A view's own depth, which is the first of the stack, fused with what others say of the same pixels.

    Two depths agree that differ by less than ``gate`` of themselves, or ``floor``. The view's own depth counts, with
    what agrees with it. Where it is unknown, the surface on which most others agree is taken, if at least ``fill`` do,
    the nearest of equals; and it gives way to one on which ``overrule`` agree while none agrees with it.

    Args:
      stack: along z, 0 = unknown; the unit is that of ``floor``.

    Returns:
      The depth, and its confidence: the weight of what agrees over that of all that is known, and one more.

    Time: n² passes over an image; temporary memory: a few stacks.
    """
    count = len(stack)
    present = stack > 0
    near = lambda centre: jnp.abs(stack - centre[None]) < jnp.maximum(gate * centre, floor)[None]
    own = stack[0]
    centre, most = jnp.zeros_like(own), jnp.zeros_like(own)
    for place in range(1, count):
        candidate = stack[place]
        votes = jnp.where(present[place], jnp.sum((near(candidate) & present)[1:], axis=0, dtype=own.dtype), 0)
        better = (votes > most) | ((votes == most) & (candidate < centre) & present[place])
        centre, most = jnp.where(better, candidate, centre), jnp.where(better, votes, most)
    alone = jnp.sum((near(own) & present)[1:], axis=0) == 0
    taken = jnp.where(present[0], alone & (most >= overrule), most >= fill)
    centre = jnp.where(taken, centre, own)
    each = jnp.where(near(centre) & present, weight[:, None, None], 0)
    total = jnp.sum(each, axis=0)
    depth = jnp.sum(each * stack, axis=0) / jnp.maximum(total, 1e-9)
    confidence = total / (jnp.sum(jnp.where(present, weight[:, None, None], 0), axis=0) + 1)
    known = centre > 0
    return jnp.where(known, depth, 0), jnp.where(known, confidence, 0)
