"""From a capture to a data set at once: all steps, and the report."""

import contextlib
import dataclasses
from pathlib import Path

from ipjax.capture.labels.dataset import check_dataset
from ipjax.capture.poses.boards import parse_board
from ipjax.capture.reading.opening import open_capture
from ipjax.capture.records import Capture, CaptureError
from ipjax.capture.report.page import write_report
from ipjax.capture.steps.chain import STEPS
from ipjax.capture.steps.records import Job
from ipjax.capture.steps.running import Done, Listener, run_steps
from ipjax.capture.steps.settings import RunSettings


@dataclasses.dataclass(frozen=True)
class Run:
    """What a run made."""

    dataset: Path  # in BOP's layout; not made where the run stopped
    work: Path  # what the steps made for one another
    report: Path  # a page that shows all steps
    done: tuple[Done, ...]
    stopped: str | None  # why the last steps were not made, a sentence; None = they were


def make_dataset(
    capture: Capture | str | Path,
    dataset: str | Path,
    *,
    work: str | Path | None = None,
    settings: RunSettings | None = None,
    first: str | None = None,
    anyway: bool = False,
    listener: Listener | None = None,
) -> Run:
    """Make a data set in BOP's layout of a capture; what an earlier run made of the same is kept.

    Args:
      capture: as `open_capture` opens it, or its folder.
      dataset: the folder to be written.
      work: the folder of what the steps make for one another; default: ``DATASET.work`` beside it, since BOP's tools
        look through the data set.
      first: the step that is made in any case, with all after it; what the steps before it left is taken as it is.
      anyway: go on where the check says that it makes no sense.
      listener: told what is done.

    Raises:
      CaptureError: in one sentence why it cannot be done, or what is in the way. What was finished is kept, and the
        report shows it.
      OSError: something cannot be read or written.
    """
    capture = capture if isinstance(capture, Capture) else open_capture(capture)
    dataset = Path(dataset)
    settings = settings or RunSettings()
    if settings.board is not None:
        parse_board(settings.board)  # refused now, not after the features
    check_dataset(dataset)
    work = name_work(dataset) if work is None else Path(work)
    for place in (dataset, work):
        if capture.folder.resolve().is_relative_to(place.resolve()):
            raise CaptureError(f"{place}: the capture itself lies in it, and would be replaced; give another folder")
    if work.resolve().is_relative_to(dataset.resolve()):
        raise CaptureError(f"{work}: it lies in the data set, which is replaced as a whole; give another folder")
    job = Job(capture, work, dataset, settings)
    told, done = listener or Listener(), []

    def end(one: Done) -> None:
        done.append(one)
        told.ends(one)

    listener = dataclasses.replace(told, ends=end)
    try:
        run_steps(STEPS, job, first=first, anyway=anyway, listener=listener)
    except (ValueError, OSError, RuntimeError) as error:
        if done:
            with contextlib.suppress(OSError):  # what went wrong first is what is told
                write_report(job, STEPS, [(one.step, one.record) for one in done], " ".join(str(error).split()))
        raise
    report = write_report(job, STEPS, [(one.step, one.record) for one in done])
    stopped = done[-1].record.outcome.stop if len(done) < len(STEPS) else None
    return Run(dataset, job.work, report, tuple(done), stopped)


def name_work(dataset: Path) -> Path:
    """The folder of work that belongs to a data set: beside it, with ``.work`` after its name."""
    whole = dataset if dataset.name else dataset.resolve()
    return whole.with_name(f"{whole.name}.work")
