"""TripoSR in Flax (nnx): one photo to a triplane, and the field of density and colour that the triplane holds.

The published model (https://github.com/VAST-AI-Research/TripoSR, MIT): DINO ViT-B/16 tokens of the photo, learned
triplane tokens, a transformer that lets the second look at the first, an up-sampler, and a small MLP that turns what
the three planes say about a point into density and colour. Everything is written for one photo; the caller vmaps.

Frame of the field, here called ``mesh``: right-handed, +x towards the input camera, +y to the image's right, +z up;
the object lies in the cube of half side ``radius``. The scale is arbitrary: the network is given no camera.
"""

import itertools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from ipjax.networks.dinov2 import normalise, position_embedding

_HIGHEST = jax.lax.Precision.HIGHEST


@dataclass(frozen=True)
class VisionConfig:
    """The image tokenizer; the defaults are facebook/dino-vitb16."""

    width: int = 768
    layers: int = 12
    heads: int = 12
    hidden: int = 3072
    patch: int = 16  # pixels
    grid: int = 14  # stored positions per side
    epsilon: float = 1e-12


@dataclass(frozen=True)
class TripoSRConfig:
    """The network; the defaults are the published size (419 275 628 parameters)."""

    vision: VisionConfig = field(default_factory=VisionConfig)
    image_size: int = 512  # pixels; what the photo is resized to
    plane_size: int = 32  # tokens per side of a plane
    width: int = 1024
    layers: int = 16
    heads: int = 16
    groups: int = 32  # of the group norm at the backbone's entry
    plane_channels: int = 40  # after up-sampling
    decoder_width: int = 64
    decoder_layers: int = 9  # hidden ones
    radius: float = 0.87  # half side of the cube, mesh units
    density_bias: float = -1.0
    samples: int = 128  # per ray
    threshold: float = 25.0  # density of the surface
    dtype: str = "float32"  # of the weights and of the products' inputs; "bfloat16" halves the memory


# The checkpoint carries the pooler of the vision transformer, whose output the official code throws away.
_UNUSED = {
    "image_tokenizer.model.pooler.dense.weight": lambda c: (c.vision.width, c.vision.width),
    "image_tokenizer.model.pooler.dense.bias": lambda c: (c.vision.width,),
}


# --- layers -----------------------------------------------------------------------------------------------------------


def _normal(rngs: nnx.Rngs, shape: tuple[int, ...], spread: float, dtype: str) -> nnx.Param:
    return nnx.Param((spread * jax.random.normal(rngs.params(), shape, jnp.float32)).astype(dtype))


class Linear(nnx.Module):
    """Products in the weights' precision, sums in float32."""

    def __init__(self, inputs: int, outputs: int, *, bias: bool = True, dtype: str, rngs: nnx.Rngs):
        self.kernel = _normal(rngs, (inputs, outputs), inputs**-0.5, dtype)
        self.bias = nnx.Param(jnp.zeros(outputs, dtype)) if bias else None

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        kernel = self.kernel[...]
        y = jnp.matmul(x.astype(kernel.dtype), kernel, precision=_HIGHEST, preferred_element_type=jnp.float32)
        return y if self.bias is None else y + self.bias[...].astype(jnp.float32)


class LayerNorm(nnx.Module):
    """Over the last axis, in float32: the vision transformer's ε of 1e-12 means nothing in less."""

    def __init__(self, width: int, *, epsilon: float, dtype: str):
        self.scale = nnx.Param(jnp.ones(width, dtype))
        self.bias = nnx.Param(jnp.zeros(width, dtype))
        self.epsilon = epsilon

    def __call__(self, x: Float[Array, "n c"]) -> Float[Array, "n c"]:
        centred = x - jnp.mean(x, axis=-1, keepdims=True)
        variance = jnp.mean(centred * centred, axis=-1, keepdims=True)
        unit = centred * jax.lax.rsqrt(variance + self.epsilon)
        return unit * self.scale[...].astype(jnp.float32) + self.bias[...].astype(jnp.float32)


