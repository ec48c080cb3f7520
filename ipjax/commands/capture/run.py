"""``ipjax capture run``: from a folder of frames to a data set, at once."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.capture.depth import MODES
from ipjax.commands.capture.model import add_objects, read_objects
from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.capture.pose import METHODS
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

STEPS = ("check", "pose", "refine", "depth", "model", "label")
EXAMPLES = """\
examples:
  ipjax capture run table/ -o mytable/
  ipjax capture run table/ -o mytable/ --object mug:312,204 --object box:420,233@000007    what touches, told apart
  ipjax capture run table/ -o mytable/ --from model         models and labels again, poses as they are

Steps: check, pose, refine, depth, model, label. Writes the data set in BOP's layout, DATASET, and beside it the folder
DATASET.work: what each step made, with a picture, and report.html, which shows all of them. Kill it at any moment and
call it again: what is finished is not made again, unless the capture, settings or code it was made of changed. Single
steps work in the same folder: ipjax capture model table/ -o mytable.work --object …, then run --from label.

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
    parser.add_argument("--depth-mode", choices=MODES, default="solve", help="see ipjax capture depth --help")
    parser.add_argument("--keep-unsure", action="store_true", help="keep frames whose pose is not sure")
    add_objects(parser)
    options.add_seed(parser)
    options.add_reporting(parser, quiet="no progress bars")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Make the data set and the report; returns the exit status."""
    dataset: Path = options.check_folder(arguments.output)
    work: Path | None = arguments.work
    hints, models = read_objects(arguments)
    seed = options.check_seed(arguments.seed)
    capture = open_given(arguments)
    from ipjax.capture.dataset import Run, make_dataset
    from ipjax.capture.steps.running import Done, Listener
    from ipjax.capture.steps.settings import RunSettings
    from ipjax.inference.compilation_cache import use_compilation_cache

    settings = RunSettings(
        method=arguments.method,
        board=arguments.board,
        seed=seed,
        find_gripper=not arguments.keep_gripper,
        keep_unsure=arguments.keep_unsure,
        depth_mode=arguments.depth_mode,
        hints=tuple(hints),
        support=arguments.support,
        models=models,
    )
    use_compilation_cache()
    bars = _Bars(quiet=arguments.quiet)
    with bars:

        def tell(one: Done) -> None:
            bars.close()
            kept = "" if one.why is not None else " (kept)"
            messages.say(f"{one.step.name:<7}{one.record.outcome.summary or one.step.title}{kept}")
            for text in one.record.outcome.warnings:
                messages.say(f" {text}", mark="warning:", style="yellow")

        run: Run = make_dataset(
            capture,
            dataset,
            work=work,
            settings=settings,
            first=arguments.first,
            anyway=arguments.anyway,
            listener=Listener(begins=bars.begin, ends=tell, progress=bars.show),
        )
    if run.stopped:
        messages.say(f"It stops here: {run.stopped} Look at {run.report}; --anyway goes on.")
    else:
        messages.say(f"The data set is {dataset}; look at {run.report} before you use it.")
    messages.finish(
        {
            "dataset": None if run.stopped else str(dataset),
            "work": str(run.work),
            "report": str(run.report),
            "stopped": run.stopped,
            "steps": [_tell(one) for one in run.done],
        }
    )
    return 1 if run.stopped else 0


def _tell(one: Any) -> dict[str, Any]:
    outcome = one.record.outcome
    return {
        "step": one.step.name,
        "made": one.why is not None,
        "why": one.why,
        "seconds": round(one.seconds, 2),
        "figures": {figure.name: [figure.value, figure.unit] for figure in outcome.figures},
        "warnings": list(outcome.warnings),
        "notes": list(outcome.notes),
    }


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
