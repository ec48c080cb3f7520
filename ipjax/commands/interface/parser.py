"""The parser of command lines, what its words may be, and what it says where they are not."""

import argparse
import re
from pathlib import Path
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """argparse's, with its errors in one line that say what to do."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is, and exit with status 2."""
        option = re.fullmatch(r"argument (?:-\w/)?(--[\w-]+): expected one argument", message)
        if option is not None:  # argparse takes what begins with a minus for another option
            message += f"; one that begins with a minus is written {option[1]}=-1"
        if re.fullmatch(r"unrecognized arguments: \S+\.json", message):
            message += "; --json takes no file: it prints to the screen, and -o FILE writes"
        self.exit(2, f"{self.prog}: {' '.join(message.split())} (see {self.prog} --help)\n")


class Renamed(argparse.Action):
    """An option of an earlier version: says what it is called now."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option: Any = None) -> None:
        """Refuse it."""
        parser.error(f"{option} is called --config now: default (which was best), fast, paper, or a file of settings")


def add_command(commands: Any, name: str, run: Any, summary: str, epilog: str = "") -> Parser:
    """A command's own parser; ``run`` is called with the parsed words and the messages, and returns the exit status."""
    parser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def parse_count(text: str) -> int:
    """A whole number from 1 to 10000; ValueError otherwise."""
    value = int(text)
    if not 1 <= value <= 10_000:
        raise ValueError
    return value


def parse_numbers(text: str) -> tuple[float, ...]:
    """Finite numbers with commas between them; ValueError otherwise."""
    values = tuple(float(part) for part in text.split(","))
    if any(value != value or abs(value) == float("inf") for value in values):
        raise ValueError
    return values


def parse_box(text: str) -> tuple[float, ...]:
    """``X,Y,W,H`` in pixels; argparse.ArgumentTypeError, in words, otherwise."""
    try:
        values = parse_numbers(text)
    except ValueError:
        values = ()
    if len(values) != 4:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no box: give four numbers with commas and no spaces, X,Y,W,H, for instance 210,130,90,120"
        )
    return values


def parse_click(text: str) -> tuple[float, ...]:
    """``X,Y`` in pixels; argparse.ArgumentTypeError, in words, otherwise."""
    try:
        values = parse_numbers(text)
    except ValueError:
        values = ()
    if len(values) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} is no pixel: give two numbers, X,Y, for instance 312,240")
    return values


def parse_camera(text: str) -> Any:
    """What `ipjax.files.cameras.reading.read_camera` takes: a file's name, or the four numbers ``fx,fy,cx,cy``."""
    parts = text.split(",")
    if len(parts) == 4 and not Path(text).exists():
        try:
            return dict(zip(("fx", "fy", "cx", "cy"), map(float, parts), strict=True))
        except ValueError:
            pass
    return text


parse_numbers.__name__ = "list of numbers"
parse_count.__name__ = "count"  # argparse names the type in its message
