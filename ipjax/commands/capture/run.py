"""``ipjax capture run``: from a folder of frames to a data set, at once."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.capture.bars import Bars
from ipjax.commands.capture.model import add_objects, read_objects
from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.capture.pose import METHODS
from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

STEPS = ("check", "pose", "refine", "model", "label")
EXAMPLES = """\
examples:
  ipjax capture run table/ -o mytable/
  ipjax capture run table/ -o mytable/ --click mug:312,204 --click box:420,233@000007    what touches, told apart
  ipjax capture run table/ -o mytable/ --from model         models and labels again, poses as they are

Steps: check, pose, refine, model, label. Writes the data set in BOP's layout, DATASET, and beside it DATASET.work: what
each step made, with a picture, and report.html, which shows all of them. Kill it at any moment and call it again: what
is finished is not made again, unless the capture, settings or code it was made of changed. Single steps work in the
same folder: ipjax capture model table/ -o mytable.work --click …, then run --from label.

Frames without a pose, or whose pose is not sure, are left out, and named. Exits with 1 where the capture cannot be used
as it is.
"""


def add(steps: Any) -> None:
    """The command and its options."""
    parser = add_command(steps, "run", run, "all steps at once: from a folder of frames to a BOP data set", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "DATASET", "folder of the data set", required=True)
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="of what the steps make (default DATASET.work)")
    parser.add_argument("--from", dest="first", choices=STEPS, help="make this step and those after it again")
    parser.add_argument("--anyway", action="store_true", help="go on where the check says that it makes no sense")
    parser.add_argument("--method", choices=METHODS, default="auto", help="of the first poses (default auto)")
    parser.add_argument("--board", metavar="WORD", help="a board that lies in the scene; see ipjax capture pose --help")
    parser.add_argument("--keep-gripper", action="store_true", help="do not look for things that move with the camera")
    parser.add_argument("--keep-unsure", action="store_true", help="keep frames whose pose is not sure")
    add_objects(parser)
    options.add_seed(parser)
    options.add_reporting(parser, quiet="no progress bars")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Make the data set and the report; returns the exit status."""
    dataset: Path = options.check_folder(arguments.output)
    work: Path = options.check_folder(arguments.work or name_work(dataset))
    hints, models = read_objects(arguments)
    seed = options.check_seed(arguments.seed)
    capture = open_given(arguments)
    from ipjax.capture.poses.boards import parse_board
    from ipjax.capture.report.page import NAME, write_report
    from ipjax.capture.steps.chain import STEPS as CHAIN
    from ipjax.capture.steps.labels import check_dataset
    from ipjax.capture.steps.records import Job
    from ipjax.capture.steps.running import Done, Listener, run_steps
    from ipjax.capture.steps.settings import RunSettings
    from ipjax.inference.compilation_cache import use_compilation_cache

    if arguments.board is not None:
        parse_board(arguments.board)  # refused now, not after an hour
    check_dataset(dataset)
    settings = RunSettings(
        method=arguments.method,
        board=arguments.board,
        seed=seed,
        find_gripper=not arguments.keep_gripper,
        keep_unsure=arguments.keep_unsure,
        hints=tuple(hints),
        models=models,
    )
    job = Job(capture, work, dataset, settings)
    use_compilation_cache()
    done: list[Done] = []

    def tell(one: Done) -> None:
        done.append(one)
        bars.close()
        outcome = one.record.outcome
        head = next(iter(outcome.notes), "") if one.step.name != "check" else ""
        kept = "" if one.why is not None else " (kept)"
        messages.say(f"{one.step.name:<7}{kept} {head or one.step.title}")
        for text in outcome.warnings:
            messages.say(f"  {text}", mark="warning:", style="yellow")

    bars = _Bars(quiet=arguments.quiet)
    listener = Listener(begins=bars.begin, ends=tell, progress=bars.show)
    try:
        run_steps(CHAIN, job, first=arguments.first, anyway=arguments.anyway, listener=listener)
    except (ValueError, OSError, RuntimeError) as error:
        bars.close()
        if done:
            _write_what_there_is(job, CHAIN, done, error)
        raise
    report = write_report(job, CHAIN, [(one.step, one.record) for one in done])
    last = done[-1].record.outcome
    stopped = last.stop if len(done) < len(CHAIN) else None
    if stopped:
        messages.say(f"It stops here: {stopped} (--anyway goes on)")
    else:
        messages.say(f"The data set is {dataset}; look at {work / NAME} before you use it.")
    messages.finish(
        {
            "dataset": None if stopped else str(dataset),
            "work": str(work),
            "report": str(report),
            "stopped": stopped,
            "steps": [
                {
                    "step": one.step.name,
                    "made": one.why is not None,
                    "why": one.why,
                    "seconds": round(one.seconds, 2),
                    "figures": {figure.name: [figure.value, figure.unit] for figure in one.record.outcome.figures},
                    "warnings": list(one.record.outcome.warnings),
                    "notes": list(one.record.outcome.notes),
                }
                for one in done
            ],
        }
    )
    return 1 if stopped else 0


def name_work(dataset: Path) -> Path:
    """The folder beside the data set in which the steps work; BOP's tools look into the data set only."""
    whole = dataset.resolve() if not dataset.name else dataset
    return whole.with_name(f"{whole.name}.work")


def _write_what_there_is(job: Any, chain: Any, done: Any, error: Exception) -> None:
    """The report of the steps before the one that failed; where that fails, too, the first error is told."""
    import contextlib

    from ipjax.capture.report.page import write_report
    from ipjax.commands.interface.messages import in_one_line

    with contextlib.suppress(OSError):
        write_report(job, chain, [(one.step, one.record) for one in done], in_one_line(error))


class _Bars(Bars):
    """Progress bars that say which step they are of."""

    def __init__(self, *, quiet: bool):
        super().__init__(quiet=quiet)
        self.step = ""

    def begin(self, step: Any, why: str) -> None:
        """The parts from now on are of this step."""
        del why
        self.step = f"{STEPS.index(step.name) + 1}/{len(STEPS)} {step.name}"

    def show(self, part: str, done: int, total: int) -> None:
        super().show(f"{self.step}: {part}", done, total)

    def close(self) -> None:
        """Take the bar away."""
        self.__exit__()
        self.bar = None
