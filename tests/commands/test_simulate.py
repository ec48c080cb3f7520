"""``ipjax simulate``: a made object is picked, told and shown; what cannot be simulated gets one line."""

import json
import re

import numpy as np
import pytest
from builders.cells import make_block
from builders.command_lines import run
from builders.objects import make_object as make_onboarded

from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.depth import read_depth
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.objects.saving import save
from ipjax.files.rigid import read_rigid


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    path = tmp_path_factory.mktemp("block") / "block.ply"
    save_mesh(make_block(), path)
    return path


def test_a_pick_is_told_and_shown(block, tmp_path, capfd):
    out = tmp_path / "out"
    out.mkdir()
    (out / "film.mp4").write_bytes(b"of an earlier pick")
    words = ["simulate", "--mesh", block, "--true-pose", "--arm", "gantry", "--mass", 0.3, "--seed", 2, "--no-film"]
    assert run([*map(str, words), "-o", str(out), "--json"]) == 0
    printed = capfd.readouterr().out
    told = json.loads(printed)
    assert json.loads((out / "result.json").read_text()) == told
    assert told["pick"]["success"] and told["possible"] and told["planned"] > 0 and told["pose"] is None
    assert told["decision"] is None, "nothing is uncertain about the true pose"
    assert (told["arm"], told["gripper"], told["mass_kg"], told["film"]) == ("gantry", "franka", 0.3, None)
    assert not (out / "film.mp4").exists()
    page = (out / "simulation.html").read_text()
    assert "Success: lifted by" in page and page.count("<img") == 3 and "300 g" in page
    assert not re.search(r'(src|href)="(?!data:)', page)

    # The frame is there for the other commands, and the block lies on the table in it.
    camera = read_camera(out / "camera.json")
    depth = 1e-4 * read_depth(out / "depth.png")
    base_from_camera = read_rigid(out / "base_from_camera.json", "base_from_camera")
    rows, columns = np.nonzero(depth > 0)
    K = camera.matrix
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(len(rows))], -1)
    heights = (base_from_camera @ (rays * depth[rows, columns][:, None]))[:, 2]
    assert abs(np.median(heights)) < 0.003


@pytest.mark.parametrize(
    "words, answer",
    [
        ((), "give an object file"),
        (("--true-pose", "--seed", "-1"), "--seed must be"),
        (("--true-pose", "--mass", "0"), "--mass must be above 0"),
        (("--true-pose", "--clutter", "40"), "--clutter must be from 0 to 12"),
        (("--true-pose", "--gripper", "claw"), "claw: neither franka, robotiq nor a file"),
        (("--true-pose", "--gripper", "robotiq", "--arm", "panda"), "has the Franka hand, not robotiq"),
        (("--true-pose", "--mesh", "none.ply"), "none.ply"),
        (("--true-pose", "--unit", "mm"), "--unit is that of --mesh"),
        (("--true-pose", "--mesh", "BLOCK", "--unit", "mm"), "is its unit right"),
        (("--true-pose", "--detect"), "not allowed with"),
        (("OBJECT", "--true-pose"), "mug is 3.54 mm large"),
    ],
)
def test_what_cannot_be_simulated_is_told(words, answer, block, tmp_path, capfd):
    save(tmp_path / "mug.ipjax", *make_onboarded())
    names = {"BLOCK": str(block), "OBJECT": str(tmp_path / "mug.ipjax")}
    status = run(["simulate", *(names.get(word, word) for word in words), "-o", str(tmp_path / "out")])
    told = capfd.readouterr().err
    assert status == 2 and answer in told and "Traceback" not in told, told
    assert told.count("\n") == 1
