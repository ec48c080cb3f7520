"""``ipjax score``: how good are the poses in a BOP result file?"""

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
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands, "score", run, "score a BOP result file against the annotations of a BOP data set", EXAMPLES
    )
    parser.add_argument("results", type=Path, metavar="CSV", help="scene_id,im_id,obj_id,score,R,t,time; t in mm")
    options.add_dataset(parser)
    parser.add_argument(
        "--sizes",
        type=Path,
        metavar="CSV",
        help="its rows with a column scale, estimated over true size (default: CSV's .sized, if it is there)",
    )
    options.add_scoring(
        parser, options.METRICS[:3], "the first three", "leave damaged rows out and say so, instead of stopping"
    )
    options.add_output(parser, "JSON", "also write the score, with every instance")
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Score and show the table; returns the exit status."""
    if arguments.output is not None:
        options.check_output(arguments.output, (".json",))
    from ipjax.bop.dataset import Dataset, parse_images
    from ipjax.bop.scoring.scores import score
    from ipjax.bop.scoring.tables import format_score
    from ipjax.inference.compilation_cache import use_compilation_cache

    use_compilation_cache()
    dataset = Dataset(arguments.dataset, arguments.split, models=arguments.models)
    found = score(
        arguments.results,
        dataset,
        arguments.metrics,
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
