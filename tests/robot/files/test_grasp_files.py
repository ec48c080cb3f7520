"""Files of grasps that others read: what is written is read back, in the axes that each has, and faults are said."""

import json

import numpy as np
import pytest
import yaml

from ipjax.robot.files.graspgen import read_graspgen, write_graspgen
from ipjax.robot.files.isaac_grasp import read_isaac_grasp, write_isaac_grasp
from ipjax.robot.files.listing import GraspList, turn_closing
from ipjax.robot.grippers import FRANKA_HAND, ROBOTIQ_2F_85
from ipjax.transforms import Similarity, rotation_from_vector


@pytest.fixture
def grasps():
    rng = np.random.default_rng(0)
    turns = rotation_from_vector(rng.normal(size=(4, 3)))
    return GraspList(
        mesh_from_gripper=Similarity(turns, rng.normal(size=(4, 3)), np.ones(4)),
        score=np.array([0.9, 0.7, 0.7, 0.1]),
        width=np.array([0.03, 0.05, np.nan, 0.07]),
        names=tuple(f"grasp_{i}" for i in range(4)),
        object_file="mug.obj",
        object_scale=0.001,
        gripper="franka",
    )


def assert_same(found, expected):
    np.testing.assert_allclose(found.mesh_from_gripper.rotation, expected.mesh_from_gripper.rotation, atol=1e-12)
    np.testing.assert_allclose(found.mesh_from_gripper.translation, expected.mesh_from_gripper.translation, atol=1e-12)
    np.testing.assert_allclose(found.score, expected.score)
    np.testing.assert_allclose(found.width, expected.width)
    assert (found.names, found.object_file, found.object_scale) == (expected.names, "mug.obj", 0.001)


@pytest.mark.parametrize("closing", [None, "x", "y"])
def test_isaac_grasp_round_trip(grasps, closing, tmp_path):
    path = write_isaac_grasp(tmp_path / "a.yaml", grasps, FRANKA_HAND, closing=closing)
    assert_same(read_isaac_grasp(path, FRANKA_HAND), grasps)
    document = yaml.safe_load(path.read_text())
    assert document["closing_axis"] == (closing or "y") and document["gripper_frame"] == "panda_hand"
    assert document["grasps"]["grasp_0"]["cspace_position"] == {"panda_finger_joint1": 0.015}
    assert document["grasps"]["grasp_0"]["pregrasp_cspace_position"] == {"panda_finger_joint1": 0.04}


def test_graspgen_round_trip(grasps, tmp_path):
    path = write_graspgen(tmp_path / "a.json", grasps, FRANKA_HAND)
    assert_same(read_graspgen(path, FRANKA_HAND), grasps)
    document = json.loads(path.read_text())
    assert document["grasps"]["object_in_gripper"] == [True] * 4 and document["object"]["scale"] == 0.001
    # There the fingers close along x, here along y; the approach is z in both.
    theirs, ours = np.array(document["grasps"]["transforms"]), grasps.mesh_from_gripper.rotation
    np.testing.assert_allclose(theirs[:, :3, 0], ours[:, :, 1], atol=1e-12)
    np.testing.assert_allclose(theirs[:, :3, 2], ours[:, :, 2], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(theirs[:, :3, :3]), 1)


def test_turning_there_and_back_is_nothing(grasps):
    pose = grasps.mesh_from_gripper
    there = turn_closing(pose, "y", "x")
    np.testing.assert_allclose(turn_closing(there, "x", "y").rotation, pose.rotation, atol=1e-15)
    assert turn_closing(pose, "x", "x") is pose
    with pytest.raises(ValueError, match="close along x or y, not 'z'"):
        turn_closing(pose, "z", "x")


