"""Files of robot poses: every form that people have, and nothing that is read as another."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ipjax.robot.hand_eye.reading.observing import list_images
from ipjax.robot.hand_eye.reading.pose_forms import Form
from ipjax.robot.hand_eye.reading.robot_poses import RobotPoses, pair, read_robot_poses
from ipjax.robot.hand_eye.records import HandEyeError
from ipjax.transforms import Similarity

TURN = Rotation.from_rotvec(np.array([[0.3, -1.9, 0.7], [1.1, 0.2, -0.4], [0.1, 2.9, 0.3]]))
PLACE = np.array([[0.41, -0.2, 0.63], [0.5, 0.1, 0.4], [0.3, 0.3, 0.55]])
NAMES = "000004", "000005", "000010"
MATRICES = np.tile(np.eye(4), (3, 1, 1))
MATRICES[:, :3, :3], MATRICES[:, :3, 3] = TURN.as_matrix(), PLACE


def write(folder: Path, text: object, name: str = "poses.json") -> Path:
    path = folder / name
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return path


def join(*parts: np.ndarray) -> list[list[float]]:
    return np.concatenate(parts, axis=1).tolist()


def table(rows: list[list[float]], mark: str = ",", names: bool = False) -> str:
    lines = [mark.join(map(repr, row)) for row in rows]
    return "\n".join(f"{n}{mark}{line}" for n, line in zip(NAMES, lines, strict=True)) if names else "\n".join(lines)


QUATERNION = TURN.as_quat()
ZYX = TURN.as_euler("ZYX")
RPY = TURN.as_euler("xyz")
STAMPED = [
    {
        "name": n,
        "pose": {"position": dict(zip("xyz", p, strict=True)), "orientation": dict(zip("xyzw", q, strict=True))},
    }
    for n, p, q in zip(NAMES, PLACE.tolist(), QUATERNION.tolist(), strict=True)
]
ROS = "name,x,y,z,roll,pitch,yaw\n" + table(join(PLACE, RPY), names=True)
TUM = "# timestamp tx ty tz qx qy qz qw\n" + table(join(PLACE, QUATERNION), " ", names=True)
FORMS = [
    ("matrices by name", dict(zip(NAMES, MATRICES.tolist(), strict=True)), {}, True),
    ("matrices in order", {"base_from_gripper": MATRICES.tolist()}, {}, False),
    ("column by column", [m.T.ravel().tolist() for m in MATRICES], {}, False),
    ("ROS stamped", STAMPED, {}, True),
    ("a list, xyzw", join(PLACE, QUATERNION), {"rotation": "xyzw"}, False),
    ("a list, wxyz", join(PLACE, np.roll(QUATERNION, 1, 1)), {"rotation": "wxyz"}, False),
    ("a rotation vector, mm", join(1000 * PLACE, TURN.as_rotvec()), {"rotation": "rotvec"}, False),
    ("CSV with names", ROS, {}, True),
    ("CSV of KUKA", table(join(1000 * PLACE, np.degrees(ZYX)), ";", names=True), {"rotation": "ZYX"}, True),
    ("numbers before six more", table(join(PLACE, RPY), " ", names=True), {"rotation": "rpy"}, True),
    ("TUM", TUM, {}, True),
    ("rows of sixteen", table(MATRICES.reshape(3, 16).tolist(), " "), {}, False),
    ("matrices one below the other", table(MATRICES.reshape(12, 4).tolist(), " "), {}, False),
    ("YAML", "unit: mm\nposes:\n" + "".join(
        f"- {{file: rgb/{n}.png, translation: {(1000 * p).tolist()}, rotation: {q}}}\n"
        for n, p, q in zip(NAMES, PLACE, QUATERNION.tolist(), strict=True)), {"rotation": "xyzw"}, True),
]  # fmt: skip


@pytest.mark.parametrize(("what", "text", "form", "named"), FORMS, ids=[row[0] for row in FORMS])
def test_all_forms_are_the_same_poses(tmp_path, what, text, form, named):
    found = read_robot_poses(write(tmp_path, text), Form(**form))
    np.testing.assert_allclose(found.base_from_gripper.to_matrix(), MATRICES, atol=1e-12)
    assert (found.names is not None) == named
    if named:
        images = [Path(f"img/{n}.png") for n in NAMES[::-1]]
        used, numbers, notes = pair(images, found)
        assert used.tolist() == [0, 1, 2] and numbers.tolist() == [2, 1, 0] and not notes


def test_units_that_are_guessed_are_told(tmp_path):
    rows = join(1000 * PLACE, np.degrees(RPY))
    notes = read_robot_poses(write(tmp_path, rows), Form("rpy")).notes
    assert any("millimetres (up to 778)" in note for note in notes) and any("degrees" in note for note in notes)
    with pytest.raises(HandEyeError, match=r"poses\.json: a hand 778 m from its base: the positions are not in m"):
        read_robot_poses(write(tmp_path, rows), Form("rpy", unit="m"))
    with pytest.raises(HandEyeError, match="are not in radians"):
        read_robot_poses(write(tmp_path, rows), Form("rpy", angles="rad"))
    with pytest.raises(HandEyeError, match="may be metres or millimetres: say --unit"):
        read_robot_poses(write(tmp_path, join(10 * PLACE, RPY)), Form("rpy"))


BROKEN = MATRICES[0].tolist()
NOT_FINITE = '{"000004": [[1, 0, 0, NaN], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}'


@pytest.mark.parametrize(
    ("text", "form", "said"),
    [
        (json.dumps(dict(zip(NAMES, MATRICES.tolist(), strict=True)))[:-40], {}, "not valid JSON"),
        ("", {}, "the file is empty"),
        ("[]", {}, "there are no poses in it"),
        (NOT_FINITE, {}, "pose 000004: a pose has a number that is not finite"),
        ([(np.diag([1, 1, -1, 1.0]) @ MATRICES[0]).tolist()], {}, "pose 1: the matrix mirrors"),
        ([np.diag([1, 2, 1, 1.0]).tolist()], {}, "pose 1: the matrix shears, or stretches"),
        ([MATRICES[0, :3, :3].tolist()], {}, r"a matrix of 4 × 4, or x, y, z and a rotation"),
        (join(PLACE, QUATERNION), {}, "say which with --rotation: xyzw or wxyz"),
        (join(PLACE, RPY), {}, r"say which with --rotation: rotvec \(Universal Robots\), rpy"),
        (join(PLACE, QUATERNION), {"rotation": "rpy"}, "rotations were said to be rpy, but this one has 4 numbers"),
        (join(PLACE, 2 * QUATERNION), {"rotation": "xyzw"}, "a quaternion is of length 1, not 2"),
        ([{"x": 1, "y": 2}], {}, "x, y, z and a rotation are expected"),
        ("a,b,c,d\n1,2,3", {}, "line 2: 3 entries, but the first row names 4"),
        ("1 2 3 4 5 6\n1 2 x y 5 6", {}, "line 2: numbers are expected"),
        ({"unit": "inch", "poses": []}, {}, "its unit is 'inch'"),
        ({"unit": ["m"], "poses": []}, {}, r"its unit is \['m'\]"),
        ([[10**400, 0, 0, 0, 0, 0]], {"rotation": "rpy"}, "pose 1: a pose is numbers"),
        ([{"name": "a", "matrix": BROKEN}, {"name": "a", "matrix": BROKEN}], {}, "there are two poses of a"),
        ([{"name": "a", "matrix": BROKEN}, {"matrix": BROKEN}], {}, "some poses have names and others have none"),
    ],
)
def test_what_is_none_is_refused_in_words(tmp_path, text, form, said):
    path = write(tmp_path, text)
    with pytest.raises(HandEyeError, match=said) as caught:
        read_robot_poses(path, Form(**form))
    assert str(caught.value).startswith(str(path))


def test_a_rotation_that_is_none_is_refused():
    for word in ("xyx", "XYZ", "zyx", "rotvec"):
        assert Form(word).width == 3
    for word in ("xyzz", "xXy", "xxy", "best"):
        with pytest.raises(ValueError, match="rotations are written as xyzw, wxyz"):
            Form(word)


def test_names_that_meet_nothing_are_told():
    poses = RobotPoses(Similarity.from_matrix(MATRICES), ("pose_4.json", "pose_5.json", "pose_12.json"))
    images = [Path("img_04.png"), Path("img_05.png"), Path("img_06.png")]
    used, numbers, notes = pair(images, poses)
    assert used.tolist() == [0, 1] and numbers.tolist() == [0, 1]
    assert notes == ["img_06: there is no pose of this name", "no image of the pose of pose_12.json"]
    with pytest.raises(HandEyeError, match=r"no image has the name of a pose: images are called left\.png"):
        pair([Path("left.png")], poses)


def test_images_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("10", "9", "a2", "a10", "²"):  # the last is a digit to Python, and no number
        (tmp_path / f"{name}.png").touch()
    found = [path.stem for path in list_images([tmp_path])]
    assert found == ["9", "10", "a2", "a10", "²"]
