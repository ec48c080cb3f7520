"""``ipjax export``: the artifact, and the settings it was made with, on the screen and beside it."""

import dataclasses
import json

import pytest
from builders.command_lines import run
from builders.objects import make_object

from ipjax.files.objects.saving import save
from ipjax.synthetic import problems


def test_the_settings_are_told(tmp_path, capfd):
    pytest.importorskip("flatbuffers")
    info = dataclasses.replace(make_object()[1], pictures=None, resolution=112)
    save(tmp_path / "ball.ipjax", problems.make_templates(), info)
    out = tmp_path / "quick.stablehlo"
    words = ["export", tmp_path / "ball.ipjax", "-o", out, "--config", "paper", "--set", "align.count=32"]
    assert run([*map(str, words), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["bytes"] == out.stat().st_size and told["artifact"] == str(out)
    assert told["description"] == json.loads((tmp_path / "quick.stablehlo.json").read_text())
    config = told["description"]["config"]
    assert (config["align"]["count"], config["refine"]["steps"], config["match"]["cycle"]) == (32, 0, "inf")
