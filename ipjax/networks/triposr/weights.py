"""The published checkpoint: a strict bijection of its keys and our parameters."""

import re
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

from ipjax.networks.triposr.config import TripoSRConfig
from ipjax.networks.triposr.model import TripoSR

# The checkpoint carries the pooler of the vision transformer, whose output the official code throws away.
_UNUSED = {
    "image_tokenizer.model.pooler.dense.weight": lambda c: (c.vision.width, c.vision.width),
    "image_tokenizer.model.pooler.dense.bias": lambda c: (c.vision.width,),
}


_Layout = Callable[[Any], Any]  # the official array → ours
_same = lambda array: array
_transpose = lambda array: array.T


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
        return name.removesuffix("kernel") + "weight", shape[::-1], _transpose
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
