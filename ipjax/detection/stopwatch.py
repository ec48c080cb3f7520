"""Seconds by stage, what is compiled inside of a stage apart."""

import contextlib
import time
from collections.abc import Iterator


class Stopwatch:
    """``with watch("stage"):`` adds to ``watch.spent["stage"]``; seconds that were added to ``"compile"`` meanwhile are
    left out."""

    def __init__(self):
        self.spent: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start, compiled = time.perf_counter(), self.spent.get("compile", 0.0)
        try:
            yield
        finally:
            lasted = time.perf_counter() - start - (self.spent.get("compile", 0.0) - compiled)
            self.spent[stage] = self.spent.get(stage, 0.0) + lasted

    def move(self, name: str, seconds: float, stage: str) -> None:
        """Count some of a stage's seconds as another's."""
        if seconds:
            self.spent[name] = self.spent.get(name, 0.0) + seconds
            self.spent[stage] -= seconds
