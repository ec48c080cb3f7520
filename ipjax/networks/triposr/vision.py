"""The image tokenizer: DINO ViT, a photo to tokens."""

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from ipjax.networks.dinov2 import normalise, position_embedding
from ipjax.networks.triposr.config import VisionConfig
from ipjax.networks.triposr.layers import Attention, LayerNorm, Linear, normal_parameter


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
        self.class_token = normal_parameter(rngs, (config.width,), 0.02, dtype)
        self.positions = normal_parameter(rngs, (1 + config.grid**2, config.width), 0.02, dtype)
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


def interpolate_positions(positions: Float[Array, "n c"], side: int) -> Float[Array, "m c"]:
    """Position embeddings for ``side`` × ``side`` patches; the class token's stays (modeling_vit.py, 4.35).

    The +0.1 in the scale is that of the transformers library up to 4.44, with which the checkpoint was trained.
    """
    grid = position_embedding(positions[1:], (side, side), antialias=False, offset=0.1)
    return jnp.concatenate([positions[:1], grid.reshape(side * side, -1)])
