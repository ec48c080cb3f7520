"""``ipjax degrade``: the worse mesh, and the map back, which is the same on the screen and in its file."""

import json

import trimesh
from builders.command_lines import run


def test_the_map_back_is_told(case, capfd):
    trimesh.creation.box((1, 0.6, 0.3)).export(case / "box.ply")
    words = ["degrade", case / "box.ply", "-o", case / "worse.glb", "--level", 1, "--alignment", case / "back.json"]
    assert run([*map(str, words), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["alignment"] == json.loads((case / "back.json").read_text())
    assert (told["level"], told["seed"]) == (1, 0) and (case / "worse.glb").stat().st_size > 1000
    first = (case / "worse.glb").read_bytes()
    assert run([*map(str, words)]) == 0
    assert capfd.readouterr().out == f"{case / 'worse.glb'}: level 1\n"
    assert (case / "worse.glb").read_bytes() == first
    assert run(["degrade", str(case / "box.ply"), "-o", str(case / "worse.obj")]) == 2
    assert "must end in .glb" in capfd.readouterr().err
