"""Parameters of DINOv2 by their official names, and the Flax model made of them: a strict bijection of names.

Nothing may be left over on either side, except ``mask_token``, which only training needs.
"""

import re

import jax.numpy as jnp
import numpy as np
from flax import nnx

from ipjax.files.weights.catalogue import WeightsError
from ipjax.networks.dinov2 import PRESETS, DinoV2, DinoV2Config


def official_name(path: tuple[object, ...]) -> str:
    """The official name of the parameter at ``path`` in the nnx model: blocks.0.attn.qkv.kernel → ….weight."""
    *owner, leaf = map(str, path)
    return ".".join([*owner, {"kernel": "weight", "scale": "weight"}.get(leaf, leaf)])


# The names of transformers (models/dinov2, models/dinov2_with_registers), before and since its ViT attention was
# renamed (https://github.com/huggingface/transformers/pull/46266): query → q_proj, output.dense → o_proj.
_HUGGING_FACE_NAMES = [
    (re.compile(pattern), name)
    for pattern, name in (
        (r"embeddings\.(cls_token|mask_token|register_tokens)", r"\1"),
        (r"embeddings\.position_embeddings", "pos_embed"),
        (r"embeddings\.patch_embeddings\.projection\.(weight|bias)", r"patch_embed.proj.\1"),
        (r"layernorm\.(weight|bias)", r"norm.\1"),
        (r"encoder\.layer\.(\d+)\.(norm[12])\.(weight|bias)", r"blocks.\1.\2.\3"),
        (r"encoder\.layer\.(\d+)\.layer_scale([12])\.lambda1", r"blocks.\1.ls\2.gamma"),
        (r"encoder\.layer\.(\d+)\.mlp\.(fc[12])\.(weight|bias)", r"blocks.\1.mlp.\2.\3"),
        (r"encoder\.layer\.(\d+)\.mlp\.weights_in\.(weight|bias)", r"blocks.\1.mlp.w12.\2"),
        (r"encoder\.layer\.(\d+)\.mlp\.weights_out\.(weight|bias)", r"blocks.\1.mlp.w3.\2"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:output\.dense|o_proj)\.(weight|bias)", r"blocks.\1.attn.proj.\2"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:attention\.query|q_proj)\.(weight|bias)", r"blocks.\1.attn.qkv.\2#0"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:attention\.key|k_proj)\.(weight|bias)", r"blocks.\1.attn.qkv.\2#1"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:attention\.value|v_proj)\.(weight|bias)", r"blocks.\1.attn.qkv.\2#2"),
    )
]


def rename(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Hugging Face's names → the official ones, queries, keys and values joined; official names pass unchanged.

    A name of neither scheme passes unchanged, and `build_model` refuses it; WeightsError when two names mean the same
    parameter.
    """
    renamed: dict[str, np.ndarray] = {}
    for name, tensor in tensors.items():
        official = next((p.sub(to, name) for p, to in _HUGGING_FACE_NAMES if p.fullmatch(name)), name)
        if official in renamed:
            raise WeightsError(f"the file holds {official} twice")
        renamed[official] = tensor
    for joined in [name.removesuffix("#0") for name in renamed if name.endswith("#0")]:
        parts = [renamed.get(f"{joined}#{part}") for part in range(3)]
        if joined not in renamed and all(part is not None for part in parts):
            renamed[joined] = np.concatenate([renamed.pop(f"{joined}#{part}") for part in range(3)])
    return renamed


def abstract_model(config: DinoV2Config) -> DinoV2:
    """The model with shapes in the place of arrays; costs no memory."""
    return nnx.eval_shape(lambda: DinoV2(config))


def official_shapes(config: DinoV2Config) -> dict[str, tuple[int, ...]]:
    """What an official file of this model holds, apart from mask_token: names and shapes, in PyTorch's layout."""
    shapes = {}
    for parameter, value in nnx.to_flat_state(nnx.state(abstract_model(config))):
        name, shape = official_name(parameter), tuple(value.shape)
        if name == "patch_embed.proj.weight":
            shape = (config.width, 3, config.patch, config.patch)
        elif parameter[-1] == "kernel":
            shape = shape[::-1]
        shapes[name] = shape
    return shapes


def build_model(config: DinoV2Config, tensors: dict[str, np.ndarray]) -> DinoV2:
    """The model with ``tensors`` (official names and layouts, any float type) as its parameters.

    Raises WeightsError when a name is missing, left over, or has another shape; only ``mask_token`` may be ignored.
    """
    model = abstract_model(config)
    parameters = {official_name(parameter): (parameter, v) for parameter, v in nnx.to_flat_state(nnx.state(model))}
    given = {name: tensor for name, tensor in tensors.items() if name != "mask_token"}
    missing, extra = sorted(set(parameters) - set(given)), sorted(set(given) - set(parameters))
    if missing or extra:
        parts = [
            f"{len(names)} {what} ({', '.join(names[:3])}{' …' if len(names) > 3 else ''})"
            for what, names in (("missing", missing), ("unknown", extra))
            if names
        ]
        raise WeightsError(f"the weights do not fit the model: {' and '.join(parts)}")
    filled = []
    for name, (parameter, value) in parameters.items():
        tensor = np.asarray(given[name])
        expected = tuple(value.shape)
        if name == "patch_embed.proj.weight":
            expected = (config.width, 3, config.patch, config.patch)
        elif parameter[-1] == "kernel":
            expected = expected[::-1]
        if tensor.shape != expected:
            raise WeightsError(f"the weights do not fit the model: {name} is {tensor.shape}, expected {expected}")
        if not np.issubdtype(tensor.dtype, np.floating) and tensor.dtype != jnp.bfloat16:
            raise WeightsError(f"the weights do not fit the model: {name} holds {tensor.dtype}, not floats")
        tensor = tensor.astype(np.float32)
        if not np.isfinite(tensor).all():
            raise WeightsError(f"the weights are damaged: {name} holds values that are not finite")
        if parameter[-1] == "kernel":  # PyTorch: [out, in], and [out, 3, patch, patch] for the patch embedding
            tensor = np.ascontiguousarray(np.moveaxis(tensor, 1, -1).reshape(tensor.shape[0], -1).T)
        filled.append((parameter, value.replace(jnp.asarray(tensor.astype(value.dtype)))))
    nnx.update(model, nnx.from_flat_state(filled))
    return model


def guess_preset(tensors: dict[str, np.ndarray]) -> str:
    """The preset whose width, depth and registers the tensors (official names) have; else WeightsError."""
    if "cls_token" not in tensors:
        raise WeightsError("the file holds no DINOv2 weights: it has no cls_token")
    width = tensors["cls_token"].shape[-1] if tensors["cls_token"].ndim else 0
    registers = int(np.prod(tensors["register_tokens"].shape[:-1])) if "register_tokens" in tensors else 0
    depth = 1 + max((int(name.split(".")[1]) for name in tensors if re.match(r"blocks\.\d+\.", name)), default=-1)
    for name, config in PRESETS.items():
        if (config.width, config.depth, config.registers) == (width, depth, registers):
            return name
    raise WeightsError(f"no DINOv2 preset has width {width}, depth {depth} and {registers} registers")
