"""What the steps of a capture hand to each other.

A capture is one RGB-D camera led around a scene that stands still. ``world`` is the frame in which the camera's poses
are told; its origin and axes are whatever the poses' source made them. Everything is in metres and OpenCV's camera
axes, with the first pixel's centre at (0, 0).
"""

import dataclasses
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ipjax.records import Camera
from ipjax.transforms import Similarity


class CaptureError(ValueError):
    """A capture that cannot be used: one sentence that says what was found and what to do."""


@dataclasses.dataclass(frozen=True)
class CaptureFrame:
    """One frame, as the camera gave it."""

    name: str  # of its files, without their endings
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"] | None  # along z, metres, registered to the colours; 0 = unknown; None = not given
    raw_depth: Float[np.ndarray, "hd wd"] | None  # as the depth camera saw it, in its own pixels; None = not given
    usable: Bool[np.ndarray, "h w"]  # not hidden by what moves with the camera (gripper, hand)


@runtime_checkable
class ReadFrame(Protocol):
    """How a form of captures reads one of its frames."""

    def __call__(self, index: int, /) -> CaptureFrame: ...


@dataclasses.dataclass(frozen=True)
class Capture:
    """A capture on disc. Its frames are read when asked for."""

    folder: Path
    form: str  # "frames", "tum", "numbered", "bop": the layout that was recognised
    names: tuple[str, ...]  # of the frames, in the order of the capture
    camera: Camera  # of the colour images, without distortion
    size: tuple[int, int]  # of the colour images: width, height, pixels
    read_frame: ReadFrame
    depth_camera: Camera | None = None  # of the raw depth images; None = there are none
    depth_size: tuple[int, int] | None = None  # of the raw depth images: width, height, pixels
    colour_from_depth: Similarity[np.ndarray] | None = None  # the factory's, rigid; None = not known
    world_from_camera: Similarity[np.ndarray] | None = None  # of every frame, rigid, where poses were given
    notes: tuple[str, ...] = ()  # what the reader decided or left out, a sentence each

    def __len__(self) -> int:
        return len(self.names)


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Where the camera stood, frame by frame."""

    names: tuple[str, ...]  # of all frames of the capture
    world_from_camera: Similarity[np.ndarray]  # leading axis: all frames; rigid, doubles; identity where not known
    registered: Bool[np.ndarray, " n"]  # whether the frame's pose is known
    source: str  # in words: "structure from motion", "given", "board", "refined"
    # Of rotation (rad) and translation (m) about the camera, along its axes, in that order; None = not known.
    covariance: Float[np.ndarray, "n 6 6"] | None = None
    scale: float | None = None  # metres per unit of what the poses were found in, by depth; None = metric without it
    agreement: float | None = None  # share of the depth's votes that agree on that scale; None = there was no vote

    def __len__(self) -> int:
        return len(self.names)


@dataclasses.dataclass(frozen=True)
class Tracks:
    """Points of the scene that were recognised in several frames: one row an observation, sorted by track, then frame.

    No frame sees a track twice, and every track is seen by two frames or more.
    """

    frame: Int[np.ndarray, " m"]  # index into the names of the capture
    track: Int[np.ndarray, " m"]  # 0 … count − 1
    pixel: Float[np.ndarray, "m 2"]  # (x, y), pixels of the colour image
    depth: Float[np.ndarray, " m"]  # along z, metres, as the frame's depth image has it there; 0 = unknown
    count: int  # of tracks

    def __len__(self) -> int:
        return self.count