class GroupNorm(nnx.Module):
    """Over all tokens of all planes and the channels of a group at once."""

    def __init__(self, width: int, *, groups: int, dtype: str):
        self.scale = nnx.Param(jnp.ones(width, dtype))
        self.bias = nnx.Param(jnp.zeros(width, dtype))
        self.groups = groups

    def __call__(self, x: Float[Array, "n c"]) -> Float[Array, "n c"]:
        tokens, width = x.shape
        grouped = x.reshape(tokens, self.groups, width // self.groups)
        centred = grouped - jnp.mean(grouped, axis=(0, 2), keepdims=True)
        variance = jnp.mean(centred * centred, axis=(0, 2), keepdims=True)
        unit = (centred * jax.lax.rsqrt(variance + 1e-6)).reshape(tokens, width)
        return unit * self.scale[...].astype(jnp.float32) + self.bias[...].astype(jnp.float32)


class Attention(nnx.Module):
    """Softmax attention of ``x`` over ``context``; heads are contiguous chunks of the channels."""

    def __init__(self, width: int, context: int, heads: int, *, bias: bool, dtype: str, rngs: nnx.Rngs):
        self.query = Linear(width, width, bias=bias, dtype=dtype, rngs=rngs)
        self.key = Linear(context, width, bias=bias, dtype=dtype, rngs=rngs)
        self.value = Linear(context, width, bias=bias, dtype=dtype, rngs=rngs)
        self.output = Linear(width, width, dtype=dtype, rngs=rngs)
        self.heads = heads

    def __call__(self, x: Float[Array, "n c"], context: Float[Array, "m d"]) -> Float[Array, "n c"]:
        dtype = self.query.kernel[...].dtype

        def split(y: Float[Array, "t c"]) -> Float[Array, "h t k"]:
            return y.reshape(y.shape[0], self.heads, -1).transpose(1, 0, 2).astype(dtype)

        q, k, v = split(self.query(x)), split(self.key(context)), split(self.value(context))
        options: dict[str, Any] = dict(precision=_HIGHEST, preferred_element_type=jnp.float32)
        logits = jnp.einsum("hnk,hmk->hnm", q, k, **options) * q.shape[-1] ** -0.5
        weights = jax.nn.softmax(logits, axis=-1).astype(dtype)
        mixed = jnp.einsum("hnm,hmk->hnk", weights, v, **options)
        return self.output(mixed.transpose(1, 0, 2).reshape(x.shape[0], -1))


class VisionBlock(nnx.Module):
    """Pre-norm self-attention and MLP, each added to the stream."""

    def __init__(self, config: VisionConfig, *, dtype: str, rngs: nnx.Rngs):
        self.norm1 = LayerNorm(config.width, epsilon=config.epsilon, dtype=dtype)
        self.attention = Attention(config.width, config.width, config.heads, bias=True, dtype=dtype, rngs=rngs)
        self.norm2 = LayerNorm(config.width, epsilon=config.epsilon, dtype=dtype)
        self.widen = Linear(config.width, config.hidden, dtype=dtype, rngs=rngs)
        self.narrow = Linear(config.hidden, config.width, dtype=dtype, rngs=rngs)

    def __call__(self, x: Float[Array, "n c"]) -> Float[Array, "n c"]:
        normed = self.norm1(x)
        x = x + self.attention(normed, normed)
        return x + self.narrow(jax.nn.gelu(self.widen(self.norm2(x)), approximate=False))


class VisionTokenizer(nnx.Module):
    """DINO ViT: a photo in [0, 1] to one token per patch, the class token first."""

    def __init__(self, config: VisionConfig, *, dtype: str, rngs: nnx.Rngs):
        self.patches = Linear(3 * config.patch**2, config.width, dtype=dtype, rngs=rngs)
        self.class_token = _normal(rngs, (config.width,), 0.02, dtype)
        self.positions = _normal(rngs, (1 + config.grid**2, config.width), 0.02, dtype)
        self.blocks = nnx.List([VisionBlock(config, dtype=dtype, rngs=rngs) for _ in range(config.layers)])
        self.norm = LayerNorm(config.width, epsilon=config.epsilon, dtype=dtype)
        self.patch = config.patch

    def embed(self, image: Float[Array, "s s 3"]) -> Float[Array, "n c"]:
        """Patches, row by row, with the class token before them and positions added; what the blocks read."""
        size, patch = image.shape[0], self.patch
        if size % patch:
            raise ValueError(f"the photo's side of {size} px is not a multiple of the patch of {patch} px")
        side = size // patch
        cut = normalise(image).reshape(side, patch, side, patch, 3).transpose(0, 2, 1, 3, 4).reshape(side * side, -1)
        tokens = jnp.concatenate([self.class_token[...].astype(jnp.float32)[None], self.patches(cut)])
        return tokens + interpolate_positions(self.positions[...].astype(jnp.float32), side)

    def __call__(self, image: Float[Array, "s s 3"]) -> Float[Array, "n c"]:
        tokens = self.embed(image)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)


