"""What the shell offers when Tab is pressed, through argcomplete where it is installed.

A shell asks by running the command with ``_ARGCOMPLETE`` set; otherwise argcomplete is not even imported. The names of
settings are parsed from the source of `ipjax.config`: importing it takes a second, which is long to wait for Tab.
"""

import argparse
import ast
import functools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_PRESETS = ("default", "fast", "paper")


def answer(parser: argparse.ArgumentParser) -> None:
    """If a shell asks for completions, answer and end the process; else do nothing."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    try:
        import argcomplete
    except ImportError:
        return
    argcomplete.autocomplete(parser)


def attach(argument: argparse.Action, completer: Callable[..., list[str]]) -> None:
    """Offer what ``completer`` lists for this argument; argcomplete reads it off the attribute of that name."""
    vars(argument)["completer"] = completer


def complete_config(prefix: str, **_: Any) -> list[str]:
    """For ``--config``: the presets, and JSON files."""
    from argcomplete.completers import FilesCompleter

    return [name for name in _PRESETS if name.startswith(prefix)] + list(FilesCompleter(("json",))(prefix))


def complete_weights(prefix: str, **_: Any) -> list[str]:
    """For weights: the names that are known, and files."""
    from argcomplete.completers import FilesCompleter

    from ipjax.files.weights.catalogue import CATALOGUE

    return [name for name in CATALOGUE if name.startswith(prefix)] + list(FilesCompleter()(prefix))


def complete_changes(of: str) -> Callable[..., list[str]]:
    """For ``--set``: the fields of this class of `ipjax.config`, each with the sign that follows it."""

    def complete(prefix: str, **_: Any) -> list[str]:
        return [f"{name}=" for name in read_field_names(of) if name.startswith(prefix)]

    return complete


@functools.cache
def read_field_names(of: str) -> tuple[str, ...]:
    """The paths of all fields of a configuration, such as ``match.views``, without importing it."""
    source = Path(__file__).resolve().parents[2].joinpath("config.py").read_text()
    classes = {node.name: node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)}

    def walk(name: str, before: str) -> Iterator[str]:
        for field in classes[name].body:
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                kind, path = ast.unparse(field.annotation), before + field.target.id
                yield from walk(kind, path + ".") if kind in classes else (path,)

    return tuple(walk(of, ""))
