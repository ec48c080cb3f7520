"""The settings of a run from a capture to a data set."""

import dataclasses

from ipjax.capture.models.making import ModelConfig
from ipjax.capture.models.separation import Hint
from ipjax.capture.poses.initial import Method


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """What a person may choose; the defaults are what most captures want."""

    method: Method = "auto"  # of the first poses
    board: str | None = None  # that lies in the scene, as `parse_board` reads it
    seed: int = 0
    find_gripper: bool = True  # look for what moves with the camera
    keep_unsure: bool = False  # make models and labels also of frames whose pose is not sure
    depth_mode: str = "solve"  # of the depth, as `make_depth` has it
    hints: tuple[Hint, ...] = ()  # which objects there are, as far as a person says so
    support: Hint | None = None  # a pixel of what the objects stand on
    models: ModelConfig = dataclasses.field(default_factory=ModelConfig)