class BackboneBlock(nnx.Module):
    """Triplane tokens look at each other, then at the photo, then pass a gated MLP."""

    def __init__(self, config: TripoSRConfig, *, rngs: nnx.Rngs):
        width, dtype = config.width, config.dtype
        self.norm1 = LayerNorm(width, epsilon=1e-5, dtype=dtype)
        self.attention1 = Attention(width, width, config.heads, bias=False, dtype=dtype, rngs=rngs)
        self.norm2 = LayerNorm(width, epsilon=1e-5, dtype=dtype)
        self.attention2 = Attention(width, config.vision.width, config.heads, bias=False, dtype=dtype, rngs=rngs)
        self.norm3 = LayerNorm(width, epsilon=1e-5, dtype=dtype)
        self.widen = Linear(width, 8 * width, dtype=dtype, rngs=rngs)
        self.narrow = Linear(4 * width, width, dtype=dtype, rngs=rngs)

    def gate(self, x: Float[Array, "n c"]) -> Float[Array, "n d"]:
        """GEGLU: the first half of the channels times the GELU of the second."""
        value, gate = jnp.split(self.widen(x), 2, axis=-1)
        return value * jax.nn.gelu(gate, approximate=False)

    def __call__(self, x: Float[Array, "n c"], photo: Float[Array, "m d"]) -> Float[Array, "n c"]:
        normed = self.norm1(x)
        x = x + self.attention1(normed, normed)
        x = x + self.attention2(self.norm2(x), photo)
        return x + self.narrow(self.gate(self.norm3(x)))


class Backbone(nnx.Module):
    """The transformer over triplane tokens; what comes out is added to what went in, un-normalised."""

    def __init__(self, config: TripoSRConfig, *, rngs: nnx.Rngs):
        self.norm = GroupNorm(config.width, groups=config.groups, dtype=config.dtype)
        self.enter = Linear(config.width, config.width, dtype=config.dtype, rngs=rngs)
        self.blocks = nnx.List([BackboneBlock(config, rngs=rngs) for _ in range(config.layers)])
        self.leave = Linear(config.width, config.width, dtype=config.dtype, rngs=rngs)

    def __call__(self, tokens: Float[Array, "n c"], photo: Float[Array, "m d"]) -> Float[Array, "n c"]:
        x = self.enter(self.norm(tokens))
        for block in self.blocks:
            x = block(x, photo)
        return self.leave(x) + tokens


class Upsampler(nnx.Module):
    """A transposed convolution whose kernel equals its stride: every token becomes 2 × 2 texels."""

    def __init__(self, inputs: int, outputs: int, *, dtype: str, rngs: nnx.Rngs):
        self.kernel = _normal(rngs, (inputs, outputs, 2, 2), inputs**-0.5, dtype)
        self.bias = nnx.Param(jnp.zeros(outputs, dtype))

    def __call__(self, planes: Float[Array, "3 h w i"]) -> Float[Array, "3 o hh ww"]:
        kernel = self.kernel[...]
        _, height, width, _ = planes.shape
        texels = jnp.einsum(
            "phwi,ioab->pohawb",
            planes.astype(kernel.dtype),
            kernel,
            precision=_HIGHEST,
            preferred_element_type=jnp.float32,
        )
        return texels.reshape(3, -1, 2 * height, 2 * width) + self.bias[...].astype(jnp.float32)[:, None, None]


