"""The step check: is the capture worth the work?"""

import numpy as np
from jaxtyping import UInt8

from ipjax.capture.checks.findings import UNUSABLE, WARNING, list_findings
from ipjax.capture.checks.inspection import Inspection, inspect
from ipjax.capture.checks.page import write_page
from ipjax.capture.labels.pictures import lay_out, write_label
from ipjax.capture.steps.records import Figure, Job, Outcome, Step
from ipjax.inference.drawing import write_image

_MOST = 16  # frames in the picture


def check(job: Job) -> Outcome:
    """Look through the capture; what makes it unusable stops the run."""
    found = inspect(job.capture, progress=lambda done, total: job.progress("looking", done, total))
    findings = list_findings(found)
    write_page(job.work / "check.html", found, findings)
    write_image(job.work / "check.png", draw_inspection(found))
    of = lambda kind: tuple(finding.text for finding in findings if finding.kind == kind)
    unusable = of(UNUSABLE)
    return Outcome(
        ("check.html", "check.png"),
        tuple(_measure(found)),
        tuple(finding.text for finding in findings if finding.kind not in (UNUSABLE, WARNING)),
        of(WARNING),
        " ".join(unusable) or None,
    )


def _measure(found: Inspection) -> list[Figure]:
    median = lambda values: float(np.median(values))
    figures = [
        Figure("frames", len(found.capture), "", "20 to 60 around a table are good, fewer than 8 leave sides unseen"),
        Figure(
            "depth known",
            round(100 * median([image.known for image in found.images])),
            "% of the pixels",
            "the median frame; what is shiny, transparent or near has none",
        ),
        Figure(
            "distance",
            round(median([image.distance for image in found.images]), 2),
            "m",
            "median depth; depth cameras measure best from 0.4 to 1.5 m",
        ),
    ]
    overlaps = [pair.overlap for pair in found.pairs if pair.overlap is not None]
    if overlaps:
        meaning = "of a frame's depth is seen by the next one, too, at the least; below 40 % frames may not join"
        figures.append(Figure("overlap", round(100 * min(overlaps)), "%", meaning))
    if found.pairs:
        least = min(pair.matches for pair in found.pairs)
        figures.append(Figure("features", least, "", "that neighbours share, at the least; below 15 they may not join"))
    return figures


def draw_inspection(found: Inspection) -> UInt8[np.ndarray, "h w 3"]:
    """Frames of the capture, evenly picked: colours above, depth below."""
    count = len(found.images)
    chosen = np.unique(np.linspace(0, count - 1, min(_MOST, count)).round().astype(int))
    tiles = []
    for index in chosen:
        image = found.images[int(index)]
        tile = np.concatenate([image.rgb, _fit(image.depth, image.rgb.shape[1])])
        write_label(tile, found.capture.names[int(found.looked_at[int(index)])], (4, 12))
        tiles.append(tile)
    return lay_out(tiles, 8)


def _fit(image: UInt8[np.ndarray, "h w 3"], width: int) -> UInt8[np.ndarray, "a b 3"]:
    import cv2

    return cv2.resize(image, (width, round(image.shape[0] * width / image.shape[1])), interpolation=cv2.INTER_NEAREST)


STEP = Step(
    name="check",
    title="Is the capture good?",
    does="Looks through all frames: units, registration, blur, exposure, overlap, given poses, what moves along.",
    picture="check.png",
    caption="Colours above, depth below (near is bright, unknown is black). Right if outlines of things are at the "
    "same place in both, and nothing stays at its place while the table turns. All frames are in check.html.",
    needs=(),
    results=(),
    sometimes=(),
    extras=("check.html",),
    modules=("ipjax.capture.steps.inspection",),
    choose=lambda settings: {},
    make=check,
)
