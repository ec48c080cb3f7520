"""Bars on a terminal, a line now and then in a log."""

import io
import sys
import time

import pytest

from ipjax.progress import bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "least", "most"), [(Terminal(), 4, 40), (io.StringIO(), 1, 3)])
def test_a_log_is_not_filled(monkeypatch, stream, least, most):
    """A second of work: on a terminal the bar moves, elsewhere it begins and ends."""
    monkeypatch.setattr(sys, "stderr", stream)
    for _ in bar(range(40), desc="working"):
        time.sleep(0.025)
    lines = [line for line in stream.getvalue().split("\r") if "working" in line]
    assert least <= len(lines) <= most
    assert "40/40" in lines[-1]
