"""``ipjax export``: the estimate for processes that have no ipjax."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_count

EXAMPLES = """\
The artifact takes dictionaries of arrays; templates are inputs, so it serves every object of the same shapes.
A JSON file with the same name and .json at its end describes its inputs, outputs and settings.

examples:
  ipjax export mug.ipjax -o estimate.stablehlo
  ipjax export mug.ipjax -o estimate16.stablehlo --batch 16
  ipjax export mug.ipjax -o quick.stablehlo --config fast --set match.views=4
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "export",
        run,
        "write the whole estimate as StableHLO, which runs without ipjax on CPU, CUDA and TPU",
        EXAMPLES,
    )
    parser.add_argument(
        "object", metavar="OBJ", type=Path, help="an object file: its shapes are exported, not its content"
    )
    options.add_output(parser, "FILE", "FILE.stablehlo", required=True)
    parser.add_argument(
        "--batch", metavar="N", type=parse_count, help="queries at once (default: one, without a batch axis)"
    )
    options.add_config(parser)
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Write the artifact and its description; returns the exit status."""
    from ipjax.files.objects.loading import load
    from ipjax.files.storage.parsing import read_json
    from ipjax.inference.exporting import blank_query, export

    output = options.check_output(arguments.output, (".stablehlo",))
    config = options.read_config(arguments)
    templates, info = load(arguments.object)
    export(templates, blank_query(templates, info.resolution), output, config, batch=arguments.batch)
    size, about = output.stat().st_size, output.with_name(output.name + ".json")
    messages.say(f"{output}: {size / 1e6:.1f} MB; its inputs and outputs: {about}")
    messages.finish({"artifact": str(output), "bytes": size, "description": read_json(about)})
    return 0