class Decoder(nnx.Module):
    """What the three planes say about a point → raw density and three raw colours; always float32."""

    def __init__(self, config: TripoSRConfig, *, rngs: nnx.Rngs):
        widths = [3 * config.plane_channels, *[config.decoder_width] * config.decoder_layers, 4]
        pairs = itertools.pairwise(widths)
        self.layers = nnx.List([Linear(i, o, dtype="float32", rngs=rngs) for i, o in pairs])

    def __call__(self, features: Float[Array, "*b f"]) -> Float[Array, "*b 4"]:
        return self.after_first(self.layers[0](features))

    def after_first(self, x: Float[Array, "*b n"]) -> Float[Array, "*b 4"]:
        """All that follows the first product: `density_grid` makes that product once per plane, not per point."""
        for layer in list(self.layers)[1:]:
            x = layer(jax.nn.silu(x))
        return x


class TripoSR(nnx.Module):
    """Photo → triplane; the field in the triplane is read by `query`, `density_grid` and `render`."""

    def __init__(self, config: TripoSRConfig, *, rngs: nnx.Rngs):
        self.config = config
        self.tokenizer = VisionTokenizer(config.vision, dtype=config.dtype, rngs=rngs)
        shape = (3, config.width, config.plane_size, config.plane_size)
        self.embeddings = _normal(rngs, shape, config.width**-0.5, config.dtype)
        self.backbone = Backbone(config, rngs=rngs)
        self.upsampler = Upsampler(config.width, config.plane_channels, dtype=config.dtype, rngs=rngs)
        self.decoder = Decoder(config, rngs=rngs)

    def tokens(self) -> Float[Array, "n c"]:
        """The learned triplane tokens: plane by plane, row by row."""
        planes = self.embeddings[...].astype(jnp.float32)
        return planes.transpose(0, 2, 3, 1).reshape(-1, planes.shape[1])

    def unfold(self, tokens: Float[Array, "n i"]) -> Float[Array, "3 c h w"]:
        """Tokens of the backbone → the triplane, up-sampled."""
        side = self.config.plane_size
        return self.upsampler(tokens.reshape(3, side, side, -1))

    def __call__(self, image: Float[Array, "s s 3"]) -> Float[Array, "3 c h w"]:
        """The triplane of a photo that `prepare_image` prepared: (plane xy, xz, yz; channel; second; first axis).

        Errors: ValueError when the photo is not square with the configured side.
        """
        size = self.config.image_size
        if image.shape[:2] != (size, size):
            raise ValueError(f"the network reads {size} × {size} photos, not {image.shape[1]} × {image.shape[0]}")
        return self.unfold(self.backbone(self.tokens(), self.tokenizer(image)))


# --- before the network -----------------------------------------------------------------------------------------------


def prepare_image(image: Float[Array, "h w 3"], size: int = 512) -> Float[Array, "s s 3"]:
    """Resize a photo in [0, 1] to a square, with antialiasing, aspect not kept: as the model was trained."""
    return jax.image.resize(image, (size, size, image.shape[2]), "linear", antialias=True, precision=_HIGHEST)


def interpolate_positions(positions: Float[Array, "n c"], side: int) -> Float[Array, "m c"]:
    """Position embeddings for ``side`` × ``side`` patches; the class token's stays (modeling_vit.py, 4.35).

    The +0.1 in the scale is that of the transformers library up to 4.44, with which the checkpoint was trained.
    """
    grid = position_embedding(positions[1:], (side, side), antialias=False, offset=0.1)
    return jnp.concatenate([positions[:1], grid.reshape(side * side, -1)])


