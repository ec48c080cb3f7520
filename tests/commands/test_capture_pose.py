"""``ipjax capture pose``: from a folder of frames to poses in metres, a picture, and words; refusals in one line."""

import json
import shutil

import numpy as np
import pytest
from builders.command_lines import run
from builders.recognised import compare
from PIL import Image

from ipjax.capture.poses.tracks import read_tracks
from ipjax.capture.trajectories import read_trajectory
from ipjax.synthetic.captures import make_capture, write_capture
from ipjax.synthetic.sensor import PERFECT


@pytest.fixture(scope="module")
def made():
    """An eighth of the way around a table, in small images."""
    return make_capture(3, views=7, arc=45, size=(320, 240), sensor=PERFECT, factory_error=0)


@pytest.fixture(scope="module")
def folder(made, tmp_path_factory):
    return write_capture(made, tmp_path_factory.mktemp("table"))


def test_finds_poses(made, folder, tmp_path, capfd):
    work = tmp_path / "work"
    assert run(["capture", "pose", str(folder), "-o", str(work), "--quiet", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["registered"] == 7 and told["without_a_pose"] == [] and told["agreement"] > 0.7
    found = read_trajectory(told["poses"])
    assert found.names == made.names and found.source == told["source"] == "features and depth"
    apart, turned = compare(found.world_from_camera, made.world_from_camera, found.registered)
    assert apart.max() < 0.006 and turned.max() < 0.5
    tracks = read_tracks(work / "tracks.npz")
    assert tracks.count == told["points"] > 50 and tracks.frame.max() == 6
    with Image.open(work / "trajectory.png") as picture:
        assert picture.size[0] == 1440 and len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 20
    assert {path.name for path in work.iterdir()} >= {"poses.json", "tracks.npz", "trajectory.png"}
    before = (work / "poses.json").read_bytes()
    (work / "refined.json").write_text("of other poses")
    assert run(["capture", "pose", str(folder), "-o", str(work), "--quiet"]) == 0
    assert (work / "poses.json").read_bytes() == before and not (work / "refined.json").exists()
    assert "7 of 7 frames have a pose, by features and depth." in capfd.readouterr().out


def test_a_frame_of_something_else_is_named(made, folder, tmp_path, capfd):
    strange = shutil.copytree(folder, tmp_path / "strange")
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    Image.fromarray(noise).save(strange / "rgb" / "000003.png")
    assert run(["capture", "pose", str(strange), "-o", str(tmp_path / "work"), "--quiet"]) == 1
    assert "Without a pose are 000003." in capfd.readouterr().out


def test_given_poses_are_taken_and_checked(made, folder, tmp_path, capfd):
    given = shutil.copytree(folder, tmp_path / "given")
    write = lambda poses: (given / "poses.json").write_text(
        json.dumps(dict(zip(made.names, poses.to_matrix().tolist(), strict=True)))
    )
    write(made.world_from_camera)
    assert run(["capture", "pose", str(given), "-o", str(tmp_path / "work"), "--quiet"]) == 0
    assert "7 of 7 frames have a pose, by given." in capfd.readouterr().out
    found = read_trajectory(tmp_path / "work" / "poses.json").world_from_camera
    np.testing.assert_allclose(found.translation, made.world_from_camera.translation, atol=1e-6)
    write(made.world_from_camera.inverse())
    assert run(["capture", "pose", str(given), "-o", str(tmp_path / "work"), "--quiet"]) == 2
    assert "only read as camera_from_world" in capfd.readouterr().err
    assert run(["capture", "pose", str(given), "-o", str(tmp_path / "work"), "--quiet", "--method", "depth"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--board", "chess:7x5"], "describes no board: write KIND"),
        (["--method", "board"], "need its description (--board)"),
        (["--method", "given"], "no poses are given there"),
        (["--every", "6"], "frames could be placed"),
    ],
)
def test_refuses_in_one_line(folder, tmp_path, capfd, words, said):
    assert run(["capture", "pose", str(folder), "-o", str(tmp_path / "work"), "--quiet", *words]) == 2
    err = capfd.readouterr().err
    assert err.startswith("ipjax: ") and said in err and err.count("\n") == 1
    assert not (tmp_path / "work").exists()


def test_a_depth_camera_without_a_place_is_told(made, folder, tmp_path, capfd):
    bare = shutil.copytree(folder, tmp_path / "bare")
    shutil.rmtree(bare / "raw", ignore_errors=True)
    (bare / "depth").rename(bare / "raw")
    shutil.copy(bare / "camera.json", bare / "depth_camera.json")
    poses = made.world_from_camera.to_matrix().tolist()
    (bare / "poses.json").write_text(json.dumps(dict(zip(made.names, poses, strict=True))))
    assert run(["capture", "pose", str(bare), "-o", str(tmp_path / "work"), "--quiet"]) == 0
    assert "where the depth camera stands is not known" in capfd.readouterr().out.lower()
