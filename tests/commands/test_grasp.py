"""``ipjax grasp``: from a pose and an object to grasps in the robot's base, with files and a picture."""

import json

import numpy as np
import pytest
from builders.command_lines import run
from builders.graspable import HEIGHT, write_grasp_case
from PIL import Image

from ipjax.robot.files.graspgen import read_graspgen
from ipjax.robot.files.isaac_grasp import read_isaac_grasp
from ipjax.robot.grippers import FRANKA_HAND, read_gripper


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("grasp")
    write_grasp_case(folder)
    return folder


@pytest.fixture(autouse=True)
def without_cache(monkeypatch):
    """Nothing is kept beyond the tests."""
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")


def words(folder, *more):
    given = ["grasp", str(folder / "box.ipjax"), "--pose", str(folder / "pose.json")]
    return [*given, "--base-from-camera", str(folder / "hand_eye.json"), "--table", "0", *map(str, more)]


def test_grasps_in_every_frame_and_a_picture(folder, capfd):
    picture, out = folder / "out.png", folder / "out.json"
    images = ["--rgb", folder / "rgb.png", "--camera", folder / "camera.json"]
    assert run(words(folder, *images, "--overlay", picture, "-o", out, "--json")) == 0
    told = json.loads(out.read_text())
    assert json.loads(capfd.readouterr().out)["overlay"] == str(picture)
    assert told["format"] == "ipjax grasps 1" and told["gripper"]["closing"] == "y"
    best = told["grasps"][0]
    assert best["width_m"] == pytest.approx(0.06, abs=2e-4) and 0 < best["score"] <= 1 and best["safe"] > 0.9
    assert best["spare_m"] == pytest.approx(0.01, abs=2e-4)
    decision = told["decision"]
    assert decision["action"] == "grasp" and 0.5 <= decision["probability"] < 1, "a sure pose of a box"
    assert told["grasps"][decision["grasp"]]["safe"] > 0.9 and decision["base_from_view"] is None
    frames = {name: np.array(best[f"{name}_from_gripper"]) for name in ("object", "camera", "base", "mesh")}
    for name, pose in frames.items():
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-5, err_msg=name)
    # base_from_gripper = base_from_camera @ camera_from_object @ object_from_gripper
    chain = np.array(told["base_from_camera"]) @ np.array(told["camera_from_object"]) @ frames["object"]
    np.testing.assert_allclose(chain, frames["base"], atol=1e-6)
    # The box stands on the table, z = 0 to 10 cm, and the hand comes from above.
    tip = frames["base"][:3, 3] + FRANKA_HAND.reach * frames["base"][:3, 2]
    assert 0.02 < tip[2] < 0.1 and np.abs(tip[:2]).max() < 0.06 and frames["base"][2, 2] < 0
    camera_tip = frames["camera"][:3, 3] + FRANKA_HAND.reach * frames["camera"][:3, 2]
    assert camera_tip[2] == pytest.approx(HEIGHT + 0.05 - tip[2], abs=1e-4)
    # The mesh's own origin: its box's centre is at (1, −2, 0.5) mm of it.
    shift = frames["mesh"][:3, 3] - frames["object"][:3, 3]
    np.testing.assert_allclose(shift, [1e-3, -2e-3, 0.5e-3], atol=1e-6)
    assert told["mesh_scale_m_per_unit"] == pytest.approx(1e-3, rel=1e-5)
    image = np.asarray(Image.open(picture))
    gold = (np.abs(image.astype(int) - [255, 214, 64]).max(-1) < 30).sum()
    assert image.shape[0] == 900 and gold > 2000


def test_files_that_others_read(folder, capfd):
    yaml, gen, ours = folder / "out.yaml", folder / "gen.json", folder / "ours.json"
    by_box = words(folder, "--by-box")
    assert run([*by_box, "-o", str(yaml)]) == 0
    assert run([*by_box, "-o", str(gen), "--format", "graspgen"]) == 0
    assert run([*by_box, "-o", str(ours)]) == 0
    told = json.loads(ours.read_text())["grasps"]
    for found in (read_isaac_grasp(yaml, FRANKA_HAND), read_graspgen(gen, FRANKA_HAND)):
        assert len(found.score) == len(told) and found.object_file == "mug.glb"
        for i in (0, len(told) - 1):
            pose = found.mesh_from_gripper.take(i).to_matrix()
            np.testing.assert_allclose(pose, np.array(told[i]["mesh_from_gripper"]), atol=1e-6)
    assert "grasps; the best: score" in capfd.readouterr().out


