"""Layers that the image tokenizer and the backbone share: products in the weights' precision, sums in float32."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

HIGHEST = jax.lax.Precision.HIGHEST


def normal_parameter(rngs: nnx.Rngs, shape: tuple[int, ...], spread: float, dtype: str) -> nnx.Param:
    """A parameter drawn from a normal distribution around 0 with the standard deviation ``spread``."""
    return nnx.Param((spread * jax.random.normal(rngs.params(), shape, jnp.float32)).astype(dtype))


class Linear(nnx.Module):
    """Products in the weights' precision, sums in float32."""

    def __init__(self, inputs: int, outputs: int, *, bias: bool = True, dtype: str, rngs: nnx.Rngs):
        self.kernel = normal_parameter(rngs, (inputs, outputs), inputs**-0.5, dtype)
        self.bias = nnx.Param(jnp.zeros(outputs, dtype)) if bias else None

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        kernel = self.kernel[...]
        y = jnp.matmul(x.astype(kernel.dtype), kernel, precision=HIGHEST, preferred_element_type=jnp.float32)
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
        options: dict[str, Any] = dict(precision=HIGHEST, preferred_element_type=jnp.float32)
        logits = jnp.einsum("hnk,hmk->hnm", q, k, **options) * q.shape[-1] ** -0.5
        weights = jax.nn.softmax(logits, axis=-1).astype(dtype)
        mixed = jnp.einsum("hnm,hmk->hnk", weights, v, **options)
        return self.output(mixed.transpose(1, 0, 2).reshape(x.shape[0], -1))
