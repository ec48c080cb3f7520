"""``ipjax capture depth``: from frames, raw depth and poses to depth in the pixels of the colours, and words."""

import json

import numpy as np
import pytest
from builders.command_lines import run
from PIL import Image

from ipjax.capture.reading.opening import open_capture
from ipjax.capture.records import Trajectory
from ipjax.capture.trajectories import write_trajectory
from ipjax.synthetic.captures import make_capture, write_capture

VIEWS = 6


@pytest.fixture(scope="module")
def made():
    """A third of the way around a table, in small images; the factory is three times as wrong as most."""
    return make_capture(12, views=VIEWS, arc=90, size=(160, 120), factory_error=3)


@pytest.fixture(scope="module")
def folder(made, tmp_path_factory):
    return write_capture(made, tmp_path_factory.mktemp("table"))


@pytest.fixture(scope="module")
def poses(made, tmp_path_factory):
    path = tmp_path_factory.mktemp("poses") / "poses.json"
    return write_trajectory(path, Trajectory(made.names, made.world_from_camera, np.ones(VIEWS, bool), "given"))


def errors(made, depth) -> np.ndarray:
    """Of the objects that are known, metres; frame after frame."""
    known = (made.ids >= 0) & (depth > 0)
    return np.abs(depth - made.true_depth)[known]


def test_depth_is_solved_fused_and_goes_on_where_it_was(made, folder, poses, tmp_path, capfd):
    work = tmp_path / "work"
    status = run(["capture", "depth", str(folder), "--poses", str(poses), "-o", str(work), "--quiet", "--json"])
    told = json.loads(capfd.readouterr().out)
    assert told["mode"] == "solve" and told["made"] == VIEWS and status == (0 if told["trusted"] else 1)
    assert set(told["figures"]) == {"solve", "paper", "factory"}
    assert told["figures"]["solve"]["filled"] > told["figures"]["factory"]["filled"]
    again = open_capture(work)
    assert again.form == "frames" and again.names == made.names
    np.testing.assert_allclose(again.camera.to_matrix(), made.camera.to_matrix(), rtol=1e-6)
    depth = np.stack([np.asarray(again.read_frame(k).depth) for k in range(VIEWS)])
    np.testing.assert_array_equal(again.read_frame(0).rgb, made.rgb[0])
    objects = made.ids >= 0
    if told["trusted"]:
        assert np.median(errors(made, depth)) < 0.6 * np.median(errors(made, made.depth))
    assert (depth > 0)[objects].mean() > 0.9
    with Image.open(work / "confidence" / "000003.png") as image:
        confidence = np.asarray(image)
    assert ((confidence > 0) == (depth[3] > 0)).all() and confidence.max() > 150
    with Image.open(work / "depth_pictures" / "000003.jpg") as image:
        assert image.size == (320, 240)
    before = {path.name: path.read_bytes() for path in (work / "depth").iterdir()}
    kept = (work / "depth" / "000001.png").stat().st_mtime_ns
    (work / "depth" / "000005.png").unlink()
    assert run(["capture", "depth", str(folder), "--poses", str(poses), "-o", str(work), "--quiet", "--json"]) == status
    assert json.loads(capfd.readouterr().out)["made"] == 1
    assert {path.name: path.read_bytes() for path in (work / "depth").iterdir()} == before
    assert (work / "depth" / "000001.png").stat().st_mtime_ns == kept


def test_the_factory_is_a_mode(made, folder, poses, tmp_path, capfd):
    command = ["capture", "depth", str(folder), "--poses", str(poses), "-o", str(tmp_path), "--mode", "factory"]
    assert run([*command, "--quiet"]) == 0
    assert "of the pixels are known." in capfd.readouterr().out
    depth = open_capture(tmp_path).read_frame(2).depth
    np.testing.assert_allclose(np.asarray(depth), made.depth[2], atol=1e-4)


def test_refuses_in_one_line(folder, poses, tmp_path, capfd):
    for words, said in (
        ([str(folder), "-o", str(tmp_path)], "make it with ipjax capture pose"),
        ([str(folder), "-o", str(folder), "--poses", str(poses)], "would replace the capture's own"),
        (
            [str(folder), "-o", str(tmp_path), "--poses", str(poses), "--every", "2"],
            "give those that ipjax capture pose",
        ),
    ):
        assert run(["capture", "depth", *words, "--quiet"]) == 2
        err = capfd.readouterr().err
        assert err.startswith("ipjax: ") and said in err and err.count("\n") == 1
