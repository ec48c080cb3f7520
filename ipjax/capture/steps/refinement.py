"""The step refine: where exactly did the camera stand?"""

from typing import Any

import numpy as np

from ipjax.capture.poses.tracks import read_tracks
from ipjax.capture.records import CaptureError
from ipjax.capture.refinement.agreement import draw_agreement, list_neighbours, measure_agreement
from ipjax.capture.refinement.refining import Refinement, describe, refine
from ipjax.capture.steps.frames import hide, read_ignored
from ipjax.capture.steps.records import Figure, Job, Outcome, Step, list_names, say
from ipjax.capture.trajectories import read_trajectory, write_trajectory
from ipjax.files.storage.writing import write_text
from ipjax.inference.drawing import write_image
from ipjax.inference.reports import to_json


def refine_poses(job: Job) -> Outcome:
    """The poses made exact, and how well each is known."""
    before = read_trajectory(job.work / "poses.json")
    if before.names != job.capture.names:
        raise CaptureError(f"{job.work / 'poses.json'}: it is of other frames than {job.capture.folder}")
    capture = hide(job.capture, read_ignored(job))
    tracks = read_tracks(job.work / "tracks.npz") if job.has("tracks.npz") else None
    found = refine(capture, before, tracks, progress=job.progress)
    depths: list[Any] = [None] * len(capture)
    for index in np.flatnonzero(before.registered):
        frame = capture.read_frame(int(index))
        assert frame.depth is not None  # or `refine` had refused it
        depths[index] = np.where(frame.usable, frame.depth, 0)
    neighbours = list_neighbours(before.registered)
    apart = [
        measure_agreement(depths, capture.camera, poses.world_from_camera, neighbours)
        for poses in (before, found.trajectory)
    ]
    medians = [float(np.nanmedian(each)) if np.isfinite(each).any() else None for each in apart]
    lines = describe(found, *medians)
    write_image(
        job.work / "refinement.png", draw_agreement(depths, capture.camera, before, found.trajectory, lines[:6])
    )
    write_text(job.work / "refinement.json", to_json(_tell(found, capture.names)) + "\n")
    write_trajectory(job.work / "refined.json", found.trajectory)
    known = found.trajectory.registered
    sure = int(found.sure.sum())
    figures = [Figure("sure", f"{sure} of {int(known.sum())}", "frames", "whose pose nothing leaves open")]
    if found.sure.any() and found.trajectory.covariance is not None:
        own = np.sqrt(np.einsum("nii->ni", found.trajectory.covariance[found.sure]))
        turn, shift = (float(np.median(np.linalg.norm(own[:, at], axis=1))) for at in (slice(0, 3), slice(3, 6)))
        meaning = "standard deviation of a sure pose, by the median; it does not know of errors that all frames share"
        figures.append(Figure("known to", f"{1000 * shift:.2f} mm and {np.rad2deg(turn):.3f}°", "", meaning))
    if medians[1] is not None:
        meaning = "between the depths of frames that follow one another, by the median: the noise of the depth camera"
        if medians[0] is not None:
            meaning += f"; {1000 * medians[0]:.2f} mm before"
        figures.append(Figure("difference", round(1000 * medians[1], 2), "mm", meaning))
    warnings = []
    unsure = [name for name, good, there in zip(capture.names, found.sure, known, strict=True) if there and not good]
    if unsure:
        kept = "kept, as told" if job.settings.keep_unsure else "left out of models and labels"
        warnings.append(
            f"The pose of {len(unsure)} of {int(known.sum())} frames is not sure; {kept}: {list_names(unsure)}."
        )
    return Outcome(
        ("refined.json", "refinement.json", "refinement.png"),
        tuple(figures),
        tuple(map(say, lines)),
        tuple(warnings),
    )


def _tell(found: Refinement, names: tuple[str, ...]) -> dict[str, Any]:
    return {
        "sure": [name for name, sure in zip(names, found.sure, strict=True) if sure],
        "remarks": {name: text for name, text in zip(names, found.remarks, strict=True) if text},
        "pairs": [
            {
                "frames": [names[i], names[j]],
                "agreeing_before": round(float(a), 4),
                "agreeing_after": round(float(b), 4),
            }
            for (i, j), a, b in zip(found.pairs, found.share_before, found.share_after, strict=True)
        ],
        "camera_from_depth": found.camera_from_depth.to_matrix().tolist() if found.offset_told else None,
    }


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
