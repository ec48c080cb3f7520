"""The frames of a capture as the steps after the poses use them."""

import dataclasses

import numpy as np

from ipjax.capture.models.frames import CaptureFrames
from ipjax.capture.moving import read_ignored
from ipjax.capture.records import CaptureError, Trajectory
from ipjax.capture.steps.records import Job
from ipjax.capture.trajectories import read_trajectory
from ipjax.files.storage.parsing import read_json


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
    return CaptureFrames(job.capture, choose_poses(job), improved, read_ignored(job.work, job.capture))
