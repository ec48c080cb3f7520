"""What a command says: results on the standard output, for people or as one JSON document; notes on stderr."""

import contextlib
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

# JAX says this with an assertion, or a page.
NO_DEVICE = (
    "JAX_PLATFORMS={} asks for devices that JAX does not have here; unset it, or install what they need "
    "(pip install 'ipjax[cuda]' for NVIDIA)"
)


def is_user_error(error: BaseException) -> bool:
    """Whether an error is to be shown as one line, because its message is written for the user.

    Of RuntimeErrors only those are that no renderer works, that memory is used up, or that a device is missing.
    """
    if not isinstance(error, RuntimeError | AssertionError):
        return True
    return (
        any(kind.__name__ == "RenderError" for kind in type(error).__mro__)
        or "RESOURCE_EXHAUSTED" in str(error)
        or _lacks_devices(error)
    )


def in_one_line(error: BaseException) -> str:
    """What an error says, without line breaks."""
    if isinstance(error, RuntimeError | AssertionError) and _lacks_devices(error):
        return NO_DEVICE.format(os.environ.get("JAX_PLATFORMS", ""))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, MemoryError):
        return "out of memory"
    return " ".join(str(error).split()) or type(error).__name__


def _lacks_devices(error: BaseException) -> bool:
    """Whether JAX has none of the devices that JAX_PLATFORMS asks for; its error says so, or is a bare assertion."""
    if "Unable to initialize backend" in str(error):
        return True
    if not os.environ.get("JAX_PLATFORMS") or "jax" not in sys.modules:
        return False
    try:
        sys.modules["jax"].devices()
    except Exception:  # whatever it raises, there are none
        return True
    return False


class Messages(logging.Handler):
    """What one command prints.

    What the library logs is held back until `print_notes`, so that a command that fails prints one line and nothing
    else. Results for people go to the standard output, in colour on a terminal and plain otherwise. With ``json`` they
    are left out; whatever is printed goes to the error stream, and the standard output holds one JSON document, which
    `finish` writes.

    Args:
        json: the result is wanted as JSON.
        quiet: no notes.
    """

    def __init__(self, *, json: bool = False, quiet: bool = False):
        super().__init__()
        self.json, self.quiet = json, quiet
        self.warnings: list[str] = []  # all of them, also those that were printed
        self.immediate = False  # print warnings as they come, where they explain why it takes long
        self._pending: list[str] = []
        self._noted: set[str] = set()
        self._stdout = sys.stdout

    @contextlib.contextmanager
    def capturing_logs(self) -> Iterator[None]:
        """Collect what the library logs; with ``json``, keep everything but the document off the standard output."""
        logger = logging.getLogger("ipjax")
        level = logger.level
        logger.addHandler(self)
        logger.setLevel(logging.INFO)
        try:
            with contextlib.redirect_stdout(sys.stderr) if self.json else contextlib.nullcontext():
                yield
        finally:
            logger.removeHandler(self)
            logger.setLevel(level)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep what the library logs."""
        self.keep(record.getMessage(), is_warning=record.levelno >= logging.WARNING)

    def keep(self, line: str, *, is_warning: bool = False) -> None:
        """Hold a note back until `print_notes`; of equal ones, the first."""
        if is_warning:
            self.warnings.append(line)
        if line in self._noted:
            return
        self._noted.add(line)
        if self.immediate and is_warning:
            print(line, file=sys.stderr, flush=True)
        else:
            self._pending.append(line)

    def print_notes(self) -> None:
        """Print the notes that were held back; with ``quiet``, none."""
        for line in self._pending if not self.quiet else ():
            print(line, file=sys.stderr)
        self._pending.clear()

    def note(self, line: str) -> None:
        """Print a note now; with ``quiet``, none."""
        if not self.quiet:
            print(line, file=sys.stderr, flush=True)

    def say(self, text: str, *, mark: str = "", style: str = "") -> None:
        """Print a line of the result, for people; on a terminal ``style`` colours the ``mark`` before it."""
        if self.json:
            return
        if mark and sys.stdout.isatty():
            from rich.console import Console
            from rich.text import Text

            Console(highlight=False).print(Text.assemble((mark, style), text), soft_wrap=True)
        else:
            print(f"{mark}{text}", flush=True)

    def show(self, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print a table of the result, for people: fitted to a terminal, or in columns that programs can read."""
        if self.json:
            return
        if sys.stdout.isatty():
            from rich.box import SIMPLE_HEAD
            from rich.console import Console
            from rich.table import Table
            from rich.text import Text

            table = Table(*heads, box=SIMPLE_HEAD, pad_edge=False)
            for column in table.columns:
                column.overflow = "fold"
            for row in rows:
                table.add_row(*map(Text, row))
            Console(highlight=False).print(table)
            return
        widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
        for row in (heads, *rows):
            print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())

    def finish(self, document: Any) -> None:
        """With ``json``, write the result: a text that is JSON already, or what JSON can hold."""
        if not self.json:
            return
        if not isinstance(document, str):
            import json

            document = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        self._stdout.write(document)
        self._stdout.flush()