# --- the field --------------------------------------------------------------------------------------------------------


def sample_planes(triplane: Float[Array, "3 c h w"], points: Float[Array, "n 3"], radius: float) -> Float[Array, "n f"]:
    """What the planes (x, y), (x, z), (y, z) say about points: bilinear, zero outside, plane after plane.

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

    Outside the cube the planes say nothing and the density is a constant that may lie above the threshold: mask it.
    """

    def one(point: Float[Array, "3"]) -> Float[Array, "4"]:
        return model.decoder(sample_planes(triplane, point[None], model.config.radius))[0]

    raw = jax.lax.map(one, points, batch_size=min(chunk, points.shape[0]))
    return _density(model, raw[:, 0]), jax.nn.sigmoid(raw[:, 1:])


def _density(model: TripoSR, raw: Float[Array, "*b"]) -> Float[Array, "*b"]:
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
    planes = jnp.einsum("pchw,pcn->phwn", triplane, kernel, precision=_HIGHEST)
    planes = jnp.einsum("aw,bh,phwn->pabn", along_width, along_height, planes, precision=_HIGHEST)
    bias = model.decoder.layers[0].bias
    assert bias is not None  # the decoder's layers have one
    yz = planes[2] + bias[...]

    def slab(xy_xz: Float[Array, "2 r n"]) -> Float[Array, "r r"]:
        raw = model.decoder.after_first(xy_xz[0][:, None] + xy_xz[1][None] + yz)
        return _density(model, raw[..., 0])

    return jax.lax.map(slab, jax.lax.dynamic_slice_in_dim(planes[:2], start, count, axis=1).transpose(1, 0, 2, 3))


# --- the renderer -----------------------------------------------------------------------------------------------------


class Rays(eqx.Module):
    """Origins and unit directions, in the mesh frame."""

    origins: Float[Array, "*b 3"]
    directions: Float[Array, "*b 3"]


class Rendering(eqx.Module):
    """What rays saw of the field."""

    rgb: Float[Array, "*b 3"]  # [0, 1], on white
    distance: Float[Array, "*b"]  # along the ray, mesh units; 0 = the ray met nothing
    opacity: Float[Array, "*b"]  # [0, 1]


def orbit_rays(
    views: int, height: int, width: int, *, elevation: float = 0.0, distance: float = 1.9, fov: float = 40.0
) -> Rays:
    """Rays of cameras on a circle that look at the origin; degrees, mesh units; the first stands on +x.

    Field of view is the vertical one. Shapes: ``views height width 3``.
    """
    azimuth = np.deg2rad(np.linspace(0.0, 360.0, views + 1)[:views])
    tilt = np.deg2rad(elevation)
    spot = [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.full(views, np.sin(tilt))]
    position = distance * np.stack(spot, axis=-1)
    ahead = -position / distance
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.cross(right, ahead)
    focal = 0.5 * height / np.tan(0.5 * np.deg2rad(fov))
    x = (np.arange(width) + 0.5 - 0.5 * width) / focal
    y = (np.arange(height) + 0.5 - 0.5 * height) / focal
    view = lambda axis: axis[:, None, None, :]
    directions = view(ahead) + x[None, None, :, None] * view(right) - y[None, :, None, None] * view(up)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = np.broadcast_to(view(position), directions.shape)
    return Rays(jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32))


def meet_cube(rays: Rays, radius: float) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Bool[Array, "*b"]]:
    """Where rays enter and leave the cube of half side ``radius``·(1 − 1e-3), and whether they meet it (else 0, 0)."""
    half = radius * (1 - 1e-3)
    steep = jnp.where(jnp.abs(rays.directions) < 1e-6, 1e-6, rays.directions)
    low, high = (-half - rays.origins) / steep, (half - rays.origins) / steep
    near = jnp.maximum(jnp.max(jnp.minimum(low, high), axis=-1), 0.0)
    far = jnp.min(jnp.maximum(low, high), axis=-1)
    valid = far - near > 0.01
    return jnp.where(valid, near, 0.0), jnp.where(valid, far, 0.0), valid


