"""``ipjax score``: what is wrong with a result file or a data set is told in a sentence."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from builders.bop_roots import true_rows, write_images

from ipjax.bop.dataset import Dataset
from ipjax.bop.results import HEADER, write_results

ROW = "0,0,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,0.5"


@pytest.fixture
def scored(tmp_path, monkeypatch, capfd):
    """Runs ``ipjax score`` on a small data set, damaged before: (status, standard output, standard error)."""
    from ipjax import cli

    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.delenv("IPJAX_DEBUG", raising=False)
    root, path = write_images(tmp_path / "small", images=2), tmp_path / "mine_small-test.csv"
    path.write_text(f"{HEADER}\n{ROW}\n")

    def run(damage, *words):
        damage(root, path)
        try:
            status = cli.main(["score", str(path), str(root), "--metrics", "mssd", "mspd", *words])
        except SystemExit as stop:
            status = stop.code
        return (status, *capfd.readouterr())

    return run


def rows(*lines):
    return lambda root, path: path.write_text("\n".join([HEADER, ROW, *lines]) + "\n")


def written(name, text):
    return lambda root, path: (root / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700"), "mine_small-test.csv, line 3: .*7 columns"),
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0,0 0 700,1"), "mine_small-test.csv, line 3: R must hold 9 numbers, got 8"),
        (rows("0,1,2,nan,1 0 0 0 1 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: .*not finite"),
        (rows("0,1,2,1.0,1 0 0 0 nan 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: .*not finite"),
        (rows("0,1,77,1.0,1 0 0 0 1 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: the data set has no object 77"),
        (rows(ROW), "mine_small-test.csv, line 3: .*same as that of line 2"),
        (rows("0,9,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,1"), "line 3: the data set has no image 9 in scene 0"),
        (
            rows("0,1,2,1.0,1.3 0 0 0 1.3 0 0 0 1.3,0 0 700,1"),
            r"line 3: R is no rotation: it scales by 1.3 .*2.197",
        ),
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0 -1,0 0 700,1"), r"line 3: R is no rotation: it mirrors \(det R = -1,"),
        (rows("0,1,2,1.0,1 0.3 0 0 1 0 0 0 1,0 0 700,1"), "line 3: R is no rotation: its rows are not at right angles"),
        (rows("0,1,2,1.0,0 0 0 0 0 0 0 0 0,0 0 700,1"), "line 3: R is no rotation: "),
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,-2"), "line 3: time must be seconds, or -1 .*, got -2"),
        (rows("0,1,2,inf,1 0 0 0 1 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: score .*not finite"),
        (rows("8,0,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,1"), "line 3: the data set has no image 0 in scene 8"),
        (lambda root, path: path.write_text("scene_id,im_id\n"), "mine_small-test.csv, line 1: the header must be"),
        (lambda root, path: path.unlink(), "mine_small-test.csv: .*cannot be read"),
        (lambda root, path: (root / "test/000000/rgb/000001.png").unlink(), "000001.png: no such image"),
        (lambda root, path: (root / "models_eval/obj_000003.ply").unlink(), "obj_000003.ply: no such model"),
        (written("test/000000/scene_gt.json", '{"0": [\n}'), "scene_gt.json: not valid JSON: line 2"),
        (
            written("test/000000/scene_gt.json", '{"0": [], "1": []}'),
            "1 instances of object 2 in scene 0, image 0, but 0",
        ),
        (
            written(
                "test/000000/scene_gt.json",
                '{"0": [{"obj_id": 2, "cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, -1], "cam_t_m2c": [0, 0, 700]}]}',
            ),
            "scene_gt.json, image 0, instance 0: cam_R_m2c: R is no rotation: it mirrors",
        ),
        (
            written("test/000000/scene_camera.json", '{"0": {"cam_K": [1]}}'),
            "scene_camera.json, image 0: cam_K must be 9",
        ),
        (written("models_eval/models_info.json", '{"2": {"diameter": 1}}'), "no object 3"),
        (written("test_targets_bop19.json", '[{"scene_id": 0}]'), "test_targets_bop19.json, entry 0: "),
    ],
)
def test_the_command_names_what_is_malformed(scored, damage, says):
    status, out, error = scored(damage)
    assert status == 2 and out == ""
    assert error.count("\n") == 1 and "Traceback" not in error
    assert re.search(says, error), error


def turned(change):
    """All annotated poses, changed as a whole."""

    def damage(root, path):
        write_results(path, [change(row) for row in true_rows(Dataset(root))])

    return damage


def moved(factor):
    return lambda row: replace(row, translation=tuple(np.multiply(row.translation, factor)))


def opposite(row):
    """As OpenGL would have it: y up, z behind."""
    flip = np.diag([1.0, -1, -1])
    rotation = flip @ np.reshape(row.rotation, (3, 3))
    return replace(row, rotation=tuple(rotation.ravel()), translation=tuple(flip @ row.translation))


def strayed(row):
    return replace(row, obj_id=1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (moved(1e-3), "1000 times too small .* must be in millimetres; it seems to be in metres"),
        (moved(0.1), "10 times too small .* must be in millimetres; it seems to be in centimetres"),
        (moved(1 / 25.4), "25.4 times too small .* must be in millimetres; it seems to be in inches"),
        (moved(1e3), "1000 times too large .* must be in millimetres"),
        (opposite, "behind the camera .*: poses must be in OpenCV axes"),
        (strayed, "none of the 4 estimates is of a target"),
    ],
)
def test_the_command_says_what_is_wrong_with_all_of_a_file(scored, change, says):
    """Files that would score 0 without a hint, though every row is in order."""
    status, out, error = scored(turned(change))
    assert status == 2 and out == "" and error.count("\n") == 1
    assert re.search(says, error), error
    status, out, _ = scored(lambda *_: None, "--skip-bad")
    assert status == 0 and re.search(f"Note: .*{says}", out)


@pytest.mark.parametrize("change", [moved(1.6), moved(0.6), moved((1, 1, -0.1)), moved((-5, -5, 1))])
def test_what_is_merely_wrong_is_scored(scored, change):
    """A method that fails on every target is no file in another unit."""
    assert scored(turned(change))[0] == 0


def test_the_command_scores_and_goes_on_where_asked(scored, tmp_path):
    bad = "0,1,2,1.0,1 0 0 0 1 0 0 0,0 0 700,1"
    status, out, _ = scored(rows(bad), "--skip-bad", "--without", "0/1", "-o", str(tmp_path / "score.json"))
    assert status == 0 and "1 problems, the first: " in out and "R must hold 9 numbers" in out
    assert "all frames, without 0/1" in out
    kept = json.loads((tmp_path / "score.json").read_text())
    assert kept["all_frames"]["targets"] == 4 and len(kept["problems"]) == 1 and set(kept["without"])
