"""The command: help that teaches, one spelling of each option, and every failure in one line."""

import json
import os
import re
import subprocess
import sys

import pytest
from builders.command_lines import estimate_words, run

from ipjax import cli


def test_debug_shows_the_traceback(case, monkeypatch):
    monkeypatch.setenv("IPJAX_DEBUG", "1")
    with pytest.raises(ValueError, match="no such file"):
        cli.main(estimate_words(case, rgb="none.png"))


COMMANDS = (
    "onboard",
    "estimate",
    "grasp",
    "simulate",
    "demo",
    "doctor",
    "weights",
    "score",
    "evaluate",
    "capture",
    "calibrate",
    "label",
    "degrade",
    "export",
)


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_teaches_by_examples(name, capfd):
    assert run([*name.split(), "--help"]) == 0
    out = capfd.readouterr().out
    assert "ipjax" in out and ("example" in out or "start here" in out)


@pytest.mark.parametrize(
    "words",
    [
        "--version",
        "--help",
        *(f"{name} --help" for name in COMMANDS),
        "weights fetch --help",
        "capture check --help",
        "capture pose --help",
        "capture run --help",
    ],
)
def test_help_and_version_load_nothing_but_the_command(words):
    """A count, for time would depend on the machine: 97 modules where there once were 897."""
    program = (
        "import json, sys\nbefore = set(sys.modules)\nfrom ipjax import cli\n"
        f"try: cli.main({words.split()!r})\nexcept SystemExit as end: assert end.code == 0\n"
        "print(json.dumps(sorted(set(sys.modules) - before)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    loaded = json.loads(done.stderr.splitlines()[-1])
    assert all(name in ("ipjax", "ipjax.cli") for name in loaded if re.match(r"ipjax\b(?!\.commands)", name))
    assert {name.split(".")[0] for name in loaded} <= {"ipjax", *sys.stdlib_module_names}
    assert len(loaded) < 130


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["estimate", "a.ipjax", "--box", "210", "130", "90", "120"], "with commas and no spaces, X,Y,W,H"),
        (["estimate", "a.ipjax", "--box", "-1,2,3,4"], "begins with a minus is written --box=-1"),
        (["estimate", "a.ipjax", "--box", "210,130,90"], "is no box"),
        (["onboard", "a.png", "-o", "a.ipjax", "--box", "1,2,3,nan"], "is no box"),
        (["estimate", "a.ipjax", "--method", "best"], "--method is called --config now: default"),
        (["evaluate", "data", "-o", "out", "--method", "fast"], "--method is called --config now"),
        (
            ["export", "a.ipjax", "-o", "a.stablehlo", "--config", "best"],
            "best: neither default, fast, paper nor a file",
        ),
        (["score", "a.csv", "data", "--json", "s.json"], "--json takes no file: it prints to the screen, and -o FILE"),
        (
            ["export", "a.ipjax", "-o", "a.stablehlo", "--set", "match.view=4"],
            "--set: there is no setting 'match.view'; n",
        ),
        (
            ["evaluate", "data", "-o", "out", "--set", "match.views=x"],
            "match.views: a whole number from 1 is",
        ),
        (["evaluate", "data", "-o", "out", "--set", "views"], "--set: 'views': give FIELD=VALUE, for instance match"),
        (["demo", "--seed", "-1"], "--seed must be from 0 to 4294967295"),
    ],
)
def test_one_spelling_and_a_word_for_the_old_one(words, said, capfd):
    assert run(words) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and said in error, error


def test_the_module_runs_and_fails_in_one_line(case):
    words = [sys.executable, "-m", "ipjax", *estimate_words(case, mask="none.png")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "no such file" in done.stderr


@pytest.mark.parametrize("platform", ["cuda", "nonsense"])
def test_devices_that_are_not_here_are_told_in_one_line(case, platform):
    environment = os.environ | {"JAX_PLATFORMS": platform}
    for words in (["doctor"], [*map(str, estimate_words(case))]):
        done = subprocess.run(
            [sys.executable, "-m", "ipjax", *words], capture_output=True, text=True, timeout=120, env=environment
        )
        assert "Traceback" not in done.stdout + done.stderr
        assert f"JAX_PLATFORMS={platform} asks for devices" in done.stdout + done.stderr
        assert done.returncode == (1 if words == ["doctor"] else 2)
        assert done.stderr.count("\n") == (0 if words == ["doctor"] else 1)


def parsers(parser, name="ipjax"):
    """Every parser that takes options of its own, by its command."""
    inner = [action for action in parser._actions if hasattr(action, "choices") and isinstance(action.choices, dict)]
    if not inner:
        yield name, parser
    for action in inner:
        for word, one in action.choices.items():
            yield from parsers(one, f"{name} {word}")


def test_the_same_thing_is_spelled_the_same_way_everywhere():
    found = dict(parsers(cli.build_parser()))
    assert {name.split()[1] for name in found} == set(COMMANDS)
    spelled: dict[str, set] = {}
    for name, parser in found.items():
        options = {option: action for action in parser._actions for option in action.option_strings}
        assert "--json" in options, f"{name} has no --json"
        assert ("--config" in options) <= ("--set" in options), f"{name} has --config, but no --set"
        assert "--output" not in options or "-o" in options
        for option, action in options.items():
            spelled.setdefault(option, set()).add((action.metavar, str(action.type), str(action.choices)))
    for option in ("--box", "--config", "--set", "--weights", "--json", "--camera", "--mask", "--depth", "--seed"):
        assert len(spelled[option]) == 1, (option, spelled[option])


def test_another_shell_does_not_need_argcomplete(monkeypatch):
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    monkeypatch.setenv("_ARGCOMPLETE", "1")
    assert run(["--version"]) == 0
