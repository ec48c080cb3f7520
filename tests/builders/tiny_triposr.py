"""A tiny TripoSR of random weights, and what the official code makes of it."""

import functools

import numpy as np
from builders.golden import GOLDEN

from ipjax.networks.triposr.config import TripoSRConfig, VisionConfig
from ipjax.networks.triposr.model import TripoSR
from ipjax.networks.triposr.weights import load_model

TINY = TripoSRConfig(
    vision=VisionConfig(width=24, layers=2, heads=3, hidden=96, patch=16, grid=5),
    image_size=128,
    plane_size=8,
    width=32,
    layers=2,
    heads=2,
    groups=8,
    plane_channels=10,
    decoder_width=16,
    decoder_layers=3,
)


@functools.cache
def read_golden() -> dict[str, np.ndarray]:
    """The official numbers, cut as `golden.make_triposr` says."""
    with np.load(GOLDEN / "triposr_tiny.npz") as arrays:
        return {name: arrays[name] for name in arrays.files}


@functools.cache
def make_model() -> TripoSR:
    return load_model(TINY, read_weights(read_golden()))


def read_weights(golden):
    return {name.removeprefix("w/"): array for name, array in golden.items() if name.startswith("w/")}
