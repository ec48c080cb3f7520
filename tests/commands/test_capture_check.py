"""``ipjax capture check``: what it says, its page, its JSON and its exit status."""

import json

import numpy as np
import pytest

from ipjax.cli import main
from ipjax.synthetic.captures import make_capture, write_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = make_capture(4, views=3, objects=2, size=(160, 120), arc=30)
    return write_capture(made, tmp_path_factory.mktemp("capture"), poses=True)


def test_says_what_is_there_and_writes_a_page(folder, tmp_path, capsys):
    page = tmp_path / "check.html"
    assert main(["capture", "check", str(folder), "-o", str(page), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "looks wrong:" in said and "is there:" in said and "There are only 3 frames" in said
    text = page.read_text()
    assert text.count("<figure") == 3 and "There are only 3 frames" in text and "data:image/jpeg" in text


def test_json_has_every_measure(folder, capsys):
    assert main(["capture", "check", str(folder), "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["usable"] and document["form"] == "frames" and len(document["frames"]) == 3
    assert [pair["frames"] for pair in document["pairs"]] == [["000000", "000001"], ["000001", "000002"]]
    assert all(finding["kind"] in ("looks wrong", "is there") for finding in document["findings"])


def test_what_cannot_be_used_exits_with_one(folder, tmp_path, capsys):
    import shutil

    here = shutil.copytree(folder, tmp_path / "copy")
    poses = json.loads((here / "poses.json").read_text())
    (here / "poses.json").write_text(json.dumps({name: np.linalg.inv(pose).tolist() for name, pose in poses.items()}))
    assert main(["capture", "check", str(here), "--quiet"]) == 1
    assert "CANNOT BE USED" in capsys.readouterr().out
    (here / "camera.json").unlink()
    assert main(["capture", "check", str(here)]) == 2
    assert "camera.json" in capsys.readouterr().err
    assert main(["capture", "check", str(folder), "-o", str(tmp_path / "check.txt")]) == 2
