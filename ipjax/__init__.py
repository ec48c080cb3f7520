"""ipjax: from one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose, in JAX.

``import ipjax`` loads nothing but this file: every name is imported from its module when it is first used.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipjax.config import (
        AlignConfig,
        ConfidenceConfig,
        Config,
        DescribeConfig,
        MatchConfig,
        OnboardConfig,
        RefineConfig,
        ScoreConfig,
    )
    from ipjax.estimation.features import describe, observe
    from ipjax.estimation.pipeline import estimate
    from ipjax.files.objects.loading import load
    from ipjax.files.objects.saving import save
    from ipjax.files.weights.encoder import load_encoder
    from ipjax.inference.batching import compact, pad_templates
    from ipjax.inference.drawing import draw
    from ipjax.inference.frames import frame
    from ipjax.onboarding.mesh import onboard
    from ipjax.records import Camera, Patches, PoseEstimate, Query, Surface, Templates, View
    from ipjax.transforms import Similarity

__version__ = "0.1.0"
__all__ = [
    "AlignConfig",
    "Camera",
    "ConfidenceConfig",
    "Config",
    "DescribeConfig",
    "MatchConfig",
    "OnboardConfig",
    "Patches",
    "PoseEstimate",
    "Query",
    "RefineConfig",
    "ScoreConfig",
    "Similarity",
    "Surface",
    "Templates",
    "View",
    "compact",
    "describe",
    "draw",
    "estimate",
    "frame",
    "load",
    "load_encoder",
    "observe",
    "onboard",
    "pad_templates",
    "save",
]

# Where each of them is.
_HOMES = {
    "config": (
        "AlignConfig",
        "ConfidenceConfig",
        "Config",
        "DescribeConfig",
        "MatchConfig",
        "OnboardConfig",
        "RefineConfig",
        "ScoreConfig",
    ),
    "estimation.features": ("describe", "observe"),
    "inference.drawing": ("draw",),
    "inference.frames": ("frame",),
    "files.objects.loading": ("load",),
    "files.objects.saving": ("save",),
    "inference.batching": ("compact", "pad_templates"),
    "onboarding.mesh": ("onboard",),
    "files.weights.encoder": ("load_encoder",),
    "estimation.pipeline": ("estimate",),
    "records": ("Camera", "Patches", "PoseEstimate", "Query", "Surface", "Templates", "View"),
    "transforms": ("Similarity",),
}
_HOME = {name: f"ipjax.{module}" for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name.isidentifier() and not name.startswith("_") and importlib.util.find_spec(f"ipjax.{name}") is not None:
        return importlib.import_module(f"ipjax.{name}")
    raise AttributeError(f"module 'ipjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
