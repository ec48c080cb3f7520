"""``ipjax demo``: onboarding and estimation on a synthetic scene, where the true pose is known."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax demo
  ipjax demo -o out/demo --seed 3
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "demo",
        run,
        "render a scene, find one of its objects by a distorted copy and by one RGB photo, and compare with the truth",
        EXAMPLES,
    )
    options.add_output(parser, "FOLDER", "for the results", default=Path("ipjax-demo"))
    options.add_seed(parser, "of the scene")
    options.add_encoder(parser)
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Run the demo; returns the exit status, 1 where the object was not found by its distorted copy."""
    options.check_folder(arguments.output)
    options.check_seed(arguments.seed)
    from ipjax.inference.compilation_cache import use_compilation_cache

    encoder = options.load_encoder(arguments)
    messages.print_notes()
    use_compilation_cache()
    from ipjax.commands.demo_scene import run_demo

    outcome = run_demo(arguments.output, encoder, seed=arguments.seed)
    found, photo = outcome.mesh, outcome.photo
    good = found is not None and found.good
    messages.finish(
        {
            "folder": str(arguments.output),
            "found": good,
            **({} if found is None else found.as_json()),
            "photo": None if photo is None else photo.as_json(),
        }
    )
    return 0 if good else 1
