"""Where a camera stood, frame by frame: the normal equations of a graph of poses, from depth images and their colours.

Frames are compared in pairs. Points of the one, the source, are carried into the other, the target, and fall on pixels
of its depth image (projective association: G. Blais and M. D. Levine, "Registering multiview range data to create 3D
computer objects", 1995); their distance along the target's normal is the residual (Y. Chen and G. Medioni, "Object
modelling by registration of multiple range images", 1992), and, if wanted, the difference in colour another. Each pair
gives the equations of one small motion of its source in the target's camera; :func:`ipjax_kernels.reference.trajectory`
has the same as loops. What frames share is added up by whoever solves for all poses at once.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ipjax_kernels.positive import root


class Images(NamedTuple):
    """What all frames saw, at one size and with one camera.

    Depths are kept as their inverse, which is linear across the image of a plane, so that what lies between pixels
    can be interpolated.
    """

    values: Float[Array, "n h w 5"]  # inverse depth, 1/m (0 = unknown); normal towards the camera; brightness
    focal: Float[Array, "2"]  # pixels
    centre: Float[Array, "2"]  # pixels


class Samples(NamedTuple):
    """Points of every frame, in its own camera."""

    places: Float[Array, "n m 3"]  # m
    normals: Float[Array, "n m 3"]  # towards the camera
    brightness: Float[Array, "n m"]
    there: Bool[Array, "n m"]


class Gates(NamedTuple):
    """Which points are compared, and how residuals count. Every value is traced."""

    noise: Float[Array, ""]  # of depth near the camera, along z, m; at depth z it is noise (1 + growth z²)
    growth: Float[Array, ""]  # 1/m²
    width: Float[Array, ""]  # of the robust kernel, in multiples of a residual's noise
    jump: Float[Array, ""]  # largest relative difference between the four depths that are interpolated
    alike: Float[Array, ""]  # least cosine between the two normals
    facing: Float[Array, ""]  # least cosine between a normal and the direction to the camera
    contrast: Float[Array, ""]  # noise of a difference in brightness; inf = colours do not count


class PairEquations(NamedTuple):
    """½ of the loss of each pair, near where it is: ½ Σ w r² ≈ … + slopeᵀ δ + ½ δᵀ hessian δ.

    δ = (ω, v): the source's points q, in the target's camera, move by ω × q + v, rad and m.
    """

    hessian: Float[Array, "p 6 6"]  # with residuals in multiples of their noise
    slope: Float[Array, "p 6"]
    shared: Float[Array, "p 6 6"]  # the Hessian of depths with one normal from either frame: free of the normals' noise
    loss: Float[Array, "p"]  # sum over its points of width² ρ, ρ in [0, 1]
    compared: Float[Array, "p"]  # number of points that were: inside of the target's image, where it has a depth
    near: Float[Array, "p"]  # of these, those whose residual is below the kernel's width
    spread: Float[Array, "p"]  # mean absolute residual of the near ones, in multiples of its noise


@partial(jax.jit, static_argnames=("shrink", "radius"))
def fit_planes(
    inverse: Float[Array, "h w"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    jump: Float[Array, ""] | float,
    *,
    shrink: int = 1,
    radius: int = 2,
) -> tuple[Float[Array, "a b"], Float[Array, "a b 3"]]:
    """A plane through the depths around every pixel of a smaller image, by least squares in inverse depth.

    Each pixel of the smaller image is a block of ``shrink`` × ``shrink`` of the given one; the plane is fitted to what
    is known in the (2 radius + 1)² blocks around, each pixel at its own place. So images with gaps, as those that were
    warped from another camera, lose nothing.

    Args:
      inverse: inverse depth, 1/m; 0 = unknown. Its sides are multiples of ``shrink``.
      focal, centre: of the smaller image.
      jump: of a block, those pixels count whose inverse depth is below the largest one by less than this share; of the
        blocks around, those whose mean differs from the middle one's by less than ``radius`` times this share.

    Returns:
      The plane's inverse depth at the middle of each block (0 where nothing of the block is known, or too little
      around it to tell a plane) and its normal, towards the camera (zero there).
    """
    height, width = inverse.shape[0] // shrink, inverse.shape[1] // shrink
    dtype = inverse.dtype
    parts = inverse.reshape(height, shrink, width, shrink).transpose(1, 3, 0, 2).reshape(shrink**2, height, width)
    inner = (jnp.arange(shrink, dtype=dtype) - (shrink - 1) / 2) / shrink
    inner_x, inner_y = jnp.tile(inner, shrink)[:, None, None], jnp.repeat(inner, shrink)[:, None, None]
    nearest = jnp.max(parts, axis=0)
    share = ((parts > 0) & (parts > (1 - jump) * nearest)).astype(dtype)
    number = jnp.sum(share, axis=0)
    mean = jnp.sum(share * parts, axis=0) / jnp.maximum(number, 1)
    step = share * (parts - mean)  # small numbers: their products keep their digits
    # Sums over each block, about its middle: 1, x, y, x², xy, y², and of its inverse depths, less their mean, xw, yw.
    sums = [share, share * inner_x, share * inner_y, share * inner_x**2, share * inner_x * inner_y, share * inner_y**2]
    sums = jnp.stack([jnp.sum(each, axis=0) for each in [*sums, step * inner_x, step * inner_y]])
    padded = jnp.pad(jnp.concatenate([sums, mean[None]]), ((0, 0), (radius, radius), (radius, radius)))

    def add_row(y, total):  # a loop over rows, for the compiler's sake
        down = y.astype(dtype)
        for x in range(-radius, radius + 1):
            block = lax.dynamic_slice(padded, (0, radius + y, radius + x), (9, height, width))
            off = block[8] - mean
            same = (block[0] > 0) & (number > 0) & (jnp.abs(off) < radius * jump * mean)
            n, sx, sy, sxx, sxy, syy, sxw, syw = (jnp.where(same, each, 0) for each in block[:8])
            off = jnp.where(same, off, 0)
            fresh = (n, sx + x * n, sy + down * n, sxx + 2 * x * sx + x**2 * n, sxy + x * sy + down * (sx + x * n))
            fresh += (syy + 2 * down * sy + down**2 * n, n * off, sxw + off * (sx + x * n), syw + off * (sy + down * n))
            total = tuple(one + other for one, other in zip(total, fresh, strict=True))
        return total

    total = lax.fori_loop(-radius, radius + 1, add_row, (jnp.zeros_like(mean),) * 9)
    n, sx, sy, sxx, sxy, syy, sw, sxw, syw = total
    count = jnp.maximum(n, 1)
    mean_x, mean_y, mean_w = sx / count, sy / count, sw / count
    xx, xy, yy = sxx / count - mean_x**2, sxy / count - mean_x * mean_y, syy / count - mean_y**2
    xw, yw = sxw / count - mean_x * mean_w, syw / count - mean_y * mean_w
    determinant = xx * yy - xy**2
    even = radius * (radius + 1) / 3  # the variance of whole windows
    known = (number > 0) & (n >= 6) & (determinant > 0.1 * even**2)
    known = known & (mean_x**2 + mean_y**2 < even)
    safe = jnp.where(known, determinant, 1)
    by_x, by_y = (yy * xw - xy * yw) / safe, (xx * yw - xy * xw) / safe
    here = mean + mean_w - by_x * mean_x - by_y * mean_y
    column, row = jnp.arange(width, dtype=dtype)[None], jnp.arange(height, dtype=dtype)[:, None]
    ahead = here + by_x * (centre[0] - column) + by_y * (centre[1] - row)
    normal = -jnp.stack([by_x * focal[0], by_y * focal[1], ahead], axis=-1)
    length = root(jnp.sum(normal**2, axis=-1, keepdims=True))
    known = known & (here > 0)
    normal = jnp.where(known[..., None], normal / jnp.maximum(length, 1e-12), 0)
    return jnp.where(known, here, 0), normal


@partial(jax.jit, static_argnames=("colours",))
def compare_pairs(
    samples: Samples,
    images: Images,
    source: Int[Array, "p"],
    target: Int[Array, "p"],
    rotation: Float[Array, "p 3 3"],
    translation: Float[Array, "p 3"],
    gates: Gates,
    *,
    colours: bool = False,
) -> PairEquations:
    """The normal equations of every pair: robust point to plane, and differences of brightness if ``colours``.

    The loss of a point is Geman–McClure's ρ = s / (1 + s), s = r² / (width σ)², times width²; it is the most, 1, where
    the normals are unlike. A point counts nothing where it falls outside of the target's image, or where the target's
    four pixels around it are not all of one surface. Where depths differ by more than a few widths it counts nothing
    to speak of, which is what occlusion looks like.

    Args:
      source, target: indices of frames.
      rotation, translation: target from source, of each pair.
    """
    count, height, width = images.values.shape[:3]
    flat = images.values.reshape(count * height * width, -1)

    def compare(pair):
        first, second, turn, shift = pair
        moved = jnp.matmul(samples.places[first], turn.T, precision="highest") + shift
        own = jnp.matmul(samples.normals[first], turn.T, precision="highest")
        depth = moved[:, 2]
        ahead = depth > 1e-3
        scale = 1 / jnp.where(ahead, depth, 1)
        rays = moved * scale[:, None]
        pixel = images.focal * rays[:, :2] + images.centre
        inside = ahead & jnp.all((pixel >= 0) & (pixel <= jnp.asarray([width - 1, height - 1], pixel.dtype)), axis=-1)
        share, values = _gather(flat, second * height * width, jnp.where(inside[:, None], pixel, 0), width, height)
        nearest, farthest = jnp.max(values[..., 0], axis=0), jnp.min(values[..., 0], axis=0)
        whole = (farthest > 0) & (nearest - farthest < gates.jump * nearest)
        x, y = share[:, :1], share[:, 1:]
        between = (values[0] * (1 - x) + values[1] * x) * (1 - y) + (values[2] * (1 - x) + values[3] * x) * y
        normal = between[:, 1:4]
        length = root(jnp.sum(normal**2, axis=-1))
        normal = normal / jnp.maximum(length, 1e-6)[:, None]
        distance = root(jnp.sum(rays**2, axis=-1))
        shown = -jnp.sum(own * rays, axis=-1) > gates.facing * distance
        counted = samples.there[first] & inside & whole & shown & (length > 0.5)
        alike = jnp.sum(own * normal, axis=-1) > gates.alike

        seen = 1 / jnp.where(whole, between[:, 0], 1)
        slant, own_slant = jnp.sum(normal * rays, axis=-1), jnp.sum(own * rays, axis=-1)
        residual = slant * (depth - seen)
        sigma = lambda z: gates.noise * (1 + gates.growth * z**2)
        # Along the normal, an error of depth counts by the slant; never less than a third, for errors along the image.
        variance = jnp.maximum(slant**2, 0.1) * sigma(seen) ** 2
        variance = variance + jnp.maximum(own_slant**2, 0.1) * sigma(samples.places[first][:, 2]) ** 2
        squared = residual**2 / (variance * gates.width**2)
        used = counted & alike
        weight = jnp.where(used, 1 / (variance * (1 + squared) ** 2), 0)
        lever = jnp.concatenate([jnp.cross(moved, normal), normal], axis=-1)
        other = jnp.concatenate([jnp.cross(moved, own), own], axis=-1)
        weighed = lever * weight[:, None]
        hessian = jnp.matmul(weighed.T, lever, precision="highest")
        shared = jnp.matmul(weighed.T, other, precision="highest")
        slope = jnp.matmul(weighed.T, residual, precision="highest")
        loss = jnp.where(used, squared / (1 + squared), 1)
        near = used & (squared < 1)
        size = jnp.sum(jnp.where(near, jnp.abs(residual) / root(variance), 0))
        if colours:
            # Of the interpolated brightness, its exact slopes.
            right = ((values[1] - values[0]) * (1 - y) + (values[3] - values[2]) * y)[:, 4] * images.focal[0] * scale
            below = ((values[2] - values[0]) * (1 - x) + (values[3] - values[1]) * x)[:, 4] * images.focal[1] * scale
            ramp = jnp.stack([right, below, -(right * rays[:, 0] + below * rays[:, 1])], axis=-1)
            lever = jnp.concatenate([jnp.cross(moved, ramp), ramp], axis=-1)
            unlike = between[:, 4] - samples.brightness[first]
            off = unlike**2 / (9 * gates.contrast**2)
            weight = jnp.where(near, 1 / (gates.contrast**2 * (1 + off) ** 2), 0)
            weighed = lever * weight[:, None]
            extra = jnp.matmul(weighed.T, lever, precision="highest")
            hessian, shared = hessian + extra, shared + extra
            slope = slope + jnp.matmul(weighed.T, unlike, precision="highest")
        together = jnp.sum(counted)
        return PairEquations(
            hessian,
            slope,
            (shared + shared.T) / 2,
            jnp.sum(jnp.where(counted, loss, 0)) * gates.width**2,
            together.astype(loss.dtype),
            jnp.sum(near).astype(loss.dtype),
            size / jnp.maximum(jnp.sum(near), 1).astype(loss.dtype),
        )

    return lax.map(compare, (source, target, rotation, translation))


def _gather(flat, first, pixel, width, height):
    """Of the four pixels around each place: where between them it lies [m 2], and their values [4 m c]."""
    last = jnp.asarray([width - 2, height - 2], pixel.dtype)
    corner = jnp.clip(jnp.floor(pixel), 0, last)
    column, row = corner[:, 0].astype(jnp.int32), corner[:, 1].astype(jnp.int32)
    start = first + row * width + column
    places = jnp.stack([start, start + 1, start + width, start + width + 1])
    return pixel - corner, flat[places]
