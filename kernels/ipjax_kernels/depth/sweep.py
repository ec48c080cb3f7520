"""Plane sweep stereo: the depth at which neighbouring views look most like a reference view, window by window.

R. T. Collins, "A space-sweep approach to true multi-image matching", 1996; windows are compared by their zero-mean
normalised cross-correlation. With a base image of inverse depth the planes become copies of a surface, so that windows
lie along it instead of facing the camera.
"""

from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

_FLAT = 1e-5  # variance of grey values, of the full range squared, below which a window says nothing


class Sweep(NamedTuple):
    """What a sweep found for every pixel of the reference."""

    inverse: Float[Array, "h w"]  # 1 / z; 0 = nothing could be compared
    score: Float[Array, "h w"]  # the best correlation, in [−1, 1]
    runner_up: Float[Array, "h w"]  # the best correlation two planes or more away
    curvature: Float[Array, "h w"]  # how fast the correlation falls beside the best plane, per plane squared


@partial(jax.jit, static_argnames=("radius", "keep"))
def sweep(
    reference: Float[Array, "h w"],
    neighbours: Float[Array, "m h w"],
    turn: Float[Array, "m 3 3"],
    shift: Float[Array, "m 3"],
    base: Float[Array, "h w"],
    offsets: Float[Array, "p"],
    valid: Bool[Array, "m"],
    *,
    radius: int = 3,
    keep: int = 2,
) -> Sweep:
    """Sweep planes of inverse depth ``base + offset`` through a reference view.

    A pixel (x, y) of the reference at inverse depth q is seen in neighbour k at ``turn[k] @ (x, y, 1) + q · shift[k]``,
    divided by its third coordinate: ``turn = K R K⁻¹`` and ``shift = K t`` of ``neighbour_from_reference``.

    Args:
      base: the surface about which is swept, 1 / depth; zero everywhere for planes that face the camera.
      offsets: rising by equal steps, 1 / depth. Where ``base + offset`` is not positive nothing is compared.
      valid: which neighbours are there.
      radius: of the windows: 2 · radius + 1 pixels.
      keep: a plane's score is the mean of this many best neighbours', so that a surface may be hidden from the others;
        a neighbour that does not see it counts −1.

    The planes follow one another; temporary memory: two images a plane for the scores, a few images beside.
    """
    height, width = reference.shape
    rows, columns = jnp.meshgrid(
        jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32), indexing="ij"
    )
    pixels = jnp.stack([columns, rows, jnp.ones_like(rows)])  # 3 h w
    rays = jnp.einsum("kij,jhw->kihw", turn, pixels, precision="highest")
    corners = jax.vmap(_corners)(neighbours)
    count = (2 * radius + 1) ** 2
    mean = _box(reference, radius) / count
    variance = _box(reference * reference, radius) / count - mean**2
    inside_reference = _interior(height, width, radius)

    def compare(offset):
        inverse = base + offset

        def look(ray, move, corner, there):
            z = ray[2] + inverse * move[2]
            safe = jnp.where(z > 1e-6, z, 1)
            x, y = (ray[0] + inverse * move[0]) / safe, (ray[1] + inverse * move[1]) / safe
            inside = (z > 1e-6) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1) & (inverse > 0) & there
            warped = _sample(corner, x, y)
            other = _box(warped, radius) / count
            spread = _box(warped * warped, radius) / count - other**2
            both = _box(warped * reference, radius) / count - mean * other
            seen = _box(inside.astype(jnp.float32), radius) > count - 0.5
            textured = (variance > _FLAT) & (spread > _FLAT)
            score = both * lax.rsqrt(jnp.maximum(variance * spread, _FLAT**2))
            return jnp.where(seen & inside_reference & textured, jnp.clip(score, -1, 1), -1)

        scores = jax.vmap(look)(rays, shift, corners, valid)
        return _mean_of_best(scores, keep, jnp.sum(valid))

    volume = lax.map(compare, offsets)  # p h w
    return _pick(volume, base, offsets)


def _pick(volume, base, offsets):
    """The best plane of every pixel, between planes by the parabola through it and its neighbours."""
    planes = len(offsets)
    best = jnp.argmax(volume, axis=0)
    score = jnp.max(volume, axis=0)
    at = lambda plane: jnp.take_along_axis(volume, jnp.clip(plane, 0, planes - 1)[None], axis=0)[0]
    before, after = at(best - 1), at(best + 1)
    inner = (best > 0) & (best < planes - 1) & (before > -1) & (after > -1)
    curvature = jnp.where(inner, 2 * score - before - after, 0)
    part = jnp.where(curvature > 1e-6, 0.5 * (after - before) / jnp.where(curvature > 1e-6, curvature, 1), 0)
    step = offsets[1] - offsets[0]
    far = jnp.abs(jnp.arange(planes)[:, None, None] - best[None]) >= 2
    runner_up = jnp.max(jnp.where(far, volume, -1), axis=0)
    inverse = base + offsets[best] + jnp.clip(part, -0.5, 0.5) * step
    return Sweep(jnp.where(inner, inverse, 0), score, runner_up, curvature)


def _mean_of_best(scores, keep, there):
    """The mean of the ``keep`` best along the first axis, or of all that are there if those are fewer."""
    keep = min(keep, scores.shape[0])
    best = [jnp.full(scores.shape[1:], -1.0)] * keep
    for score in scores:
        for place in range(keep):
            best[place], score = jnp.maximum(best[place], score), jnp.minimum(best[place], score)
    counted = jnp.clip(there, 1, keep).astype(scores.dtype)
    return sum(jnp.where(place < counted, image, 0) for place, image in enumerate(best)) / counted


def _interior(height, width, radius):
    rows, columns = jnp.arange(height)[:, None], jnp.arange(width)[None]
    return (rows >= radius) & (rows < height - radius) & (columns >= radius) & (columns < width - radius)


def _box(image, radius):
    """Sums over windows; beyond the border is nothing."""
    height, width = image.shape
    padded = jnp.pad(image, radius)
    rows = reduce(jnp.add, [padded[i : i + height] for i in range(2 * radius + 1)])
    return reduce(jnp.add, [rows[:, i : i + width] for i in range(2 * radius + 1)])


def _corners(image):
    """An image whose every pixel has its right, lower and diagonal neighbour beside it: one look-up interpolates."""
    right = jnp.concatenate([image[:, 1:], image[:, -1:]], axis=1)
    below = jnp.concatenate([image[1:], image[-1:]], axis=0)
    diagonal = jnp.concatenate([right[1:], right[-1:]], axis=0)
    return jnp.stack([image, right, below, diagonal], axis=-1)


def _sample(corners, x, y):
    """Bilinear; what lies outside is that of the border."""
    height, width = corners.shape[:2]
    x, y = jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1)
    column, row = jnp.floor(x), jnp.floor(y)
    found = corners.reshape(-1, 4)[row.astype(jnp.int32) * width + column.astype(jnp.int32)]
    across, down = x - column, y - row
    above = found[..., 0] + across * (found[..., 1] - found[..., 0])
    return above + down * (found[..., 2] + across * (found[..., 3] - found[..., 2]) - above)
