"""The border of a mask between cells: where it runs, which way is out, and how it bends."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ipjax.cameras import mask_from_coverage


class Contour(eqx.Module):
    """Points on the mask's border where nothing hides the object, in cells of the grid."""

    points: Float[Array, "b 2"]  # (column, row)
    outward: Float[Array, "b 2"]  # unit normals
    bend: Float[Array, "b"]  # curvature, 1 / cells; positive where the object is convex
    valid: Bool[Array, "b"]


def trace_contour(
    cover: Float[Array, "h w"] | Bool[Array, "h w"],
    depth: Float[Array, "h w"],
    nearer: Float[Array, ""] | float,
    count: int,
) -> Contour:
    """About ``count`` points spread over the border between an object and what lies around it.

    Args:
      cover: the share of each cell that the object covers, or a mask. The border runs where it is one half, found
        between cells: on either axis, so that its points are off to neither side whatever its direction. Where it is
        curved, they are moved by as much as a share's mean over a cell, and the line between two, cut off a bend.
      depth: metres, 0 = unknown. What is by ``nearer`` before the object's depth beside it cuts the object: the border
        is its own there, and left out, as is the border of the image.
      count: where the whole border is shorter, the remaining points are not valid.
    """
    height, width = cover.shape
    blurred = cover.dtype != jnp.bool_
    cover = cover.astype(depth.dtype)
    mask = mask_from_coverage(cover)
    reach = 2  # cells that the normals are smoothed over, and that occluders are looked for in

    def window(image, radius, combine, beyond):
        """Combine each cell's square neighbourhood, rows first."""
        padded = jnp.pad(image, radius, constant_values=beyond)
        rows = functools.reduce(combine, [padded[i : i + height] for i in range(2 * radius + 1)])
        return functools.reduce(combine, [rows[:, i : i + width] for i in range(2 * radius + 1)])

    of_object = window(jnp.where(mask & (depth > 0), depth, jnp.inf), reach, jnp.minimum, jnp.inf)
    before = ~mask & (depth > 0) & jnp.isfinite(of_object) & (depth < of_object - nearer)
    cut = window(before, 1, jnp.logical_or, False)

    # Edge padding: at the image's border the object goes on.
    smooth = jnp.pad(cover, reach + 1, mode="edge")
    binomial = np.array([1, 4, 6, 4, 1], depth.dtype) / 16
    smooth = jnp.sum(jnp.stack([w * smooth[i : i + height + 2] for i, w in enumerate(binomial)]), axis=0)
    smooth = jnp.sum(jnp.stack([w * smooth[:, i : i + width + 2] for i, w in enumerate(binomial)]), axis=0)
    slope = jnp.stack([smooth[1:-1, :-2] - smooth[1:-1, 2:], smooth[:-2, 1:-1] - smooth[2:, 1:-1]], axis=-1)

    # The curvature of the lines of one share is the divergence of their normals.
    across, down = jnp.moveaxis(slope / jnp.sqrt(jnp.sum(slope**2, axis=-1, keepdims=True) + 1e-12), -1, 0)
    across, down = jnp.pad(across, ((0, 0), (1, 1)), mode="edge"), jnp.pad(down, ((1, 1), (0, 0)), mode="edge")
    bend = jnp.clip((across[:, 2:] - across[:, :-2] + down[2:] - down[:-2]) / 2, -0.5, 0.5)

    row, column = np.mgrid[:height, :width]
    cell = np.stack([column, row], axis=-1)

    def crossings(axis):
        """The border between each cell and the next: where, its normal and curvature, how far in it lies for each unit
        of curvature, and a rank that is 0 where there is none."""
        here, there = (np.s_[:, :-1], np.s_[:, 1:]) if axis == 0 else (np.s_[:-1], np.s_[1:])
        crosses = mask[here] != mask[there]
        change = cover[here] - cover[there]
        even = jnp.abs(change) < 0.01  # two cells that are covered by one half
        share = jnp.where(even, 0.5, jnp.clip((cover[here] - 0.5) / jnp.where(even, 1, change), 0, 1))
        place = cell[here].astype(depth.dtype) + share[..., None] * np.eye(2, dtype=depth.dtype)[axis]
        kept = crosses & ~jnp.where(mask[here], cut[here], cut[there])
        # A fixed shuffle: neighbours lie far apart.
        spread = ((row * 7919 + column * 104729 + axis * 2011) % 4093).astype(np.int32)[here]
        # A bend of curvature k lies k v / 2 farther in where it is blurred with variance v along it. A cell blurs with
        # 1 / 12, and the line between two cells with share (1 - share), as far as it runs along the border. Nothing is
        # blurred in a mask of yes and no.
        normal = slope[here] + slope[there]
        askew = 1 - normal[..., axis] ** 2 / (jnp.sum(normal**2, axis=-1) + 1e-12)
        loss = 1 / 24 + askew * share * (1 - share) / 2 if blurred else jnp.zeros_like(share)
        return place, normal, (bend[here] + bend[there]) / 2, loss, jnp.where(kept, spread + 1, 0)

    flat = lambda first, second: jnp.concatenate([x.reshape(-1, *x.shape[2:]) for x in (first, second)])
    *found, rank = (flat(*both) for both in zip(crossings(0), crossings(1), strict=True))
    rank, chosen = lax.top_k(rank, min(count, rank.shape[0]))
    place, normal, bend, loss = (x[chosen] for x in found)
    outward = normal / jnp.sqrt(jnp.sum(normal**2, axis=-1, keepdims=True) + 1e-12)
    return Contour(place + (bend * loss)[:, None] * outward, outward, bend, rank > 0)
