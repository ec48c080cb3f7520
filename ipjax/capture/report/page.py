"""The report of a run as one self-contained page: every step with its picture, its figures and what they mean."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ipjax.capture.steps.records import Job, Step
from ipjax.capture.steps.workspace import Record
from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text

NAME = "report.html"
_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_WIDEST = 1440  # pixels of a picture in the page

_NEXT = """\
# look at one frame, in Python
from ipjax.bop.dataset import Dataset
dataset = Dataset("{dataset}")
frame, truths = dataset.frame(0, 0), dataset.truths(0, 0)

# find an object of it elsewhere
ipjax onboard {dataset}/models/obj_000001.ply --unit mm -o object.ipjax
ipjax estimate object.ipjax --rgb photo.png --depth depth.png --camera camera.json

# measure estimates against it
ipjax evaluate {dataset} -o results/
"""


def write_report(
    job: Job, steps: Sequence[Step], records: Sequence[tuple[Step, Record]], failure: str | None = None
) -> Path:
    """Write the page into the folder of work; returns its path.

    It depends on nothing but what the steps found, so that two runs over one capture write the same.

    Args:
      steps: all of the chain.
      records: of those that were done, in their order.
      failure: why no more were done; None = all were, or a step says why not.

    Raises:
      OSError: it cannot be written.
    """
    done = {step.name for step, _ in records}
    later = [step for step in steps if step.name not in done]
    stops = [record.outcome.stop for _, record in records if record.outcome.stop] if later else []
    reason = failure or (stops[-1] if stops else None)
    stopped = None
    if reason is not None:
        at = later[0].name if failure and later else records[-1][0].name if records else ""
        stopped = f"It stopped at the step {at}. {reason[0].upper()}{reason[1:]}{'' if reason.endswith('.') else '.'}"
    warnings = [(step.name, text) for step, record in records for text in record.outcome.warnings]
    page = render_page(
        _TEMPLATE,
        name=job.capture.folder.resolve().name,
        lead=_describe(job, finished=not later),
        stopped=stopped,
        warnings=warnings,
        steps=[_show(job.work, step, record) for step, record in records],
        later=[step.title for step in later],
        next=_NEXT.format(dataset=job.dataset.name) if not later else None,
    )
    return write_text(job.work / NAME, page)


def _describe(job: Job, *, finished: bool) -> str:
    width, height = job.capture.size
    text = f"A capture of {len(job.capture)} frames, {width} × {height} pixels"
    return f"{text}, made a data set: {job.dataset.name}" if finished else f"{text}; no data set was made of it"


def _show(work: Path, step: Step, record: Record) -> dict:
    outcome = record.outcome
    picture = work / step.picture
    return {
        "name": step.name,
        "title": step.title,
        "does": step.does,
        "summary": outcome.summary,
        "warnings": outcome.warnings,
        "picture": embed_image(_shrink(_read(picture)), "jpg") if picture.is_file() else None,
        "caption": step.caption,
        "figures": outcome.figures,
        "notes": outcome.notes,
    }


def _read(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    from ipjax.files.images.opening import read_rgb

    return read_rgb(path)


def _shrink(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "a b 3"]:
    import cv2

    height, width = image.shape[:2]
    if width <= _WIDEST:
        return image
    return cv2.resize(image, (_WIDEST, round(height * _WIDEST / width)), interpolation=cv2.INTER_AREA)
