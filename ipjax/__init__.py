"""ipjax: from one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose, in JAX."""

import importlib
from typing import TYPE_CHECKING, Any

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
from ipjax.features import describe, observe
from ipjax.pipeline import estimate
from ipjax.types import Camera, Patches, PoseEstimate, Query, Similarity, Surface, Templates, View

if TYPE_CHECKING:
    from ipjax.host.drawing import draw
    from ipjax.host.frames import frame
    from ipjax.host.objects import compact, load, save
    from ipjax.host.onboarding import onboard
    from ipjax.host.weights import load_encoder

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
    "save",
]

# What needs OpenCV, MuJoCo or files is imported when it is first used.
_HOST = {
    "compact": "objects",
    "draw": "drawing",
    "frame": "frames",
    "load": "objects",
    "load_encoder": "weights",
    "onboard": "onboarding",
    "save": "objects",
}


def __getattr__(name: str) -> Any:
    if name in _HOST:
        return getattr(importlib.import_module(f"ipjax.host.{_HOST[name]}"), name)
    raise AttributeError(f"module 'ipjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOST])
