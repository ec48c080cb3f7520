"""Tab: the shell asks the command in its own way, and is answered without anything heavy being loaded."""

import os
import subprocess
import sys

import pytest

from ipjax.commands.interface.completion import read_field_names
from ipjax.config import Config, OnboardConfig
from ipjax.files.settings import list_fields
from ipjax.files.weights.catalogue import CATALOGUE

PROGRAM = """
import sys
sys.argv[0] = "ipjax"
import atexit, os
from ipjax import cli
leave = os._exit
def note(status):
    heavy = {"jax", "numpy", "equinox", "rich"} & set(sys.modules)
    leave(9 if heavy else status)
os._exit = note
cli.main()
"""


def complete(line: str, folder) -> list[str]:
    """What a shell is offered after ``line``."""
    pytest.importorskip("argcomplete")
    answer = folder / "answer"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    asked |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    asked |= {"_ARGCOMPLETE_SUPPRESS_SPACE": "1", "COMP_TYPE": "9"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=os.environ | asked, capture_output=True, text=True, cwd=folder, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return [word.strip() for word in answer.read_text().split("\n") if word]


def test_names_of_settings_are_those_that_there_are():
    for config in (Config(), OnboardConfig()):
        assert list(read_field_names(type(config).__name__)) == [name for name, _ in list_fields(config)]


def test_a_shell_is_offered_what_may_follow(tmp_path):
    assert complete("ipjax es", tmp_path) == ["estimate"]
    assert {"--config", "--set", "--json"} <= set(complete("ipjax export --", tmp_path))
    assert complete("ipjax estimate --set match.cy", tmp_path) == ["match.cycle="]
    assert complete("ipjax estimate --config f", tmp_path) == ["fast"]
    assert complete("ipjax onboard --set describe.c", tmp_path) == ["describe.cover="]
    assert set(complete("ipjax weights fetch vits", tmp_path)) == {n for n in CATALOGUE if n.startswith("vits")}
    (tmp_path / "mug.ipjax").write_text("")
    assert complete("ipjax doctor mu", tmp_path) == ["mug.ipjax"]
