"""DINOv2 in Flax (nnx): the vision transformer that describes patches, from ViT-S to ViT-g, with and without registers.

Follows the official code (https://github.com/facebookresearch/dinov2, ``dinov2/models/vision_transformer.py``; Oquab et
al. 2023, Darcet et al. 2023 for the registers), checked against its output to 2e-5. Attribute names are the official
parameter names, so that loading weights is a renaming without exceptions.

A model is a pytree: pass it to ``jax.jit`` as an argument (``jax.jit(encode)(encoder, images)``), never close over it:
its weights would become constants of the graph. ``nnx.split`` and ``nnx.merge`` work as on any other nnx module.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from ipjax.records import UNNAMED

_MEAN = (0.485, 0.456, 0.406)  # ImageNet, RGB
_DEVIATION = (0.229, 0.224, 0.225)
_HIGHEST = jax.lax.Precision.HIGHEST  # true float32 on every device; for speed there is bfloat16


@dataclasses.dataclass(frozen=True)
class DinoV2Config:
    """The shape of one vision transformer; everything in it is static."""

    width: int = 384  # channels
    depth: int = 12  # blocks
    heads: int = 6
    hidden: int = 1536  # channels inside the feed-forward
    swiglu: bool = False  # gated feed-forward (ViT-g) instead of GELU
    registers: int = 0
    patch: int = 14  # pixels
    grid: int = 37  # patches along a side of the images it was trained on
    antialias: bool = False  # how the position embedding is resized: see position_embedding
    offset: float = 0.1
    dtype: str = "float32"  # of the products; sums over channels and the residual stream stay in float32

    def __post_init__(self):
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of the {self.heads} heads")
        if self.dtype not in ("float32", "bfloat16"):
            raise ValueError(f"dtype is float32 or bfloat16, not {self.dtype!r}")


_SIZES = {
    "vits14": DinoV2Config(width=384, depth=12, heads=6, hidden=1536),
    "vitb14": DinoV2Config(width=768, depth=12, heads=12, hidden=3072),
    "vitl14": DinoV2Config(width=1024, depth=24, heads=16, hidden=4096),
    "vitg14": DinoV2Config(width=1536, depth=40, heads=24, hidden=4096, swiglu=True),
}
PRESETS: dict[str, DinoV2Config] = {
    **_SIZES,
    **{
        f"{name}_reg": dataclasses.replace(config, registers=4, antialias=True, offset=0.0)
        for name, config in _SIZES.items()
    },
}


def find_preset(name: str, dtype: str = "float32") -> DinoV2Config:
    """The config of a published model, ``vits14`` … ``vitg14``, or ``vits14_reg`` … with registers; else ValueError."""
    if name not in PRESETS:
        raise ValueError(f"unknown DINOv2 preset {name!r}; known: {', '.join(PRESETS)}")
    return dataclasses.replace(PRESETS[name], dtype=dtype)


class Tokens(NamedTuple):
    """What one block put out, for each image."""

    class_token: Float[Array, "*b c"]
    registers: Float[Array, "*b r c"]  # r = 0 without registers
    patches: Float[Array, "*b h w c"]


def normalise(images: Float[Array, "*b h w 3"]) -> Float[Array, "*b h w 3"]:
    """RGB in [0, 1] → ImageNet mean 0 and deviation 1 per channel, as DINOv2 was trained."""
    mean, deviation = jnp.asarray(_MEAN, images.dtype), jnp.asarray(_DEVIATION, images.dtype)
    return (images - mean) / deviation


def _cubic(x: np.ndarray, a: float) -> np.ndarray:
    """Keys' cubic convolution kernel (1981); a = −¾ in PyTorch and OpenCV, −½ in PIL and PyTorch's antialiasing."""
    x = np.abs(x)
    near = ((a + 2) * x - (a + 3)) * x**2 + 1
    far = a * (((x - 5) * x + 8) * x - 4)
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


def resize_weights(size: int, native: int, *, antialias: bool, offset: float) -> Float[np.ndarray, "size native"]:
    """The matrix [size, native] that resizes one axis as the official code (PyTorch's bicubic interpolation) does.

    Without antialiasing: a = −¾, the scale is (size + offset) / native rather than size / native, and samples beyond
    the border repeat it. With antialiasing: a = −½, the kernel widens when shrinking, and samples beyond the border
    have no weight.
    """
    # Coordinates in float32, as PyTorch computes them: 1e-5 closer to its output than exact ones.
    scale = np.float32(native / (size + offset))  # source samples per target sample
    centre = (np.arange(size, dtype=np.float32) + np.float32(0.5)) * scale - np.float32(0.5)
    weights = np.zeros((size, native))
    if antialias:
        width = max(float(scale), 1.0)
        weights = _cubic((np.arange(native) - centre[:, None]) / width, -0.5)
        return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    first = np.floor(centre).astype(int)
    for tap in range(-1, 3):
        source = np.clip(first + tap, 0, native - 1)
        np.add.at(weights, (np.arange(size), source), _cubic(first + tap - centre, -0.75))
    return weights.astype(np.float32)


def position_embedding(
    embedding: Float[Array, "n c"], grid: tuple[int, int], *, antialias: bool, offset: float
) -> Float[Array, "h w c"]:
    """A square position embedding (its n patches row by row) resized to ``grid`` = (rows, columns).

    Official ``interpolate_pos_encoding``: untouched at its own size, else separable bicubic; see ``resize_weights``.
    """
    native = math.isqrt(embedding.shape[0])
    if native * native != embedding.shape[0]:
        raise ValueError(f"the position embedding has {embedding.shape[0]} patches, which is not a square number")
    square = embedding.reshape(native, native, -1)
    if grid == (native, native):
        return square
    rows, columns = (jnp.asarray(resize_weights(n, native, antialias=antialias, offset=offset)) for n in grid)
    return jnp.einsum("hi,wj,ijc->hwc", rows, columns, square, precision=_HIGHEST)


def _random(shape: tuple[int, ...], rngs: nnx.Rngs | None, dtype: str = "float32") -> nnx.Param:
    if rngs is None:  # weights will be filled in; drawing them first takes seconds
        return nnx.Param(jnp.zeros(shape, dtype))
    return nnx.Param(0.02 * jax.random.truncated_normal(rngs.params(), -2.0, 2.0, shape, dtype))


class Linear(nnx.Module):
    """A linear layer: products in the config's dtype, their sum in float32."""

    def __init__(self, inputs: int, outputs: int, config: DinoV2Config, rngs: nnx.Rngs | None):
        self.kernel = _random((inputs, outputs), rngs, config.dtype)
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32))

    def __call__(self, x: Float[Array, "*n i"]) -> Float[Array, "*n o"]:
        kernel = self.kernel[...]
        product = jnp.matmul(x.astype(kernel.dtype), kernel, precision=_HIGHEST, preferred_element_type=jnp.float32)
        return product + self.bias[...]


