"""The metric scale of a reconstruction: every observed point with a measured depth votes for measured over own depth.

A wrong reconstruction shows here: its depths are not those that were measured, whatever the scale, and the votes
scatter. That refuses what no residual of its own would.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ipjax.capture.poses.structure import Structure
from ipjax.capture.records import CaptureError, Trajectory
from ipjax.files.wording import abbreviate
from ipjax.transforms import Similarity

TOLERANCE = 0.02  # of the scale, within which a vote agrees: the noise of depth and of triangulated points
LEAST_SHARE = 0.5  # of the votes that must agree
FEWEST_VOTES = 50
FEWEST_FRAMES = 3
LEAST_REGISTERED = 0.5  # of all frames


@dataclasses.dataclass(frozen=True)
class Scale:
    """What the votes say."""

    value: float  # metres per unit
    share: float  # of the votes that agree
    votes: int
    agreeing: Bool[np.ndarray, " m"]  # of all that were asked; false where one has no vote


def vote(measured: Float[np.ndarray, " m"], own: Float[np.ndarray, " m"], tolerance: float = TOLERANCE) -> Scale | None:
    """The scale that most votes agree on, and then the median of those; None where fewer than two vote.

    RANSAC with every vote as the hypothesis once: of one number that is a window over the sorted votes.

    Args:
      measured: depths in metres; 0 = unknown.
      own: depths of the same points in the reconstruction's unit.
    """
    voting = (measured > 0) & (own > 0)
    values = np.log(measured[voting] / own[voting])
    if len(values) < 2:
        return None
    ordered, width = np.sort(values), 2 * np.log1p(tolerance)
    ends = np.searchsorted(ordered, ordered + width, side="right")
    first = int((ends - np.arange(len(ordered))).argmax())
    middle = np.median(ordered[first : ends[first]])
    for _ in range(5):  # centred on what agrees, not on the window that was found
        middle = np.median(ordered[np.abs(ordered - middle) <= width / 2])
    agreeing = np.zeros(len(measured), bool)
    agreeing[voting] = np.abs(values - middle) <= width / 2
    return Scale(float(np.exp(middle)), float(agreeing.sum() / len(values)), len(values), agreeing)


def make_metric(names: Sequence[str], structure: Structure) -> tuple[Trajectory, Structure]:
    """The reconstruction in metres.

    A frame of whose votes fewer than half agree with the others is not registered: its pose is wrong.

    Raises:
      CaptureError: too few frames are registered, or too few votes are cast or agree: one sentence that says which.
    """
    check_registered(names, structure.registered)
    arms = structure.points[structure.point] - structure.world_from_camera.translation[structure.frame]
    own = np.einsum("mi,mi->m", structure.world_from_camera.rotation[structure.frame][:, :, 2], arms)
    found = vote(structure.depth, own)
    if found is None or found.votes < FEWEST_VOTES:
        raise CaptureError(
            f"only {0 if found is None else found.votes} reconstructed points have a measured depth, too few to tell "
            "the scale: is the depth registered to the colours, and in its right unit?"
        )
    if found.share < LEAST_SHARE:
        raise CaptureError(
            f"the reconstruction is wrong: of {found.votes} measured depths only {100 * found.share:.0f} % agree on "
            "its scale; something may move with the camera (hide it with ignore.png), or the depth may not belong to "
            "the colours"
        )
    registered = structure.registered.copy()
    for index in np.flatnonzero(registered):
        votes = (structure.frame == index) & (structure.depth > 0)
        if votes.sum() >= 10 and found.agreeing[votes].mean() < LEAST_SHARE:
            registered[index] = False
    check_registered(names, registered)
    poses = structure.world_from_camera
    known = registered[:, None]
    translation = np.where(known, found.value * poses.translation, 0)
    rotation = np.where(known[..., None], poses.rotation, np.eye(3))
    metric = Similarity(rotation, translation, np.ones(len(registered)))
    trajectory = Trajectory(
        tuple(names), metric, registered, "structure from motion", scale=found.value, agreement=found.share
    )
    seen = registered[structure.frame]
    rest = {name: getattr(structure, name)[seen] for name in ("frame", "point", "pixel", "depth")}
    return trajectory, Structure(metric, registered, found.value * structure.points, **rest)


def check_registered(names: Sequence[str], registered: Bool[np.ndarray, " n"]) -> None:
    """Raise CaptureError where fewer than half of the frames have a place; it names the others."""
    count = int(registered.sum())
    if count < max(FEWEST_FRAMES, LEAST_REGISTERED * len(names)):
        lost = [name for name, known in zip(names, registered, strict=True) if not known]
        raise CaptureError(
            f"only {count} of {len(names)} frames could be placed; without a place are {abbreviate(lost, 8)}: "
            "take frames closer to one another, of a scene with more texture, or give poses (poses.json) or a board "
            "(--board)"
        )
