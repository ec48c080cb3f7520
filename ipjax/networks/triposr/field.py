"""The field that a triplane holds: density and colour at points, and density on a grid."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ipjax.networks.triposr.layers import HIGHEST
from ipjax.networks.triposr.model import TripoSR


def sample_planes(triplane: Float[Array, "3 c h w"], points: Float[Array, "n 3"], radius: float) -> Float[Array, "n f"]:
    """Features of points in the planes (x, y), (x, z), (y, z): bilinear, zero outside, concatenated.

    The first coordinate runs along a plane's width, the second along its height; points in mesh units.
    """
    _, channels, height, width = triplane.shape
    texels = triplane.transpose(0, 2, 3, 1).reshape(3, height * width, channels)
    # As the official code scales: in two steps, so that points on a face round the same way.
    unit = (points + radius) / (2 * radius) * 2.0 - 1.0

    def sample(plane: Float[Array, "hw c"], at: Float[Array, "n 2"]) -> Float[Array, "n c"]:
        size = jnp.asarray([width, height], jnp.float32)
        pixel = ((at + 1.0) * size - 1.0) / 2.0
        first = jnp.floor(pixel)
        part = pixel - first
        total = jnp.zeros((at.shape[0], channels), jnp.float32)
        for dx in (0, 1):
            for dy in (0, 1):
                x, y = first[:, 0] + dx, first[:, 1] + dy
                weight = jnp.abs(1 - dx - part[:, 0]) * jnp.abs(1 - dy - part[:, 1])
                inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
                column = jnp.clip(x, 0, width - 1).astype(jnp.int32)
                row = jnp.clip(y, 0, height - 1).astype(jnp.int32)
                total = total + jnp.where(inside, weight, 0.0)[:, None] * plane[row * width + column]
        return total

    axes = ((0, 1), (0, 2), (1, 2))
    return jnp.concatenate([sample(texels[i], unit[:, jnp.asarray(pair)]) for i, pair in enumerate(axes)], axis=-1)


def query(
    model: TripoSR, triplane: Float[Array, "3 c h w"], points: Float[Array, "n 3"], *, chunk: int = 1 << 16
) -> tuple[Float[Array, "n"], Float[Array, "n 3"]]:
    """Density and colour in [0, 1] at points in mesh units, ``chunk`` (static) points at a time.

    Outside the cube all features are zero, and the density is a constant that may lie above the threshold: mask it.
    """

    def one(point: Float[Array, "3"]) -> Float[Array, "4"]:
        return model.decoder(sample_planes(triplane, point[None], model.config.radius))[0]

    raw = jax.lax.map(one, points, batch_size=min(chunk, points.shape[0]))
    return activate_density(model, raw[:, 0]), jax.nn.sigmoid(raw[:, 1:])


def activate_density(model: TripoSR, raw: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Density of the decoder's raw output: the exponential of it and the configured bias."""
    # The official code does not clip; 80 keeps float32 finite and is beyond any density that matters.
    return jnp.exp(jnp.minimum(raw + model.config.density_bias, 80.0))


def density_grid(
    model: TripoSR,
    triplane: Float[Array, "3 c h w"],
    resolution: int = 256,
    start: int | Int[Array, ""] = 0,
    *,
    count: int | None = None,
) -> Float[Array, "x r r"]:
    """Density at ``resolution``³ points, both faces of the cube included, index (x, y, z).

    Only the x-slabs from ``start`` (may be traced), ``count`` (static) of them, for callers that show progress.

    Memory is that of one x-slab (``resolution``² × decoder width): slabs follow one another. On a grid the planes are
    interpolated once per plane, not per point, and the decoder's first product with them: exact, and 3 R² for R³.
    """
    if count is None:
        count = resolution - start if isinstance(start, int) else resolution
    last = start + count if isinstance(start, int) else count
    if not 0 < count <= last <= resolution:
        raise ValueError(f"slabs {start} to {last} do not lie in a grid of {resolution}")
    channels, height, width = triplane.shape[1:]
    fraction = np.linspace(0.0, 1.0, resolution)

    def weights(size: int) -> Float[Array, "r s"]:
        pixel = fraction * size - 0.5
        return jnp.asarray(np.maximum(0.0, 1.0 - np.abs(pixel[:, None] - np.arange(size))), jnp.float32)

    along_width, along_height = weights(width), weights(height)
    kernel = model.decoder.layers[0].kernel[...].reshape(3, channels, -1)
    planes = jnp.einsum("pchw,pcn->phwn", triplane, kernel, precision=HIGHEST)
    planes = jnp.einsum("aw,bh,phwn->pabn", along_width, along_height, planes, precision=HIGHEST)
    bias = model.decoder.layers[0].bias
    assert bias is not None  # the decoder's layers have one
    yz = planes[2] + bias[...]

    def slab(xy_xz: Float[Array, "2 r n"]) -> Float[Array, "r r"]:
        raw = model.decoder.after_first(xy_xz[0][:, None] + xy_xz[1][None] + yz)
        return activate_density(model, raw[..., 0])

    return jax.lax.map(slab, jax.lax.dynamic_slice_in_dim(planes[:2], start, count, axis=1).transpose(1, 0, 2, 3))
