"""The frames of a capture as the steps after the poses use them."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from ipjax.capture.models.frames import CaptureFrames
from ipjax.capture.records import Capture, CaptureError, CaptureFrame, ReadFrame, Trajectory
from ipjax.capture.steps.records import Job
from ipjax.capture.trajectories import read_trajectory
from ipjax.files.images.masks import read_mask
from ipjax.files.storage.parsing import read_json


def read_ignored(job: Job) -> Bool[np.ndarray, "h w"] | None:
    """What moves with the camera, as the step pose left it; None = nothing does.

    Raises:
      CaptureError: it is of another size than the frames.
    """
    if not job.has("ignore.png"):
        return None
    ignored = read_mask(job.work / "ignore.png")
    width, height = job.capture.size
    if ignored.shape != (height, width):
        raise CaptureError(f"{job.work / 'ignore.png'}: it is of another size than the frames, {width} × {height}")
    return ignored


@dataclasses.dataclass(frozen=True)
class _Hiding:
    read: ReadFrame
    ignored: Bool[np.ndarray, "h w"]

    def __call__(self, index: int, /) -> CaptureFrame:
        frame = self.read(index)
        return dataclasses.replace(frame, usable=frame.usable & ~self.ignored)


def hide(capture: Capture, ignored: Bool[np.ndarray, "h w"] | None) -> Capture:
    """The capture, its frames without what is ignored in all of them."""
    return capture if ignored is None else dataclasses.replace(capture, read_frame=_Hiding(capture.read_frame, ignored))


def choose_poses(job: Job) -> Trajectory:
    """The refined poses, of the frames whose pose is sure; or of all that have one.

    Raises:
      CaptureError: fewer than two are sure.
    """
    trajectory = read_trajectory(job.work / "refined.json")
    if job.settings.keep_unsure:
        return trajectory
    path = job.work / "refinement.json"
    try:
        names = {str(name) for name in read_json(path)["sure"]}
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(f"{path}: it does not say which poses are sure ({error})") from None
    sure = np.array([name in names for name in trajectory.names])
    if (sure & trajectory.registered).sum() < 2:
        count = int((sure & trajectory.registered).sum())
        raise CaptureError(
            f"{count} of {int(trajectory.registered.sum())} poses are sure, too few for "
            "models; --keep-unsure takes the others, too, at the risk of wrong labels"
        )
    return dataclasses.replace(trajectory, registered=trajectory.registered & sure)


def open_frames(job: Job) -> CaptureFrames:
    """The frames with their best poses and depth, without what moves with the camera."""
    improved = job.work if job.has("depth") else None
    return CaptureFrames(job.capture, choose_poses(job), improved, read_ignored(job))
