"""ipjax: from one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose, in JAX."""

import importlib
from typing import TYPE_CHECKING, Any

from ipjax.config import AlignConfig as AlignConfig
from ipjax.config import Config as Config
from ipjax.config import DescribeConfig as DescribeConfig
from ipjax.config import MatchConfig as MatchConfig
from ipjax.config import OnboardConfig as OnboardConfig
from ipjax.config import RefineConfig as RefineConfig
from ipjax.config import ScoreConfig as ScoreConfig
from ipjax.features import describe as describe
from ipjax.features import observe as observe
from ipjax.pipeline import estimate as estimate
from ipjax.types import Camera as Camera
from ipjax.types import Patches as Patches
from ipjax.types import PoseEstimate as PoseEstimate
from ipjax.types import Query as Query
from ipjax.types import Similarity as Similarity
from ipjax.types import Surface as Surface
from ipjax.types import Templates as Templates
from ipjax.types import View as View

if TYPE_CHECKING:
    from ipjax.host.drawing import draw as draw
    from ipjax.host.frames import frame as frame
    from ipjax.host.objects import load as load
    from ipjax.host.objects import save as save
    from ipjax.host.onboarding import onboard as onboard
    from ipjax.host.weights import load_encoder as load_encoder

__version__ = "0.1.0"

# What needs OpenCV, MuJoCo or files is imported when it is first used.
_HOST = {
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