def test_the_documented_example_is_read(tmp_path):
    """As NVIDIA's page of the format has it."""
    path = tmp_path / "mug.yaml"
    path.write_text(
        "format: isaac_grasp\nformat_version: 1.0\nobject_frame: /World/mug\ngripper_frame: /World/panda_hand\n"
        'grasps:\n  "grasp_0":\n    confidence: 1.0\n    position: [-0.04346, 0.06759, 0.19895]\n'
        "    orientation: {w: 0.00332, xyz: [0.98453, 0.16837, 0.04837]}\n"
        "    cspace_position:\n      panda_finger_joint1: 0.00943\n"
        "    pregrasp_cspace_position:\n      panda_finger_joint1: 0.04\n"
    )
    found = read_isaac_grasp(path, FRANKA_HAND)
    assert found.names == ("grasp_0",) and found.object_file == "/World/mug"
    assert found.width[0] == pytest.approx(0.01886) and found.score[0] == 1
    np.testing.assert_allclose(found.mesh_from_gripper.translation[0], [-0.04346, 0.06759, 0.19895])
    assert found.mesh_from_gripper.rotation[0, 2, 2] < -0.9  # it comes from above
    assert np.isnan(read_isaac_grasp(path, ROBOTIQ_2F_85).width[0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.update(format="other"), "not an isaac_grasp file"),
        (lambda d: d.update(format_version=2.0), "version 2 of isaac_grasp is not known"),
        (lambda d: d.update(format_version="new"), "format_version is a number"),
        (lambda d: d.update(grasps=[1]), "'grasps' holds the grasps by name"),
        (lambda d: d.update(closing_axis="z"), "close along x or y, not 'z'"),
        (lambda d: d["grasps"].update(grasp_1=3), "grasp 'grasp_1': confidence, position and orientation"),
        (lambda d: d["grasps"]["grasp_1"].pop("orientation"), "grasp 'grasp_1': orientation's xyz: 3 numbers"),
        (lambda d: d["grasps"]["grasp_1"]["orientation"].update(w=3.0), "'grasp_1': the orientation is no unit"),
        (lambda d: d["grasps"]["grasp_1"].update(position=[0, 1]), "'grasp_1': position: 3 numbers"),
        (lambda d: d["grasps"]["grasp_1"].update(position=[0, 1, float("nan")]), "'grasp_1': position: it is not fin"),
        (lambda d: d["grasps"]["grasp_1"].update(position=[10**400, 0, 0]), "'grasp_1': position: it is not finite"),
        (lambda d: d.update(object_scale=0), "object_scale is positive, not 0"),
        (lambda d: d["grasps"]["grasp_1"].update(confidence=7), "'grasp_1': confidence: a number from 0 to 1"),
    ],
)
def test_what_is_wrong_with_isaac_grasp_is_said(grasps, change, said, tmp_path):
    path = write_isaac_grasp(tmp_path / "a.yaml", grasps, FRANKA_HAND)
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ValueError, match=f"a.yaml: .*{said}") as error:
        read_isaac_grasp(path, FRANKA_HAND)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("grasps"), "'grasps' with 'transforms' is expected"),
        (lambda d: d["grasps"].update(transforms=[[1, 2], [3]]), "a list of 4 × 4 matrices"),
        (lambda d: d["grasps"]["transforms"].__setitem__(0, np.diag([2, 2, 2, 1]).tolist()), "enlarges by 2"),
        (lambda d: d["grasps"].update(confidence=[0.5]), "for each of the 4 grasps"),
        (lambda d: d["grasps"].update(width_m=[0.5]), "'width_m': a number, or null"),
        (lambda d: d["object"].update(scale="mm"), "are numbers"),
        (lambda d: d["object"].update(scale=float("nan")), "'scale' is positive and finite, not nan"),
        (lambda d: d["grasps"]["transforms"][0][0].__setitem__(3, 10**400), "a list of 4 × 4 matrices"),
    ],
)
def test_what_is_wrong_with_graspgen_is_said(grasps, change, said, tmp_path):
    path = write_graspgen(tmp_path / "a.json", grasps, FRANKA_HAND)
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=f"a.json: .*{said}"):
        read_graspgen(path, FRANKA_HAND)


def test_graspgen_without_scores_is_ordered_by_what_holds(grasps, tmp_path):
    path = write_graspgen(tmp_path / "a.json", grasps, FRANKA_HAND)
    document = json.loads(path.read_text())
    document["grasps"] = {
        "transforms": document["grasps"]["transforms"],
        "object_in_gripper": [False, True, False, True],
    }
    path.write_text(json.dumps(document))
    found = read_graspgen(path, FRANKA_HAND)
    assert found.names == ("grasp_1", "grasp_3", "grasp_0", "grasp_2") and found.score.tolist() == [1, 1, 0, 0]
    np.testing.assert_allclose(found.mesh_from_gripper.translation[0], grasps.mesh_from_gripper.translation[1])
