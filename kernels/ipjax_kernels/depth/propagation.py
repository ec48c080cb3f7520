"""PatchMatch between two depth images of different cameras: for every patch of one, where the other has the same.

C. Barnes et al., "PatchMatch", 2009; patches are compared by depth and by the angle between normals, as in the depth
alignment of RobotP (H. Yuan et al., 2021, Algorithm 1). Propagation is by checkerboard: pixels of one colour take
offsets of the other colour's, all at once (S. Galliani et al., "Massively parallel multiview stereopsis", 2015).
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

# Where offsets are taken from: an odd way off, so that it is the other colour of the checkerboard.
_FROM = ((-1, 0), (1, 0), (0, -1), (0, 1), (-5, 0), (5, 0), (0, -5), (0, 5))
_PATCH = tuple((down, right) for down in (-2, 0, 2) for right in (-2, 0, 2))
_TRIES = 2  # random offsets that a pixel tries in each iteration


@partial(jax.jit, static_argnames="iterations")
def propagate_offsets(
    estimated: Float[Array, "h w"],
    estimated_normals: Float[Array, "h w 3"],
    captured: Float[Array, "h w"],
    captured_normals: Float[Array, "h w 3"],
    key: PRNGKeyArray,
    *,
    reach: float | Float[Array, ""],
    unit: float | Float[Array, ""],
    angle: float | Float[Array, ""] = 0.5,
    iterations: int = 8,
) -> tuple[Int[Array, "h w 2"], Float[Array, "h w"]]:
    """The offset (x, y) from each pixel of the estimated depth to the pixel of the captured one that has its patch.

    A patch is 3 × 3 pixels, two apart. Its cost is the mean, over its pixels whose estimated depth is known, of half
    the depth difference in ``unit`` and half the normals' 1 − cosine in ``angle``, each at most 1; 1 where the captured
    one is unknown. Pixels without any estimated depth keep offset 0 at cost 1.

    Args:
      estimated, captured: along z, 0 = unknown.
      reach: pixels; the first offsets and the first random steps are drawn from ± so many.
    """
    height, width = estimated.shape
    rows, columns = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    target = jnp.concatenate([captured[..., None], captured_normals], axis=-1).reshape(-1, 4)
    source = jnp.concatenate([estimated[..., None], estimated_normals], axis=-1)
    patches = [_shift(source, down, right) for down, right in _PATCH]
    known = [patch[..., 0] > 0 for patch in patches]
    count = sum(each.astype(jnp.float32) for each in known)

    def cost_of(offset):
        total = jnp.zeros((height, width))
        for (down, right), patch, there in zip(_PATCH, patches, known, strict=True):
            column, row = columns + right + offset[..., 0], rows + down + offset[..., 1]
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            found = target[jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)]
            seen = inside & (found[..., 0] > 0)
            apart = jnp.minimum(jnp.abs(found[..., 0] - patch[..., 0]) / unit, 1)
            turned = jnp.minimum((1 - jnp.sum(found[..., 1:] * patch[..., 1:], axis=-1)) / angle, 1)
            total += jnp.where(there, jnp.where(seen, (apart + turned) / 2, 1), 0)
        return jnp.where(count > 0, total / jnp.maximum(count, 1), 1)

    def try_out(state, offset, mine):
        best, cost = state
        new = cost_of(offset)
        better = mine & (new < cost)
        return jnp.where(better[..., None], offset, best), jnp.where(better, new, cost)

    def iterate(index, state):
        mine = ((rows + columns + index) % 2 == 0) & (count > 0)
        moves = jnp.asarray(_FROM)
        state = lax.fori_loop(0, len(_FROM), lambda k, state: try_out(state, _roll(state[0], moves[k]), mine), state)
        radius = jnp.maximum(reach * 0.6**index, 1.0)

        def wander(k, state):
            step = jax.random.uniform(jax.random.fold_in(key, index * _TRIES + k), (height, width, 2), minval=-1)
            return try_out(state, state[0] + jnp.round(radius * step).astype(jnp.int32), mine)

        return lax.fori_loop(0, _TRIES, wander, state)

    first = jnp.round(reach * jax.random.uniform(key, (height, width, 2), minval=-1)).astype(jnp.int32)
    nothing = jnp.zeros((height, width, 2), jnp.int32)
    state = try_out((nothing, cost_of(nothing)), first, count > 0)
    return lax.fori_loop(0, iterations, iterate, state)


def _shift(image, down, right):
    """The pixel so far down and right, at each pixel; zero beyond the border."""
    padded = jnp.pad(image, ((2, 2), (2, 2), (0, 0)))
    return padded[2 + down : 2 + down + image.shape[0], 2 + right : 2 + right + image.shape[1]]


def _roll(offset, move):
    """What a neighbour has; beyond the border, what the border has."""
    height, width = offset.shape[:2]
    rows = jnp.clip(jnp.arange(height) + move[0], 0, height - 1)
    columns = jnp.clip(jnp.arange(width) + move[1], 0, width - 1)
    return offset[rows][:, columns]
