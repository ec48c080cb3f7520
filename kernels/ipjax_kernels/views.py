"""What a camera would see from where none stood: colours and depth drawn from the frames around it.

Each frame's depth is carried into the view, where it is a guess of what is seen; a guess holds if the frames that look
at it see it there rather than through it (visibility by consensus, as in P. Merrell et al., "Real-time visibility-based
fusion of depth maps", 2007). Of those that hold the nearest is taken. Colours are then fetched from the frames that see
the same place, by how near their rays are, how finely they see it and how well their depth agrees (C. Buehler et al.,
"Unstructured lumigraph rendering", 2001). So nothing is blended across a silhouette, and what no frame knows stays
unknown. :func:`ipjax_kernels.reference.views` has the same as loops.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ipjax_kernels.positive import root
from ipjax_kernels.rasterize import splat_depth


class Sources(NamedTuple):
    """The frames that a view is drawn from."""

    colours: Float[Array, "k h w 3"]  # any unit
    depth: Float[Array, "k h w"]  # along z, m; 0 = unknown
    rotation: Float[Array, "k 3 3"]  # source_from_view
    translation: Float[Array, "k 3"]  # m
    weight: Float[Array, "k"]  # how much each has to say; 0 = nothing, it is not there
    focal: Float[Array, "2"]  # of all sources, pixels
    centre: Float[Array, "2"]  # pixels


class Rules(NamedTuple):
    """How sources are weighed. Every value is traced."""

    tolerance: Float[Array, ""] | float  # of depth, relative to it, up to which two depths are of one surface
    turn: Float[Array, ""] | float  # rad between two rays at which a source counts a quarter
    edge: Float[Array, ""] | float  # what colours count that lie beside a jump in depth, where they are of both sides


class Drawn(NamedTuple):
    """A view."""

    colours: Float[Array, "h w 3"]  # 0 where unknown
    depth: Float[Array, "h w"]  # along z, m; 0 = unknown
    support: Float[Array, "h w"]  # sum of the weights of the sources that its colours are from; 0 = unknown


_OF_EACH = ("depth", "rotation", "translation", "weight")
_SLOPE = 3  # tolerances from pixel to pixel that are a slope, and no jump
_REFINEMENTS = 2  # times that a depth is replaced by what the sources measured where it puts the surface


@partial(jax.jit, static_argnames=("height", "width"))
def draw_view(
    sources: Sources,
    rules: Rules,
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
) -> Drawn:
    """The image and the depth that a camera sees, height × width pixels. Vmap over views.

    Time: 3 k splats of the sources' pixels and 2 k² + 7 k look-ups a pixel; memory: O(k (h w + height · width)).
    """
    rays = _rays(height, width, focal, centre)

    def guess(depth, rotation, translation, weight):
        """A source's guesses, put where the view's rays meet what it measured: splats are of whole pixels."""
        one = depth, rotation, translation, weight
        alone = sources._replace(**{name: part[None] for name, part in zip(_OF_EACH, one, strict=True)})
        carried = _carry(depth, rotation, translation, weight, sources, focal, centre, height, width)
        meet = jax.vmap(lambda z: jnp.where(z > 0, _look(z, rays, alone, rules, focal).depth[0], 0))
        return lax.fori_loop(0, _REFINEMENTS, lambda _, z: meet(z), carried)

    guesses = jax.vmap(guess)(*(getattr(sources, name) for name in _OF_EACH))

    def judge(best, guess):
        depth, score = best
        seen = _look(guess, rays, sources, rules, focal)
        total = jnp.sum(seen.weight * (seen.agrees - seen.through), axis=0)
        slack = rules.tolerance * depth
        nearer = (depth == 0) | (guess < depth - slack) | ((guess <= depth + slack) & (total > score))
        better = (guess > 0) & (total > 0) & nearer
        return (jnp.where(better, guess, depth), jnp.where(better, total, score)), None

    nothing = jnp.zeros((height, width), sources.depth.dtype)
    (depth, _), _ = lax.scan(judge, (nothing, nothing), guesses.reshape(-1, height, width))

    def refine(_, depth):
        seen = _look(depth, rays, sources, rules, focal)
        weight = seen.weight * seen.agrees
        total = jnp.sum(weight, axis=0)
        moved = jnp.sum(weight * seen.depth, axis=0) / jnp.where(total > 0, total, 1)
        return jnp.where(total > 0, moved, depth)

    depth = lax.fori_loop(0, _REFINEMENTS, refine, depth)
    seen = _look(depth, rays, sources, rules, focal)
    steady = jax.vmap(lambda z: _find_jumps(z, rules.tolerance))(sources.depth)
    beside = jax.vmap(_nearest)(steady.astype(depth.dtype), seen.pixel)
    weight = seen.weight * seen.agrees * jnp.where(beside > 0, rules.edge, 1)
    total = jnp.sum(weight, axis=0)
    fetched = jax.vmap(_between)(sources.colours, seen.pixel)
    colours = jnp.sum(weight[..., None] * fetched, axis=0) / jnp.where(total > 0, total, 1)[..., None]
    known = (depth > 0) & (total > 0)
    return Drawn(jnp.where(known[..., None], colours, 0), jnp.where(known, depth, 0), jnp.where(known, total, 0))


class _Look(NamedTuple):
    """What every source says of points, one on each ray of the view."""

    pixel: Float[Array, "k h w 2"]  # where it sees the point
    weight: Float[Array, "k h w"]  # what its word counts
    agrees: Float[Array, "k h w"]  # 1 where it measured the point's depth, less the farther it is off
    through: Float[Array, "k h w"]  # 1 where it sees something behind the point
    depth: Float[Array, "k h w"]  # along the view's z: where the ray meets what it measured there


def _look(
    depth: Float[Array, "h w"],
    rays: Float[Array, "h w 3"],
    sources: Sources,
    rules: Rules,
    focal: Float[Array, "2"],
) -> _Look:
    points = depth[..., None] * rays
    along = jnp.sum(sources.rotation[:, None, None] * rays[..., None, :], axis=-1)  # k h w 3: the rays, turned
    moved = depth[..., None] * along + sources.translation[:, None, None]
    z = moved[..., 2]
    ahead = (z > 1e-3) & (depth > 0)
    pixel = sources.focal * moved[..., :2] / jnp.where(ahead, z, 1)[..., None] + sources.centre
    limit = jnp.asarray([sources.depth.shape[2] - 1, sources.depth.shape[1] - 1], pixel.dtype)
    inside = ahead & jnp.all((pixel >= -0.5) & (pixel <= limit + 0.5), axis=-1)
    pixel = jnp.clip(jnp.where(inside[..., None], pixel, 0), 0, limit)
    measured = jnp.where(inside, jax.vmap(lambda a, b: _between_alike(a, b, rules.tolerance))(sources.depth, pixel), 0)
    off = (measured - z) / (rules.tolerance * jnp.maximum(z, 1e-3))
    told = measured > 0
    agrees = jnp.where(told, jnp.maximum(1 - off * off, 0), 0)
    through = jnp.where(told & (off > 1), 1.0, 0.0)
    # The angle between the rays of view and source, at the point.
    eye = -jnp.sum(sources.rotation * sources.translation[:, :, None], axis=1)  # k 3: the source, in the view
    back = eye[:, None, None] - points
    lengths = root(jnp.sum(back * back, axis=-1)) * root(jnp.sum(points * points, axis=-1))
    cosine = -jnp.sum(back * points, axis=-1) / jnp.maximum(lengths, 1e-9)
    apart = 2 * jnp.maximum(1 - cosine, 0) / rules.turn**2
    # How much finer the view sees the place than the source did.
    finer = z * jnp.mean(focal) / (jnp.mean(sources.focal) * jnp.maximum(depth, 1e-3))
    weight = sources.weight[:, None, None] / (1 + apart) ** 2 / jnp.maximum(finer, 1) ** 2
    slope = along[..., 2]
    steep = jnp.abs(slope) < 0.05  # the source looks across the ray: its depth does not say where on it
    meets = (measured - sources.translation[:, None, None, 2]) / jnp.where(steep, 1, slope)
    return _Look(pixel, jnp.where(told, weight, 0), agrees, through, jnp.where(steep | ~told, depth, meets))


def _carry(
    depth: Float[Array, "h w"],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    weight: Float[Array, ""],
    sources: Sources,
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
) -> Float[Array, "2 a b"]:
    """A source's depth in the view, 0 where none of its points falls: the nearest of the pixel's own points, and the
    nearest of those of the 3 × 3 pixels around. Where points lie apart, half the resolution fills in.
    """
    rows, columns = depth.shape
    points = (_rays(rows, columns, sources.focal, sources.centre) * depth[..., None]).reshape(-1, 3)
    points = jnp.sum(rotation.T[None] * (points - translation)[:, None, :], axis=-1)
    valid = (depth.reshape(-1) > 0) & (weight > 0)
    own, around = (splat_depth(points, valid, focal, centre, height, width, radius=r) for r in (0, 1))
    # Every second pixel of the view: pixel i of it is 2 i of the view.
    few = (height + 1) // 2 + 1, (width + 1) // 2 + 1
    coarse = splat_depth(points, valid, focal / 2, centre / 2, *few, radius=1)
    row, column = (jnp.arange(height) + 1) // 2, (jnp.arange(width) + 1) // 2
    return jnp.stack([own, jnp.where(around > 0, around, coarse[row[:, None], column])])


def _rays(height: int, width: int, focal: Float[Array, "2"], centre: Float[Array, "2"]) -> Float[Array, "h w 3"]:
    """What every pixel looks along, z = 1."""
    rows, columns = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    xy = (jnp.stack([columns, rows], axis=-1).astype(focal.dtype) - centre) / focal
    return jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)


def _find_jumps(depth: Float[Array, "h w"], tolerance: Float[Array, ""] | float) -> Bool[Array, "h w"]:
    """Pixels of which one in the 5 × 5 around is of another surface."""
    window = lambda image, start, reduce: lax.reduce_window(image, start, reduce, (5, 5), (1, 1), "SAME")
    far = window(depth, -jnp.inf, lax.max)
    near = window(jnp.where(depth > 0, depth, jnp.inf), jnp.inf, lax.min)
    return (depth > 0) & (far - near > 2 * tolerance * depth)


def _nearest(image: Float[Array, "h w"], pixel: Float[Array, "a b 2"]) -> Float[Array, "a b"]:
    column, row = jnp.moveaxis(jnp.round(pixel).astype(jnp.int32), -1, 0)
    return image[row, column]


def _corners(pixel: Float[Array, "a b 2"], height: int, width: int):
    """Row and column of the first of four pixels, and how far between them."""
    x = jnp.clip(jnp.floor(pixel[..., 0]), 0, width - 2)
    y = jnp.clip(jnp.floor(pixel[..., 1]), 0, height - 2)
    return y.astype(jnp.int32), x.astype(jnp.int32), pixel[..., 0] - x, pixel[..., 1] - y


def _between(image: Float[Array, "h w c"], pixel: Float[Array, "a b 2"]) -> Float[Array, "a b c"]:
    """The image between its pixels, linearly."""
    row, column, x, y = _corners(pixel, *image.shape[:2])
    x, y = x[..., None], y[..., None]
    above = image[row, column] * (1 - x) + image[row, column + 1] * x
    below = image[row + 1, column] * (1 - x) + image[row + 1, column + 1] * x
    return above * (1 - y) + below * y


def _between_alike(
    depth: Float[Array, "h w"], pixel: Float[Array, "a b 2"], tolerance: Float[Array, ""] | float
) -> Float[Array, "a b"]:
    """Depth between the pixels: linearly where the four are of one surface, else that of the nearest pixel."""
    row, column, x, y = _corners(pixel, *depth.shape)
    four = jnp.stack([depth[row, column], depth[row, column + 1], depth[row + 1, column], depth[row + 1, column + 1]])
    low, high = jnp.min(four, axis=0), jnp.max(four, axis=0)
    weight = jnp.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    closest = jnp.take_along_axis(four, jnp.argmax(weight, axis=0)[None], axis=0)[0]
    return jnp.where((low > 0) & (high - low <= _SLOPE * tolerance * low), jnp.sum(weight * four, axis=0), closest)
