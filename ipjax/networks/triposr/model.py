"""The network: the backbone over triplane tokens, the up-sampler, the decoder, and all of it as `TripoSR`."""

import itertools

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from ipjax.networks.triposr.config import TripoSRConfig
from ipjax.networks.triposr.layers import HIGHEST, Attention, GroupNorm, LayerNorm, Linear, normal_parameter
from ipjax.networks.triposr.vision import VisionTokenizer


class BackboneBlock(nnx.Module):
    """Triplane tokens attend to each other, then to the photo, then pass a gated MLP."""

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
        self.kernel = normal_parameter(rngs, (inputs, outputs, 2, 2), inputs**-0.5, dtype)
        self.bias = nnx.Param(jnp.zeros(outputs, dtype))

    def __call__(self, planes: Float[Array, "3 h w i"]) -> Float[Array, "3 o hh ww"]:
        kernel = self.kernel[...]
        _, height, width, _ = planes.shape
        texels = jnp.einsum(
            "phwi,ioab->pohawb",
            planes.astype(kernel.dtype),
            kernel,
            precision=HIGHEST,
            preferred_element_type=jnp.float32,
        )
        return texels.reshape(3, -1, 2 * height, 2 * width) + self.bias[...].astype(jnp.float32)[:, None, None]


class Decoder(nnx.Module):
    """The three planes' features of a point → raw density and three raw colours; always float32."""

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
        self.embeddings = normal_parameter(rngs, shape, config.width**-0.5, config.dtype)
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


def prepare_image(image: Float[Array, "h w 3"], size: int = 512) -> Float[Array, "s s 3"]:
    """Resize a photo in [0, 1] to a square, with antialiasing, aspect not kept: as the model was trained."""
    return jax.image.resize(image, (size, size, image.shape[2]), "linear", antialias=True, precision=HIGHEST)
