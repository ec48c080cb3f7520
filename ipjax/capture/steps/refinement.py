"""The step refine: where exactly did the camera stand?"""

import numpy as np

from ipjax.capture.moving import hide, read_ignored
from ipjax.capture.poses.tracks import read_tracks
from ipjax.capture.refinement.storing import refine_in
from ipjax.capture.steps.records import Figure, Job, Outcome, Step, say
from ipjax.capture.trajectories import read_trajectory
from ipjax.files.wording import abbreviate


def refine_poses(job: Job) -> Outcome:
    """The poses made exact, and how well each is known."""
    capture = hide(job.capture, read_ignored(job.work, job.capture))
    tracks = read_tracks(job.work / "tracks.npz") if job.has("tracks.npz") else None
    made = refine_in(job.work, capture, read_trajectory(job.work / "poses.json"), tracks, progress=job.progress)
    found = made.found
    known = found.trajectory.registered
    sure = int(found.sure.sum())
    figures = [Figure("sure", f"{sure} of {int(known.sum())}", "frames", "whose pose nothing leaves open")]
    if found.sure.any() and found.trajectory.covariance is not None:
        own = np.sqrt(np.einsum("nii->ni", found.trajectory.covariance[found.sure]))
        turn, shift = (float(np.median(np.linalg.norm(own[:, at], axis=1))) for at in (slice(0, 3), slice(3, 6)))
        meaning = "standard deviation of a sure pose, by the median; it does not know of errors that all frames share"
        figures.append(Figure("known to", f"{1000 * shift:.2f} mm and {np.rad2deg(turn):.3f}°", "", meaning))
    if made.after is not None:
        meaning = "between the depths of frames that follow one another, by the median: the noise of the depth camera"
        if made.before is not None:
            meaning += f"; {1000 * made.before:.2f} mm before"
        figures.append(Figure("difference", round(1000 * made.after, 2), "mm", meaning))
    warnings = []
    unsure = [
        name for name, good, there in zip(job.capture.names, found.sure, known, strict=True) if there and not good
    ]
    if unsure:
        kept = "kept, as told" if job.settings.keep_unsure else "left out of models and labels"
        warnings.append(
            f"The pose of {len(unsure)} of {int(known.sum())} frames is not sure; {kept}: {abbreviate(unsure, 12)}."
        )
    return Outcome(
        ("refined.json", "refinement.json", "refinement.png"),
        tuple(figures),
        tuple(map(say, made.lines)),
        tuple(warnings),
    )


STEP = Step(
    name="refine",
    title="Where exactly?",
    does="Moves all cameras until their depth images agree, and says of each frame how well its place is known.",
    picture="refinement.png",
    caption="Points of all frames over one another, a colour a frame, before and after. Right if surfaces are thin and "
    "their colours mixed; the same surface twice, side by side, is wrong.",
    needs=("pose",),
    results=("refined.json", "refinement.json"),
    sometimes=(),
    extras=(),
    modules=("ipjax.capture.steps.refinement",),
    choose=lambda of: {},
    make=refine_poses,
)
