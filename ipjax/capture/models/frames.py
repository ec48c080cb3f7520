"""Frames whose camera is known, as models and labels are made from them."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.cameras import unproject
from ipjax.capture.records import Capture, CaptureError, Trajectory
from ipjax.files.images.depth import read_depth
from ipjax.files.images.opening import read_rgb
from ipjax.transforms import Similarity

UNIT = 0.0001  # metres per number of the depth images that the step depth writes
_STEEP = 4  # slope of a surface against the image, beyond which a step between pixels is one from thing to thing
_NOISE = 0.004  # metres that neighbours of one surface differ by without any slope


@dataclasses.dataclass(frozen=True)
class PosedFrame:
    """Colours, depth in the same pixels, and where the camera stood."""

    name: str
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # along z, metres; 0 = unknown
    usable: Bool[np.ndarray, "h w"]  # not hidden by what moves with the camera
    camera: Float[np.ndarray, "3 3"]  # K
    world_from_camera: Similarity[np.ndarray]  # rigid
    confidence: Float[np.ndarray, "h w"] | None = None  # of the depth, 0 … 1; None = all the same

    @property
    def camera_from_world(self) -> Similarity[np.ndarray]:
        return self.world_from_camera.inverse()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.rgb.shape[1], self.rgb.shape[0]


class CaptureFrames(Sequence[PosedFrame]):
    """The frames of a capture whose poses are known, each read when it is asked for."""

    def __init__(
        self,
        capture: Capture,
        trajectory: Trajectory,
        improved: Path | None = None,
        ignore: Bool[np.ndarray, "h w"] | None = None,
    ):
        """Frames with the depth and confidence that the step depth left in the folder ``improved``, in place of the
        capture's own. ``ignore``: what moves with the camera, beside what the capture says itself.

        Raises:
          CaptureError: capture and trajectory are not of the same frames, or fewer than two have a pose.
        """
        places = {name: index for index, name in enumerate(trajectory.names)}
        missing = [name for name in capture.names if name not in places]
        if missing:
            raise CaptureError(
                f"{capture.folder}: there is no pose of {len(missing)} of its frames, first of {missing[0]}"
            )
        self._capture, self._trajectory, self._improved = capture, trajectory, improved
        self._ignore = ignore
        self._rows = [
            (index, places[name]) for index, name in enumerate(capture.names) if trajectory.registered[places[name]]
        ]
        if len(self._rows) < 2:
            raise CaptureError(f"{capture.folder}: {len(self._rows)} of its frames have a pose; two are needed")

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[PosedFrame]:
        return (self[index] for index in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> PosedFrame: ...

    @overload
    def __getitem__(self, index: slice) -> list[PosedFrame]: ...

    def __getitem__(self, index: int | slice) -> PosedFrame | list[PosedFrame]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place, row = self._rows[index]
        frame = self._capture.read_frame(place)
        depth, confidence = frame.depth, None
        if self._improved is not None:
            depth, confidence = read_improved(self._improved, frame.name)
        if depth is None:
            raise CaptureError(
                f"{self._capture.folder}: frame {frame.name} has no depth in the colours' pixels; "
                "make it with ipjax capture depth"
            )
        poses = self._trajectory.world_from_camera
        pose = poses.take(row)
        usable = frame.usable if self._ignore is None else frame.usable & ~self._ignore
        return PosedFrame(frame.name, frame.rgb, depth, usable, self._capture.camera.to_matrix(), pose, confidence)


def read_improved(work: Path, name: str) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"] | None]:
    """The depth of a frame from ``depth/NAME.png``, in tenths of a millimetre, and how sure it is, from
    ``confidence/NAME.png``, where that is.

    Raises:
      CaptureError: it is not there, or cannot be read.
    """
    try:
        depth = (read_depth(work / "depth" / f"{name}.png") * UNIT).astype(np.float32)
        path = work / "confidence" / f"{name}.png"
        return depth, read_rgb(path)[..., 0].astype(np.float32) / 255 if path.is_file() else None
    except (ValueError, OSError) as error:
        raise CaptureError(str(error)) from None


def trust_depth(frame: PosedFrame) -> Float[np.ndarray, "h w"]:
    """The weight of every pixel's depth: 0 where nothing is known, beside jumps and on what moves with the camera."""
    known = (frame.depth > 0) & frame.usable
    kernel = np.ones((3, 3), np.uint8)
    far = np.where(known, frame.depth, 0).astype(np.float32)
    near = np.where(known, frame.depth, np.float32(1e9)).astype(np.float32)
    spread = cv2.dilate(far, kernel) - cv2.erode(near, kernel)
    steady = known & (spread < 2 * _STEEP * frame.depth / frame.camera[0, 0] + _NOISE)
    weight = steady.astype(np.float32)
    return weight if frame.confidence is None else weight * frame.confidence.astype(np.float32)


def lift(frame: PosedFrame, step: int = 1) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Points of every ``step``-th pixel that is trusted, in world, with their colours."""
    weight = trust_depth(frame)[::step, ::step]
    rows, columns = np.nonzero(weight > 0)
    rows, columns = rows * step, columns * step
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    points = unproject(frame.camera, pixels, frame.depth[rows, columns].astype(np.float64))
    return frame.world_from_camera @ points, frame.rgb[rows, columns]