def render(model: TripoSR, triplane: Float[Array, "3 c h w"], rays: Rays, *, chunk: int = 1024) -> Rendering:
    """March rays through the field, ``chunk`` (static) rays at a time; any leading shape.

    As the official renderer: mid points of equal bins between entry and exit, an opacity with a step of
    1 / samples whatever the metric step, white behind. All rays are marched, those that miss are masked afterwards.
    """
    samples = model.config.samples
    middle = jnp.asarray((np.arange(samples) + 0.5) / samples, jnp.float32)

    def march(ray: Rays) -> Rendering:
        near, far, valid = meet_cube(ray, model.config.radius)
        distance = near * (1 - middle) + far * middle
        points = ray.origins + distance[:, None] * ray.directions
        raw = model.decoder(sample_planes(triplane, points, model.config.radius))
        alpha = 1 - jnp.exp(-_density(model, raw[:, 0]) / samples)
        passed = jnp.cumprod(1 - alpha + 1e-10)
        weight = alpha * jnp.concatenate([jnp.ones(1, jnp.float32), passed[:-1]])
        opacity = jnp.sum(weight)
        rgb = jnp.sum(weight[:, None] * jax.nn.sigmoid(raw[:, 1:]), axis=0) + 1 - opacity
        mean = jnp.sum(weight * distance) / jnp.maximum(opacity, 1e-6)
        return Rendering(
            rgb=jnp.where(valid, rgb, 1.0),
            distance=jnp.where(valid & (opacity > 0.5), mean, 0.0),
            opacity=jnp.where(valid, opacity, 0.0),
        )

    shape = rays.origins.shape[:-1]
    flat = Rays(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3))
    seen = jax.lax.map(march, flat, batch_size=min(chunk, flat.origins.shape[0]))
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), seen)


# --- the published weights --------------------------------------------------------------------------------------------

_same = lambda array: array
_turn = lambda array: array.T
_Layout = Callable[[Any], Any]


def _official(path: str, shape: tuple[int, ...], config: TripoSRConfig) -> tuple[str, tuple[int, ...], _Layout]:
    """Our parameter's path and shape → the official name and shape, and how to lay the official array out as ours."""
    vision = config.vision
    special: dict[str, tuple[str, tuple[int, ...], _Layout]] = {
        "tokenizer.class_token": ("image_tokenizer.model.embeddings.cls_token", (1, 1, *shape), lambda a: a[0, 0]),
        "tokenizer.positions": (
            "image_tokenizer.model.embeddings.position_embeddings",
            (1, *shape),
            lambda a: a[0],
        ),
        "tokenizer.patches.kernel": (
            "image_tokenizer.model.embeddings.patch_embeddings.projection.weight",
            (vision.width, 3, vision.patch, vision.patch),
            lambda a: a.transpose(2, 3, 1, 0).reshape(-1, a.shape[0]),
        ),
        "embeddings": ("tokenizer.embeddings", shape, _same),
        "upsampler.kernel": ("post_processor.upsample.weight", shape, _same),
    }
    if path in special:
        return special[path]
    name = path
    for pattern, official in (
        (r"^tokenizer\.patches\.", "image_tokenizer.model.embeddings.patch_embeddings.projection."),
        (r"^tokenizer\.blocks\.(\d+)\.norm1", r"image_tokenizer.model.encoder.layer.\1.layernorm_before"),
        (r"^tokenizer\.blocks\.(\d+)\.norm2", r"image_tokenizer.model.encoder.layer.\1.layernorm_after"),
        (
            r"^tokenizer\.blocks\.(\d+)\.attention\.output",
            r"image_tokenizer.model.encoder.layer.\1.attention.output.dense",
        ),
        (r"^tokenizer\.blocks\.(\d+)\.attention\.", r"image_tokenizer.model.encoder.layer.\1.attention.attention."),
        (r"^tokenizer\.blocks\.(\d+)\.widen", r"image_tokenizer.model.encoder.layer.\1.intermediate.dense"),
        (r"^tokenizer\.blocks\.(\d+)\.narrow", r"image_tokenizer.model.encoder.layer.\1.output.dense"),
        (r"^tokenizer\.norm", "image_tokenizer.model.layernorm"),
        (r"^backbone\.enter", "backbone.proj_in"),
        (r"^backbone\.leave", "backbone.proj_out"),
        (r"^backbone\.blocks\.(\d+)\.attention(\d)\.query", r"backbone.transformer_blocks.\1.attn\2.to_q"),
        (r"^backbone\.blocks\.(\d+)\.attention(\d)\.key", r"backbone.transformer_blocks.\1.attn\2.to_k"),
        (r"^backbone\.blocks\.(\d+)\.attention(\d)\.value", r"backbone.transformer_blocks.\1.attn\2.to_v"),
        (r"^backbone\.blocks\.(\d+)\.attention(\d)\.output", r"backbone.transformer_blocks.\1.attn\2.to_out.0"),
        (r"^backbone\.blocks\.(\d+)\.widen", r"backbone.transformer_blocks.\1.ff.net.0.proj"),
        (r"^backbone\.blocks\.(\d+)\.narrow", r"backbone.transformer_blocks.\1.ff.net.2"),
        (r"^backbone\.blocks\.", "backbone.transformer_blocks."),
        (r"^upsampler", "post_processor.upsample"),
        # The official list has an activation after every linear layer but the last, hence every second number.
        (r"^decoder\.layers\.(\d+)", lambda m: f"decoder.layers.{2 * int(m[1])}"),
    ):
        name, hits = re.subn(pattern, official, name)
        if hits:
            break
    if name.endswith(".kernel"):
        return name.removesuffix("kernel") + "weight", shape[::-1], _turn
    return re.sub(r"\.scale$", ".weight", name), shape, _same


