"""What a step is, and what it says of what it made."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ipjax.capture.records import Capture

Progress = Callable[[str, int, int], None]  # part, done, total


def tell_nobody(*_: object) -> None:
    """Of progress that nobody watches."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A number of a step, and what it means."""

    name: str
    value: float | int | str
    unit: str
    meaning: str  # a sentence: what is good, what is not

    @property
    def text(self) -> str:
        """As a person reads it."""
        value = self.value
        text = value if isinstance(value, str) else str(value) if isinstance(value, int) else f"{value:.3g}"
        return f"{text} {self.unit}".strip()


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a step made, and how good it is."""

    outputs: tuple[str, ...]  # files and folders, relative to the folder of work
    figures: tuple[Figure, ...] = ()
    notes: tuple[str, ...] = ()  # what was found, a sentence each
    warnings: tuple[str, ...] = ()  # what a person should look at, a sentence each
    stop: str | None = None  # why the steps after it make no sense; None = they do

    @property
    def summary(self) -> str:
        """What matters most, in a sentence; "" = there is nothing to say."""
        return next(iter(self.notes), "")


@dataclasses.dataclass(frozen=True)
class Job:
    """What all steps are given."""

    capture: Capture
    work: Path  # the folder of what the steps make for one another
    dataset: Path  # the data set, which the last step makes
    settings: Any  # `ipjax.capture.steps.settings.RunSettings`
    progress: Progress = tell_nobody

    def read_path(self, name: str) -> Path:
        """The file or folder of that name relative to the folder of work."""
        return self.work / name

    def has(self, name: str) -> bool:
        """Whether a step before left it."""
        return (self.work / name).exists()


@dataclasses.dataclass(frozen=True)
class Step:
    """One step: what it needs, what it writes, and how it is made."""

    name: str  # as --from knows it
    title: str  # what it asks, for the report
    does: str  # in a sentence, for the report
    picture: str  # that shows whether it is right, in the folder of work
    caption: str  # how to read the picture
    needs: tuple[str, ...]  # steps whose results it reads
    results: tuple[str, ...]  # what others read of it, in the folder of work; it is always there
    sometimes: tuple[str, ...]  # what others read where it is there
    extras: tuple[str, ...]  # what only people read
    modules: tuple[str, ...]  # whose source makes it
    choose: Callable[[Any], Mapping[str, Any]]  # the settings that it heeds, as JSON knows them
    make: Callable[[Job], Outcome]
    into_dataset: bool = False  # it writes the data set, too
    continues: bool = False  # interrupted, it goes on with what it wrote already

    @property
    def files(self) -> tuple[str, ...]:
        """All that it may write in the folder of work."""
        return (*self.results, *self.sometimes, *self.extras, self.picture)


def say(line: str) -> str:
    """A line as a sentence."""
    return f"{line[0].upper()}{line[1:]}."