def test_the_papers_grasps_and_none(folder, capfd):
    out = folder / "by_box.json"
    assert run(words(folder, "--by-box", "--top-down", "-o", out)) == 0
    told = json.loads(out.read_text())
    assert told["method"] == "box" and len(told["grasps"]) == 1
    # Nothing fits into a smaller hand: a result, not an error.
    hand = folder / "small.json"
    assert run(["grasp", str(folder / "box.ipjax"), "--write-gripper", str(hand)]) == 0
    assert read_gripper(hand) == FRANKA_HAND
    hand.write_text(hand.read_text().replace('"opening_m": 0.08', '"opening_m": 0.05'))
    assert run(words(folder, "--by-box", "--gripper", hand)) == 1
    assert "no grasp" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--pose": "none.json"}, "no such file of poses"),
        ({"--pose": "camera.json"}, "not a file of poses: 'ipjax estimate -o' writes them"),
        ({"--frame": "7"}, "there is no frame '7'"),
        ({"--instance": "3"}, "there is no instance 3 of mug, but 1 of them"),
        ({"--gripper": "claw"}, "neither franka, robotiq nor a file"),
        ({"--gripper": "camera.json"}, 'a gripper is a JSON object with "format"'),
        ({"--base-from-camera": "camera.json"}, "it has no base_from_camera"),
        ({"--base-from-camera": None}, "--table Z is a height in the robot's base"),
        ({"--table": "0,0"}, "is no table: give its height in metres, or a plane"),
        ({"--table": "0,0,0,1"}, "the plane's normal has no length"),
        ({"--table": "0,0,1,0.85"}, "the camera is 0.85 m below the table"),
        ({"--table": None, "--top-down": None}, "--top-down needs --table, which tells where down is"),
        (
            {"--overlay": "out.png", "--rgb": "rgb.png", "--camera": "large.json"},
            "images of 640 × 480, but rgb is 320 × 240",
        ),
        ({"-o": "pose.json"}, "pose.json: it is read and would be overwritten"),
        ({"--overlay": "rgb.png", "--rgb": "rgb.png", "--camera": "camera.json"}, "it is read and would be"),
        ({"-o": "two.json", "--write-gripper": "two.json"}, "two results cannot be written to one file"),
        ({"--tilt": "200"}, "--tilt is an angle from 0 to 180"),
        ({"--overlay": "out.png"}, "--overlay needs the image, --rgb, and its --camera"),
        ({"--depth": "depth.png"}, "--depth needs its --camera"),
        ({"-o": "out.txt"}, "the name must end in .json or .yaml or .yml"),
        ({"-o": "out.yaml", "--format": "graspgen"}, "the name must end in .json"),
        ({"--set": "grasp=3"}, "--set: there is no setting 'grasp'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(folder, change, said, capfd):
    given = {"--pose": "pose.json", "--base-from-camera": "hand_eye.json", "--table": "0"} | change
    files = ("--pose", "--base-from-camera", "--overlay", "--rgb", "--depth", "-o")
    line = ["grasp", str(folder / "box.ipjax")] + ["--top-down"] * ("--top-down" in change)
    lens = json.loads((folder / "camera.json").read_text()) | {"width": 640, "height": 480}
    (folder / "large.json").write_text(json.dumps(lens))
    for name, value in given.items():
        if value is not None:
            is_file = name in files or value.endswith(".json")
            line += [name, str(folder / value) if is_file else value]
    assert run(line) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and said in error, error


def test_a_pose_that_was_not_found_is_said(folder, capfd):
    document = json.loads((folder / "pose.json").read_text())
    entry = document["frames"][0]["objects"][0]
    behind = np.array(entry["camera_from_object"]["matrix"])
    behind[2, 3] *= -1
    for change, said in (
        ({"camera_from_object": {"matrix": behind.tolist()}}, "mug is behind the camera there, at z = -0.8 m"),
        ({"size_mm": entry["size_mm"] | {"diameter_std": float("nan")}}, "the estimate is not finite"),
        ({"size_mm": entry["size_mm"] | {"diameter": 0}}, "a diameter of 0 mm ± 0.5 mm is none"),
        ({"success": False}, "no pose of mug was found"),
        ({"covariance": [1]}, "lacks something"),
        ({"object": "cup"}, "it has cup, not mug"),
    ):
        document["frames"][0]["objects"] = [entry | change]
        path = folder / "broken.json"
        path.write_text(json.dumps(document))
        assert run(["grasp", str(folder / "box.ipjax"), "--pose", str(path)]) == 2
        assert said in capfd.readouterr().err
    for frames, said in (([{"objects": None}], "it has no object"), ([{}, {}], "2 frames: say which with --frame")):
        path.write_text(json.dumps({"frames": frames}))
        assert run(["grasp", str(folder / "box.ipjax"), "--pose", str(path)]) == 2
        assert said in capfd.readouterr().err


def test_what_lies_below_the_table_is_told(folder, capfd):
    assert run([*words(folder, "--by-box")[:-2], "0.2", "--by-box"]) == 1
    told = capfd.readouterr()
    assert "the middle of mug is 150 mm below the table" in told.err and "no grasp" in told.out
