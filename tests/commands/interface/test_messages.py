"""What a command says: plain where a program reads it, fitted and coloured on a terminal, one document as JSON."""

import io
import json
import logging
import sys

import pytest

from ipjax.commands.interface.messages import Messages

ROWS = [("short", "1"), ("a longer name", "22")]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def spoken(monkeypatch, stream) -> str:
    monkeypatch.setattr(sys, "stdout", stream)
    messages = Messages()
    messages.show(("name", "count"), ROWS)
    messages.say(" fine", mark="ok ", style="green")
    messages.say("[brackets] are no markup, 3 is no number to colour")
    return stream.getvalue()


def test_columns_are_stable_where_a_program_reads_them(monkeypatch):
    assert spoken(monkeypatch, io.StringIO()).splitlines() == [
        "name           count",
        "short          1",
        "a longer name  22",
        "ok  fine",
        "[brackets] are no markup, 3 is no number to colour",
    ]


def test_a_terminal_is_coloured_and_nothing_is_cut_off(monkeypatch):
    for name, value in {"TERM": "xterm-256color", "COLUMNS": "18"}.items():
        monkeypatch.setenv(name, value)
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    text = spoken(monkeypatch, Terminal())
    assert "\x1b[32mok" in text and "…" not in text and "[brackets] are no markup" in text
    assert "longer" in text and "22" in text
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[32m" not in spoken(monkeypatch, Terminal())


def test_with_json_only_the_document_is_on_the_standard_output(capsys):
    messages = Messages(json=True)
    with messages.capturing_logs():
        print("a progress report of something deeper")
        messages.say("for people")
        messages.show(("name", "count"), ROWS)
        logging.getLogger("ipjax").info("a note")
        messages.print_notes()
        messages.finish({"size": 0.5, "name": "mug ½"})
    out, error = capsys.readouterr()
    assert json.loads(out) == {"size": 0.5, "name": "mug ½"}
    assert error.splitlines() == ["a progress report of something deeper", "a note"]
    with pytest.raises(ValueError, match="JSON"):
        messages.finish({"size": float("nan")})


def test_notes_are_held_back_until_they_are_printed_once(capsys):
    messages, quiet = Messages(), Messages(quiet=True)
    log = logging.getLogger("ipjax")
    level = log.level
    with messages.capturing_logs(), quiet.capturing_logs():
        for _ in range(3):
            log.warning("the same")
        assert capsys.readouterr().err == ""
        messages.print_notes()
        quiet.print_notes()
        quiet.note("nothing")
    assert capsys.readouterr().err == "the same\n" and messages.warnings == ["the same"] * 3
    log.warning("after the command")
    assert messages.warnings == ["the same"] * 3 and log.level == level
