"""``ipjax capture views``: a frame that was left out, drawn from the others, as a data set in BOP's layout."""

import dataclasses
import json

import numpy as np
import pytest
from builders.command_lines import run
from PIL import Image

from ipjax.bop.dataset import Dataset
from ipjax.capture.records import Trajectory
from ipjax.capture.trajectories import write_trajectory
from ipjax.synthetic.captures import make_capture, write_capture
from ipjax.synthetic.sensor import PERFECT

OUT = 3  # the frame that is left out


@pytest.fixture(scope="module")
def made():
    return make_capture(5, views=7, arc=80, size=(128, 96), objects=2, sensor=PERFECT, factory_error=0)


@pytest.fixture(scope="module")
def work(made, tmp_path_factory):
    """The capture on disc, with its true depth; the poses of all frames but that one; a file of a path."""
    root = tmp_path_factory.mktemp("views")
    write_capture(dataclasses.replace(made, depth=made.true_depth), root / "table", raw=False)
    poses = Trajectory(made.names, made.world_from_camera, np.arange(7) != OUT, "given")
    write_trajectory(root / "given.json", poses)
    path = made.world_from_camera.to_matrix()[[OUT, OUT - 1]].tolist()
    (root / "path.json").write_text(json.dumps(path))
    return root


def words(work, *more):
    given = ["capture", "views", str(work / "table"), "--poses", str(work / "given.json"), "-o", str(work / "work")]
    return [*given, "--quiet", *map(str, more)]


def test_a_left_out_frame_is_drawn_from_the_others(made, work, capfd):
    assert run(words(work, "--path", work / "path.json", "--json")) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["made"] and told["views"] == 2 and told["objects"] == []
    dataset = Dataset(work / "work" / "views")
    assert dataset.images(0) == [0, 1]
    K, _ = dataset.camera(0, 0)
    np.testing.assert_allclose(K, made.camera.to_matrix(), rtol=1e-5)
    document = json.loads(((dataset.root / "test" / "000000") / "scene_camera.json").read_text())
    pose = made.world_from_camera.inverse().to_matrix()[OUT]
    np.testing.assert_allclose(np.reshape(document["0"]["cam_R_w2c"], (3, 3)), pose[:3, :3], atol=1e-6)
    np.testing.assert_allclose(document["0"]["cam_t_w2c"], 1000 * pose[:3, 3], atol=1e-3)
    rgb, depth = dataset.frame(0, 0).rgb, dataset.depth(0, 0)
    unknown = np.asarray(Image.open((dataset.root / "test" / "000000") / "unknown" / "000000.png")) > 0
    assert ((depth == 0) == unknown).all() and (rgb[unknown] == 0).all() and 0.001 < unknown.mean() < 0.2
    off = np.abs(depth - made.true_depth[OUT])[~unknown]
    assert np.median(off) < 0.0005 and (off < 0.005).mean() > 0.96
    wrong = np.abs(rgb.astype(float) - made.rgb[OUT])[~unknown].max(-1)
    assert np.median(wrong) < 5 and (wrong < 25).mean() > 0.9
    with Image.open(work / "work" / "views.png") as picture:
        assert picture.size == (2 * 480 + 4, 180)
    assert run(words(work, "--path", work / "path.json")) == 0
    assert "made of the same already" in capfd.readouterr().out


@pytest.mark.parametrize("path", ["orbit", "smooth"])
def test_paths_of_its_own(path, work, capfd):
    root = work / path
    assert run(words(work, "--path", path, "--count", 2, "--dataset", root)) == 0
    assert "2 views from 6 frames" in capfd.readouterr().out
    assert len(list((root / "test" / "000000" / "rgb").iterdir())) == 2


def test_what_is_wrong_is_said_in_a_sentence(work, tmp_path, capfd):
    (tmp_path / "path.json").write_text("[]")
    assert run(words(work, "--path", tmp_path / "path.json")) == 2
    assert run(words(work, "--path", work / "path.json", "--count", 3)) == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    assert run(words(work, "--dataset", tmp_path / "mine")) == 2
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "precious"
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 3 and "4 × 4" in lines[0] and "--count" in lines[1] and "not replaced" in lines[2]
