"""Running steps one after the other: those that are done are kept, a run that was killed goes on."""

import contextlib
import dataclasses
import errno
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from ipjax.capture.records import CaptureError
from ipjax.capture.steps.records import Job, Outcome, Progress, Step, tell_nobody
from ipjax.capture.steps.workspace import (
    LOG,
    STEPS,
    Record,
    begin,
    describe_inputs,
    find_reason,
    finish,
    forget,
    hash_capture,
    hash_file,
    list_files,
    read_record,
    remove_unfinished,
    write_record,
)
from ipjax.files.storage.locks import locked
from ipjax.files.storage.writing import append_json

FOUND = "it is taken as it was found, because of --from"


@dataclasses.dataclass(frozen=True)
class Done:
    """A step of a run."""

    step: Step
    record: Record
    why: str | None  # it was made, or taken as it was found; None = it was kept
    seconds: float


@dataclasses.dataclass(frozen=True)
class Listener:
    """What a run tells while it runs."""

    begins: Callable[[Step, str], None] = tell_nobody  # why it is made
    ends: Callable[[Done], None] = tell_nobody
    progress: Progress = tell_nobody


def run_steps(
    steps: Sequence[Step],
    job: Job,
    *,
    first: str | None = None,
    anyway: bool = False,
    listener: Listener | None = None,
) -> list[Done]:
    """Run the steps in their order; a step whose inputs and settings are the same and whose files are whole is kept.

    Args:
      first: the step that is made in any case, with all after it; what the steps before it left is taken as it is,
        whoever made it.
      anyway: go on where a step says that those after it make no sense.

    Returns the steps that were done; the last one's outcome says where it has to stop.

    Raises:
      CaptureError: in one sentence why a step cannot be made, what is in the way, or that the disc is full. What was
        finished before is kept.
    """
    listener = listener or Listener()
    names = [step.name for step in steps]
    if first is not None and first not in names:
        raise CaptureError(f"no step is called {first!r}; one of {', '.join(names)}")
    start = 0 if first is None else names.index(first)
    check_work(job.work, steps, taken=first is not None)
    job = dataclasses.replace(job, progress=listener.progress)
    with _telling_full_discs(job.work), _alone(job.work):
        remove_unfinished(job.work, job.dataset)
        if first is not None:
            forget(job.work, names[start:])
        capture = hash_capture(job.capture, (job.work, job.dataset))
        records: dict[str, Record] = {}
        done: list[Done] = []
        for index, step in enumerate(steps):
            made_of = describe_inputs(step, job, capture, records, steps)
            record = read_record(job.work, step.name)
            why = find_reason(step, record, made_of, job.work)
            began = time.monotonic()
            if why is not None and index < start:
                record, why = _take(step, job, made_of), FOUND
                write_record(job.work, step.name, record)
            elif why is not None or record is None:
                why = why or "it was not made yet"
                listener.begins(step, why)
                record = _make(step, job, made_of)
            records[step.name] = record
            done.append(Done(step, record, why, time.monotonic() - began))
            if why is not None:
                entry = {"step": step.name, "why": why, "seconds": round(done[-1].seconds, 2)}
                append_json(job.work / STEPS / LOG, {"at": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **entry})
            listener.ends(done[-1])
            if record.outcome.stop is not None and not anyway:
                break
    return done


def check_work(work: Path, steps: Sequence[Step], *, taken: bool) -> None:
    """Refuse a folder of work that others use, before anything is done.

    Args:
      taken: what is there is to be taken as it is.

    Raises:
      CaptureError: it is no folder, or has other files in it.
    """
    if not work.exists():
        return
    if not work.is_dir():
        raise CaptureError(f"{work}: a file of this name is in the way")
    if (work / STEPS).is_dir() or taken:
        return
    there = sorted(path.name for path in work.iterdir() if path.name[0] != ".")
    mine = {name.split("/")[0] for step in steps for name in step.files}
    if not there:
        return
    if mine & set(there):
        raise CaptureError(
            f"{work}: it has files that single steps made ({', '.join(sorted(mine & set(there)))[:120]}); --from STEP "
            "takes them as they are and goes on with STEP, --work FOLDER names another folder"
        )
    raise CaptureError(f"{work}: it has other files in it ({there[0]}); --work FOLDER names another folder")


def _make(step: Step, job: Job, made_of: dict) -> Record:
    begin(job.work, step, made_of)
    outcome = step.make(job)
    record = Record(made_of, _hash(job.work, outcome.outputs), outcome)
    finish(job.work, step, record)
    return record


def _take(step: Step, job: Job, made_of: dict) -> Record:
    """The record of what is there."""
    if step.into_dataset:
        raise CaptureError(f"the step {step.name} is the last; it cannot be taken as it is")
    missing = [name for name in step.results if not job.has(name)]
    if missing:
        raise CaptureError(
            f"{job.work}: the step {step.name} left no {missing[0]} there; begin with it: --from {step.name}"
        )
    outputs = tuple(name for name in step.files if job.has(name))
    note = "Taken as it was found in the folder of work; nothing was measured."
    return Record(made_of, _hash(job.work, outputs), Outcome(outputs, notes=(note,)), found=True)


def _hash(work: Path, names: Sequence[str]) -> dict[str, str]:
    return {name: hash_file(work / name) for name in list_files(work, names)}


@contextlib.contextmanager
def _alone(work: Path) -> Iterator[None]:
    """One run at a time; the lock goes with the process, however it ends."""
    work.mkdir(parents=True, exist_ok=True)
    (work / STEPS).mkdir(exist_ok=True)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(work / STEPS / ".lock", wait=False))
        except BlockingIOError:
            raise CaptureError(f"{work}: another run is at work there") from None
        yield


@contextlib.contextmanager
def _telling_full_discs(work: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        what = f"{error.filename or work}: {os.strerror(error.errno)[:1].lower()}{os.strerror(error.errno)[1:]}"
        raise CaptureError(f"{what}; the finished steps are kept: make room and run the same command again") from None
