"""Distances from surfaces that depth images show, summed at points of space (a truncated signed distance field).

Curless and Levoy, A Volumetric Method for Building Complex Models from Range Images, SIGGRAPH 1996.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Sums(NamedTuple):
    """What frames said of every point, weighted and summed."""

    distance: Float[Array, " n"]  # weight × signed distance, positive in front of the surface; units of depth
    weight: Float[Array, " n"]
    colour: Float[Array, "n 3"]  # weight × colour, where the point is near the surface
    colour_weight: Float[Array, " n"]


@jax.jit
def add_frame(
    sums: Sums,
    points: Float[Array, "n 3"],
    depth: Float[Array, "h w"],
    weight: Float[Array, "h w"],
    lean: Float[Array, "h w"],
    rgb: Float[Array, "h w 3"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    reach: Float[Array, ""],
) -> Sums:
    """Add what one frame says.

    A point that projects to a pixel of known depth is ``lean × (depth − z)`` in front of the surface there: exact for
    a plane. More than ``reach`` behind the surface nothing is known; farther than ``reach`` in front is ``reach``.

    Args:
      sums: of the frames before.
      points: in world.
      depth: along z; a point takes the blend of the four pixels about it where all four count, else the nearest.
      weight: of the pixels; 0 = absent.
      lean: cosine between the surface's normal and the pixel's ray, times the ray's length at depth 1.
      rgb: of the pixels; a point takes the nearest one's.
      focal, centre: of the camera.
      rotation, translation: ``camera_from_world``.
      reach: the truncation.
    """
    height, width = depth.shape
    # Sums of products, not a matrix product, which a GPU may round.
    moved = jnp.sum(rotation[None] * points[:, None, :], axis=-1) + translation
    ahead = moved[:, 2] > 1e-3
    z = jnp.where(ahead, moved[:, 2], 1)
    x, y = (moved[:, axis] / z * focal[axis] + centre[axis] for axis in (0, 1))
    inside = ahead & (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
    x, y = jnp.where(inside, x, 0), jnp.where(inside, y, 0)
    column, row = (jnp.clip(jnp.round(v).astype(jnp.int32), 0, size - 1) for v, size in ((x, width), (y, height)))
    left, top = (jnp.clip(jnp.floor(v).astype(jnp.int32), 0, size - 2) for v, size in ((x, width), (y, height)))
    right, down = (jnp.clip(v - first.astype(v.dtype), 0, 1) for v, first in ((x, left), (y, top)))
    flat = lambda image: image.reshape(height * width, *image.shape[2:])
    here = row * width + column
    corners = [(top + b) * width + left + a for b in (0, 1) for a in (0, 1)]
    shares = [(down if b else 1 - down) * (right if a else 1 - right) for b in (0, 1) for a in (0, 1)]
    depths, weights = flat(depth), flat(weight)
    all_four = jnp.min(jnp.stack([weights[c] for c in corners]), axis=0) > 0
    blended = sum(s * depths[c] for s, c in zip(shares, corners, strict=True))
    surface = jnp.where(all_four, blended, depths[here])
    signed = flat(lean)[here] * (surface - z)
    used = jnp.where(inside & (signed > -reach), weights[here], 0)
    near = jnp.where(jnp.abs(signed) < reach, used, 0)
    return Sums(
        sums.distance + used * jnp.minimum(signed, reach),
        sums.weight + used,
        sums.colour + near[:, None] * flat(rgb)[here],
        sums.colour_weight + near,
    )