def _abstract(config: TripoSRConfig) -> TripoSR:
    return nnx.eval_shape(lambda: TripoSR(config, rngs=nnx.Rngs(0)))


def _paths(model: TripoSR) -> dict[tuple[Any, ...], Any]:
    return dict(nnx.to_flat_state(nnx.state(model, nnx.Param)))


def official_shapes(config: TripoSRConfig) -> dict[str, tuple[int, ...]]:
    """Name and shape of every array of the official checkpoint of this size, those that are not used included."""
    shapes = {
        name: shape
        for path, leaf in _paths(_abstract(config)).items()
        for name, shape, _ in [_official(".".join(map(str, path)), tuple(leaf.get_value().shape), config)]
    }
    return shapes | {name: shape(config) for name, shape in _UNUSED.items()}


def load_model(config: TripoSRConfig, weights: Mapping[str, np.ndarray]) -> TripoSR:
    """A model of an official checkpoint's arrays; ValueError names what is missing, left over or misshapen."""
    shapes = official_shapes(config)
    found = {name: tuple(np.shape(array)) for name, array in weights.items()}
    lists = {
        "missing": sorted(shapes.keys() - found.keys()),
        "not known": sorted(found.keys() - shapes.keys()),
        "of another shape": sorted(n for n in shapes.keys() & found.keys() if shapes[n] != found[n]),
    }
    wrong = [
        f"{len(names)} {what} ({', '.join(names[:3])}{', …' * (len(names) > 3)})"
        for what, names in lists.items()
        if names
    ]
    if wrong:
        raise ValueError(f"these weights are not TripoSR of this size: {'; '.join(wrong)}")
    model = _abstract(config)
    state = nnx.state(model, nnx.Param)
    flat = []
    for path, leaf in nnx.to_flat_state(state):
        spot = leaf.get_value()
        name, _, layout = _official(".".join(map(str, path)), tuple(spot.shape), config)
        array = jnp.asarray(layout(np.asarray(weights[name], np.float32)), spot.dtype)
        flat.append((path, leaf.replace(array)))
    nnx.update(model, nnx.from_flat_state(flat))
    return model
