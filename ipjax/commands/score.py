"""``ipjax score``: how good are the poses, or the detections, in a BOP result file?"""

import argparse
import sys
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax score results/ipjax_ycbv-test.csv ycbv/
  ipjax score mine.csv ycbv/ --metrics mssd mspd add_s --against other.csv -o score.json
  ipjax score mine.csv ycbv/ --json | jq .all_frames.recalls
  ipjax score mine.csv ycbv/ --metrics ap --targets test_targets_bop24.json         6-D detection
  ipjax score detections_ycbv-test.json ycbv/                                       2-D detection: boxes and masks

Poses are a CSV, detections JSON (also .json.gz), npz of CNOS or SAM-6D, or a folder of such. Of detections it tells
COCO's average precisions (IoU 0.5 … 0.95) of boxes and of masks; what is less than a tenth visible need not be found.
"""

DETECTIONS = (".json", ".gz", ".npz")


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands, "score", run, "score a BOP result file against the annotations of a BOP data set", EXAMPLES
    )
    parser.add_argument(
        "results",
        type=Path,
        metavar="FILE",
        help="CSV of scene_id,im_id,obj_id,score,R,t,time (t in mm), or JSON of detections",
    )
    options.add_dataset(parser)
    parser.add_argument(
        "--sizes",
        type=Path,
        metavar="CSV",
        help="its rows with a column scale, estimated over true size (default: CSV's .sized, if it is there)",
    )
    options.add_scoring(parser, None, "the first three", "leave damaged rows out and say so, instead of stopping")
    parser.add_argument(
        "--modal", action="store_true", help="of detections: boxes are of what is visible, not of whole silhouettes"
    )
    options.add_output(parser, "JSON", "also write the score, with every instance")
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Score and show the table; returns the exit status."""
    if arguments.output is not None:
        options.check_output(arguments.output, (".json",))
    dataset = options.open_dataset(arguments)
    if arguments.results.suffix.lower() in DETECTIONS or arguments.results.is_dir():
        return _score_detections(dataset, arguments, messages)
    if arguments.modal:
        raise ValueError("--modal belongs to detections, not to poses")
    from ipjax.bop.dataset import parse_images
    from ipjax.bop.scoring.scores import score
    from ipjax.bop.scoring.tables import format_score
    from ipjax.inference.compilation_cache import use_compilation_cache

    use_compilation_cache()
    found = score(
        arguments.results,
        dataset,
        arguments.metrics or options.METRICS[:3],
        against=arguments.against,
        sizes=True if arguments.sizes is None else arguments.sizes,
        on_error="skip" if arguments.skip_bad else "raise",
        progress=sys.stderr.isatty(),
        without=parse_images(arguments.without),
    )
    messages.say(format_score(found))
    if arguments.output is not None:
        found.write_json(arguments.output)
    messages.finish(found.to_dict())
    return 0


def _score_detections(dataset: Any, arguments: argparse.Namespace, messages: Messages) -> int:
    for name in ("metrics", "against", "sizes", "without"):
        if getattr(arguments, name):
            raise ValueError(f"--{name} belongs to poses; {arguments.results} has detections")
    from ipjax.bop.scoring.overlaps import format_detections, score_detections

    found = score_detections(
        arguments.results,
        dataset,
        boxes="modal" if arguments.modal else "amodal",
        on_error="skip" if arguments.skip_bad else "raise",
    )
    messages.say(format_detections(found))
    if arguments.output is not None:
        found.write_json(arguments.output)
    messages.finish(found.to_dict())
    return 0
