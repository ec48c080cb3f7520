"""The step depth: depth in the pixels of the colours, of everything that the capture knows."""

import numpy as np

from ipjax.capture.depth.making import DepthReport, make_depth
from ipjax.capture.labels.pictures import lay_out
from ipjax.capture.moving import hide, read_ignored
from ipjax.capture.steps.records import Figure, Job, Outcome, Step, say
from ipjax.capture.trajectories import read_trajectory
from ipjax.files.images.opening import read_rgb
from ipjax.inference.drawing import write_image

_SHOWN = 4  # frames in the picture
_FOLDERS = ("rgb", "depth", "confidence", "depth_pictures")


def depth(job: Job) -> Outcome:
    """Depth and confidence of every frame, and the depth camera where that can be solved."""
    capture = hide(job.capture, read_ignored(job.work, job.capture))
    trajectory = read_trajectory(job.work / "refined.json")
    mode = job.settings.depth_mode
    report = make_depth(capture, trajectory, job.work, mode=mode, progress=job.progress)
    chosen = np.unique(np.linspace(0, len(capture) - 1, min(_SHOWN, len(capture))).round().astype(int))
    pictures = [read_rgb(job.work / "depth_pictures" / f"{capture.names[int(i)]}.jpg") for i in chosen]
    write_image(job.work / "depth.png", lay_out(pictures, 2))
    warnings = []
    if not report.solved.trusted and mode != "factory":
        warnings.append("The depth camera could not be solved surely: depth stays aligned as the factory says.")
    return Outcome(
        (*_FOLDERS, "camera.json", "depth.json", "depth.png"),
        tuple(_measure(report)),
        tuple(map(say, report.lines)),
        tuple(warnings),
    )


def _measure(report: DepthReport) -> list[Figure]:
    figures = [
        Figure(
            "known", round(100 * report.filled, 1), "% of the pixels", "over all frames, after neighbours filled holes"
        )
    ]
    own = report.figures.get(report.mode)
    before = report.figures.get("factory")
    if own is not None and own.off_stereo == own.off_stereo:
        meaning = "from what the colours tell of depth (stereo), by the median"
        if before is not None and before.off_stereo == before.off_stereo:
            meaning += f"; {1000 * before.off_stereo:.1f} mm as the factory aligns it"
        figures.append(Figure("off", round(1000 * own.off_stereo, 2), "mm", meaning))
    if own is not None and own.off_neighbours == own.off_neighbours:
        meaning = "between the depths of neighbouring frames, by the median"
        figures.append(Figure("difference", round(1000 * own.off_neighbours, 2), "mm", meaning))
    return figures


STEP = Step(
    name="depth",
    title="How far away is every pixel?",
    does="Solves where the depth camera is beside the colour camera, carries its depth into the colours, and fills "
    "holes where neighbouring frames agree on what is there.",
    picture="depth.png",
    caption="Where depth jumps (red: as the factory aligns it, green: as it is used), both depths, and how sure it is. "
    "Right if the green lines lie on the outlines of the objects.",
    needs=("pose", "refine"),
    results=("depth", "confidence"),
    sometimes=(),
    extras=("rgb", "depth_pictures", "camera.json", "depth.json"),
    modules=("ipjax.capture.steps.depth",),
    choose=lambda of: {"mode": of.depth_mode},
    make=depth,
    continues=True,
)
