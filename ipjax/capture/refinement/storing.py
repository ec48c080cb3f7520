"""Poses refined and compared with what they were, and the files in which the step refine leaves them."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.records import Capture, CaptureError, Tracks, Trajectory
from ipjax.capture.refinement.agreement import draw_agreement, list_neighbours, measure_agreement
from ipjax.capture.refinement.refining import Refinement, Stages, describe, refine
from ipjax.capture.splatting import with_depth
from ipjax.capture.trajectories import write_trajectory
from ipjax.files.storage.writing import write_text
from ipjax.inference.drawing import write_image
from ipjax.inference.reports import to_json


@dataclasses.dataclass(frozen=True)
class Refined:
    """What `refine_in` made, and what it tells."""

    found: Refinement
    before: float | None  # median difference of depth between frames that follow one another, metres; None = unknown
    after: float | None
    lines: list[str]  # in sentences
    document: dict[str, Any]  # of refinement.json


def refine_in(
    work: Path,
    capture: Capture,
    before: Trajectory,
    tracks: Tracks | None = None,
    *,
    stages: Stages = "global",
    progress: Callable[[str, int, int], None] | None = None,
) -> Refined:
    """Refine poses and write refinement.png, refinement.json and, last, refined.json.

    Args:
      work: the folder, which is made.
      capture: without what moves with the camera (`ipjax.capture.moving.hide`).
      before, tracks, stages, progress: as `refine` has them.

    Raises:
      CaptureError: poses and capture are of other frames, or as `refine`.
    """
    if before.names != capture.names:
        raise CaptureError(f"the poses are of other frames than {capture.folder}")
    found = refine(capture, before, tracks, stages=stages, progress=progress)
    depths: list[Any] = [None] * len(capture)
    for index in np.flatnonzero(before.registered):
        frame = with_depth(capture, capture.read_frame(int(index)))
        assert frame.depth is not None  # or `refine` had refused it
        depths[index] = np.where(frame.usable, frame.depth, 0)
    neighbours = list_neighbours(before.registered)
    apart = [
        measure_agreement(depths, capture.camera, poses.world_from_camera, neighbours)
        for poses in (before, found.trajectory)
    ]
    medians = [float(np.nanmedian(each)) if np.isfinite(each).any() else None for each in apart]
    lines = describe(found, *medians)
    document = _as_json(found, capture.names, apart)
    picture = draw_agreement(depths, capture.camera, before, found.trajectory, lines[:6])
    work.mkdir(parents=True, exist_ok=True)
    write_image(work / "refinement.png", picture)
    write_text(work / "refinement.json", to_json(document) + "\n")
    write_trajectory(work / "refined.json", found.trajectory)
    return Refined(found, medians[0], medians[1], lines, document)


def _as_json(found: Refinement, names: tuple[str, ...], apart: list[np.ndarray]) -> dict[str, Any]:
    plain = lambda values: [None if np.isnan(x) else float(x) for x in values]
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
        "neighbours_apart_before": plain(apart[0]),
        "neighbours_apart_after": plain(apart[1]),
        "camera_from_depth": found.camera_from_depth.to_matrix().tolist() if found.offset_told else None,
    }