class LayerNorm(nnx.Module):
    """Normalises each token over its channels; epsilon 1e-6, as DINOv2 has it."""

    def __init__(self, config: DinoV2Config):
        self.scale = nnx.Param(jnp.ones(config.width, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(config.width, jnp.float32))

    def __call__(self, x: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        centred = x - jnp.mean(x, axis=-1, keepdims=True)
        variance = jnp.mean(centred**2, axis=-1, keepdims=True)
        return centred * jax.lax.rsqrt(variance + 1e-6) * self.scale[...] + self.bias[...]


class Scale(nnx.Module):
    """LayerScale: one learnt factor per channel."""

    def __init__(self, config: DinoV2Config):
        self.gamma = nnx.Param(jnp.ones(config.width, jnp.float32))

    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        return x * self.gamma[...]


class Attention(nnx.Module):
    """Multi-head self-attention; the softmax is in float32."""

    def __init__(self, config: DinoV2Config, rngs: nnx.Rngs | None):
        self.heads = config.heads
        self.dtype = config.dtype
        self.qkv = Linear(config.width, 3 * config.width, config, rngs)
        self.proj = Linear(config.width, config.width, config, rngs)

    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        b, n, c = x.shape
        split = self.qkv(x).astype(self.dtype).reshape(b, n, 3, self.heads, c // self.heads)
        query, key, value = jnp.moveaxis(split, (2, 3), (0, 2))
        query = query * (c // self.heads) ** -0.5
        logits = jnp.einsum("bhnd,bhmd->bhnm", query, key, precision=_HIGHEST, preferred_element_type=jnp.float32)
        weights = jax.nn.softmax(logits, axis=-1).astype(self.dtype)
        mixed = jnp.einsum("bhnm,bhmd->bhnd", weights, value, precision=_HIGHEST)
        return self.proj(jnp.moveaxis(mixed, 1, 2).reshape(b, n, c))


class FeedForward(nnx.Module):
    """Two layers with an exact GELU between."""

    def __init__(self, config: DinoV2Config, rngs: nnx.Rngs | None):
        self.fc1 = Linear(config.width, config.hidden, config, rngs)
        self.fc2 = Linear(config.hidden, config.width, config, rngs)

    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        inner = self.fc1(x)
        # Φ through erf, not erfc as in jax.nn.gelu: twice as fast on CPU, and no different where it matters (1e-7).
        return self.fc2(0.5 * inner * (1.0 + jax.lax.erf(inner * 2**-0.5)))


class GatedFeedForward(nnx.Module):
    """SwiGLU: half of the inner channels gate the other half (ViT-g)."""

    def __init__(self, config: DinoV2Config, rngs: nnx.Rngs | None):
        self.w12 = Linear(config.width, 2 * config.hidden, config, rngs)
        self.w3 = Linear(config.hidden, config.width, config, rngs)

    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        gate, inner = jnp.split(self.w12(x), 2, axis=-1)
        return self.w3(jax.nn.silu(gate) * inner)


class Block(nnx.Module):
    """One transformer block; the residual stream is float32."""

    def __init__(self, config: DinoV2Config, rngs: nnx.Rngs | None):
        self.norm1 = LayerNorm(config)
        self.attn = Attention(config, rngs)
        self.ls1 = Scale(config)
        self.norm2 = LayerNorm(config)
        self.mlp = (GatedFeedForward if config.swiglu else FeedForward)(config, rngs)
        self.ls2 = Scale(config)

    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbedding(nnx.Module):
    """Non-overlapping patches, each through one linear layer."""

    def __init__(self, config: DinoV2Config, rngs: nnx.Rngs | None):
        self.patch = config.patch
        self.proj = Linear(config.patch**2 * 3, config.width, config, rngs)

    def __call__(self, images: Float[Array, "b H W 3"]) -> Float[Array, "b h w c"]:
        b, height, width, _ = images.shape
        size = self.patch
        patches = images.reshape(b, height // size, size, width // size, size, 3)
        return self.proj(jnp.moveaxis(patches, 3, 2).reshape(b, height // size, width // size, -1))


class DinoV2(nnx.Module):
    """The vision transformer: random when given ``rngs``, else zeros that ``ipjax.files.weights`` fills."""

    def __init__(self, config: DinoV2Config, *, rngs: nnx.Rngs | None = None):
        self.config = config
        self.cls_token = _random((1, 1, config.width), rngs)
        self.pos_embed = _random((1, 1 + config.grid**2, config.width), rngs)
        if config.registers:
            self.register_tokens = _random((1, config.registers, config.width), rngs)
        self.patch_embed = PatchEmbedding(config, rngs)
        self.blocks = nnx.List([Block(config, rngs) for _ in range(config.depth)])
        self.norm = LayerNorm(config)

    def __call__(self, images: Float[Array, "*b h w 3"]) -> Tokens:
        """The last block's tokens under the final LayerNorm, of RGB images in [0, 1]; see ``tokens``."""
        return tokens(self, images, (self.config.depth - 1,))[0]


def embed(model: DinoV2, images: Float[Array, "b h w 3"]) -> Float[Array, "b n c"]:
    """The tokens that enter the first block (class, registers, patches) of ImageNet-normalised images."""
    config = model.config
    patches = model.patch_embed(images)
    b, rows, columns, c = patches.shape
    embedding = model.pos_embed[...]
    where = position_embedding(embedding[0, 1:], (rows, columns), antialias=config.antialias, offset=config.offset)
    parts = [(model.cls_token[...] + embedding[:, :1]), (patches + where).reshape(b, rows * columns, c)]
    if config.registers:  # after the position embedding, which registers do not get
        parts.insert(1, model.register_tokens[...])
    return jnp.concatenate([jnp.broadcast_to(part, (b, *part.shape[1:])) for part in parts], axis=1)


def tokens(
    model: DinoV2,
    images: Float[Array, "*b h w 3"],
    blocks: tuple[int, ...],
    norm: bool = True,
    *,
    normalised: bool = False,
) -> tuple[Tokens, ...]:
    """The tokens that the given blocks put out, in the order asked for; no block after the last of them is computed.

    ``images`` is RGB in [0, 1], one or a batch, with sides that are multiples of the patch (14), else ValueError; with
    ``normalised`` it is taken as it is (see ``normalise``). ``blocks`` counts from 0, and from the end when negative.
    ``norm`` puts the final LayerNorm over each, as the official ``get_intermediate_layers(norm=True)`` does. The tokens
    are float32, whatever the model's dtype.
    """
    config = model.config
    if images.ndim < 3 or images.shape[-1] != 3:
        raise ValueError(f"an image is [height, width, 3 channels], or a batch of such, not {images.shape}")
    *batch, height, width, _ = images.shape
    if height % config.patch or width % config.patch or not height or not width:
        raise ValueError(f"the image is {height} × {width}; its sides must be multiples of {config.patch} pixels")
    for block in blocks:
        if not -config.depth <= block < config.depth:
            raise ValueError(f"there is no block {block}: the model has {config.depth}")
    wanted = [block % config.depth for block in blocks]
    x = images.reshape(-1, height, width, 3)
    x = embed(model, x if normalised else normalise(x))
    rows, columns = height // config.patch, width // config.patch
    found = {}
    for index in range(max(wanted, default=-1) + 1):
        x = model.blocks[index](x)
        if index in wanted:
            out = model.norm(x) if norm else x
            out = out.reshape(*batch, *out.shape[1:])
            start = 1 + config.registers
            patches = out[..., start:, :].reshape(*batch, rows, columns, config.width)
            found[index] = Tokens(out[..., 0, :], out[..., 1:start, :], patches)
    return tuple(found[index] for index in wanted)


class Encoder(nnx.Module):
    """A model, the block whose patch tokens serve as features, and a name for the two. Made by ``load_encoder``."""

    def __init__(self, model: DinoV2, block: int, identity: str = UNNAMED):
        if not 0 <= block < model.config.depth:
            raise ValueError(f"there is no block {block}: the model has {model.config.depth}")
        self.model = model
        self.block = block  # from 0
        self.identity = identity  # what an object file remembers: preset, block, norm, dtype, sha256 of the weights

    @property
    def patch(self) -> int:
        """The side of a patch in pixels."""
        return self.model.config.patch

    @property
    def channels(self) -> int:
        """The length of a feature."""
        return self.model.config.width

    def __call__(self, images: Float[Array, "*b h w 3"]) -> Float[Array, "*b hp wp c"]:
        """See ``encode``."""
        return encode(self, images)


def encode(encoder: Encoder, images: Float[Array, "*b h w 3"]) -> Float[Array, "*b hp wp c"]:
    """RGB in [0, 1] → one unit feature per patch: the chosen block's patch tokens under the final LayerNorm.

    Float32; ``hp`` and ``wp`` are the image's sides divided by ``encoder.patch``, of which they must be multiples.
    """
    (out,) = tokens(encoder.model, images, (encoder.block,))
    squared = jnp.sum(out.patches**2, axis=-1, keepdims=True)
    return out.patches * jax.lax.rsqrt(jnp.maximum(squared, 1e-24))
