"""``ipjax capture refine``: from poses to exact ones, a picture, and words about how well each is known."""

import json

import numpy as np
import pytest
from builders.command_lines import run
from builders.ray_cast import SIZE, K, cast, go_around
from PIL import Image

from ipjax.capture.records import Trajectory
from ipjax.capture.refinement.certainty import off_by
from ipjax.capture.trajectories import read_trajectory, write_trajectory
from ipjax.transforms import Similarity

NAMES = tuple(f"{k:06d}" for k in range(6))


@pytest.fixture
def table(tmp_path):
    """A folder of frames, and a folder of poses that are off."""
    truth = go_around(len(NAMES), arc=2.4)
    depth = cast(truth, noise=0.001)
    for name, image in zip(NAMES, depth, strict=True):
        for kind in ("rgb", "depth"):
            (tmp_path / "table" / kind).mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.round(image * 1e4).astype(np.uint16)).save(tmp_path / "table" / "depth" / f"{name}.png")
        shade = np.uint8(np.clip(image, 0, 1) * 200)
        Image.fromarray(np.stack([shade] * 3, -1)).save(tmp_path / "table" / "rgb" / f"{name}.png")
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": SIZE[0], "height": SIZE[1]}
    (tmp_path / "table" / "camera.json").write_text(json.dumps({**camera, "depth_scale": 0.1}))
    step = np.random.default_rng(1).normal(size=(len(NAMES), 6)) * np.repeat([np.deg2rad(1), 0.008], 3)
    work = tmp_path / "work"
    work.mkdir()
    start = Trajectory(NAMES, truth @ Similarity.exp(step), np.ones(len(NAMES), bool), "given")
    write_trajectory(work / "poses.json", start)
    return truth, tmp_path / "table", work


def test_refines_poses(table, capfd):
    truth, folder, work = table
    assert run(["capture", "refine", str(folder), "-o", str(work), "--quiet", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["sure"] == list(NAMES) and told["remarks"] == {} and told["camera_from_depth"] is None
    found = read_trajectory(told["poses"])
    error = off_by(found.world_from_camera, truth)
    assert found.source == "refined" and found.covariance is not None
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.003
    report = json.loads((work / "refinement.json").read_text())
    assert np.median(report["neighbours_apart_after"]) < 0.5 * np.median(report["neighbours_apart_before"])
    with Image.open(work / "refinement.png") as picture:
        assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 6
    first = (work / "refined.json").read_bytes()
    assert run(["capture", "refine", str(folder), "-o", str(work), "--quiet"]) == 0
    assert (work / "refined.json").read_bytes() == first
    said = capfd.readouterr().out
    assert "6 of 6 poses are sure" in said and "mm before" in said


def test_raw_depth_alone_is_enough(table, capfd):
    truth, folder, work = table
    (folder / "depth").rename(folder / "raw")
    camera = json.loads((folder / "camera.json").read_text())
    (folder / "depth_camera.json").write_text(json.dumps({**camera, "colour_from_depth": np.eye(4).tolist()}))
    assert run(["capture", "refine", str(folder), "-o", str(work), "--quiet"]) == 0
    assert "6 of 6 poses are sure" in capfd.readouterr().out
    error = off_by(read_trajectory(work / "refined.json").world_from_camera, truth)
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.003
    (folder / "depth_camera.json").unlink()
    assert run(["capture", "refine", str(folder), "-o", str(work), "--quiet"]) == 2
    assert "depth_camera.json" in capfd.readouterr().err


def test_refuses_in_words(table, capfd):
    _, folder, work = table
    assert run(["capture", "refine", str(folder), "-o", str(work / "elsewhere"), "--quiet"]) == 2
    assert "poses.json" in capfd.readouterr().err
    assert run(["capture", "refine", str(folder), "-o", str(work), "--every", "2", "--quiet"]) == 2
    assert "other frames" in capfd.readouterr().err
