"""The ``ipjax`` command: runs the module of `ipjax.commands` that the first word names, and prints errors in one line.

Exit status: 0 success, 1 a negative result (something missing, no pose found), 2 an error, of which one line on stderr
says why. ``IPJAX_DEBUG=1`` shows the traceback.

argparse is kept: it is in the standard library and loads in 10 ms, argcomplete completes it, and what click and typer
would add (types, checks and messages in words) is written here anyway, since files and settings need it, too.
"""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence

from ipjax import __version__
from ipjax.commands import (
    calibrate,
    capture,
    degrade,
    demo,
    doctor,
    estimate,
    evaluate,
    export,
    grasp,
    label,
    onboard,
    score,
    simulate,
    weights,
)
from ipjax.commands.interface import completion
from ipjax.commands.interface.messages import Messages, in_one_line, is_user_error
from ipjax.commands.interface.parser import Parser

_COMMANDS = (
    onboard,
    estimate,
    grasp,
    demo,
    doctor,
    weights,
    score,
    evaluate,
    capture,
    calibrate,
    simulate,
    label,
    degrade,
    export,
)  # as --help lists them
GUIDE = """\
start here:
  ipjax doctor                               what works on this machine
  ipjax weights fetch                        get the encoder's weights, once
  ipjax onboard mug.glb -o mug.ipjax         once per object: a mesh, or one photo, becomes templates
  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json --mask mask.png \\
      -o pose.json --overlay pose.png        once per frame: where is it, and how large

everywhere:
  --json                                     the result for machines: one JSON document on the standard output
  --set match.views=4                        change any setting, where --config takes a whole set of them

Everything is in metres and OpenCV camera axes (x right, y down, z ahead) unless a name says otherwise."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    debug = os.environ.get("IPJAX_DEBUG", "") not in ("", "0")
    parser = build_parser()
    completion.answer(parser)
    try:
        arguments = parser.parse_args(argv)
        messages = Messages(json=arguments.json, quiet=getattr(arguments, "quiet", False))
        with messages.capturing_logs(), warnings.catch_warnings():
            if not debug:
                warnings.simplefilter("ignore")
            return arguments.run(arguments, messages)
    except KeyboardInterrupt:
        print("ipjax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, MemoryError, RuntimeError, AssertionError) as error:
        if debug or not is_user_error(error):
            raise
        print(f"ipjax: {in_one_line(error)}", file=sys.stderr)
        return 2


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; what a command needs is imported when it runs, not here."""
    parser = Parser(
        prog="ipjax",
        description="From one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=GUIDE,
    )
    parser.add_argument("--version", action="version", version=f"ipjax {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=Parser)
    for command in _COMMANDS:
        command.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
