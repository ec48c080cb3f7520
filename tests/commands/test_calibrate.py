"""``ipjax calibrate``: drawn images of a board walk through the whole command, in both directions."""

import json
import re

import numpy as np
import pytest
from builders.command_lines import run
from PIL import Image

from ipjax.capture.poses.boards import parse_board
from ipjax.capture.poses.sightings import find_board, make_detector
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.rigid import read_rigid
from ipjax.synthetic.boards import photograph
from ipjax.synthetic.calibration import make_calibration
from ipjax.transforms import difference

WORD, COUNT, SCALE = "charuco:6x4:0.05:0.035:DICT_4X4_50", 9, 2400
CAMERA = Intrinsics(
    np.array([[330.0, 0, 161], [0, 331, 118], [0, 0, 1]]), (-0.12, 0.05, 0.001, -0.0005), "plumb_bob", (320, 240)
)
NAMES = [f"view_{i}" for i in range(COUNT + 1)]  # 10 comes before 2 in the order of letters


@pytest.fixture(scope="module", params=["in-hand", "to-hand"])
def made(request, tmp_path_factory):
    """A folder with images (the last without a board), a camera and poses by name; the truth, and the direction."""
    folder, board = tmp_path_factory.mktemp(request.param), parse_board(WORD)
    truth = make_calibration(1, COUNT, request.param, span=board.span, distance=0.55, robot_noise=(4e-4, 2e-4))
    (folder / "images").mkdir()
    pattern = board.draw(SCALE)
    for i, name in enumerate(NAMES):
        pose = truth.true_camera_from_board.take(min(i, COUNT - 1))
        rgb = photograph(pattern, SCALE, pose, CAMERA, noise=2.0, seed=i) if i < COUNT else np.full_like(rgb, 90)
        Image.fromarray(rgb).save(folder / "images" / f"{name}.png")
    matrices = truth.base_from_gripper.to_matrix()
    matrices = np.concatenate([matrices, matrices[-1:]])
    (folder / "poses.json").write_text(json.dumps(dict(zip(NAMES, matrices.tolist(), strict=True))))
    (folder / "list.json").write_text(json.dumps(matrices.tolist()))
    lens = {"fx": 330, "fy": 331, "cx": 161, "cy": 118, "width": 320, "height": 240, "dist": CAMERA.distortion}
    (folder / "camera.json").write_text(json.dumps(lens))
    return folder, truth, request.param


def words(folder, direction, *more, **replace) -> list[str]:
    given = {"robot-poses": folder / "poses.json", "camera": folder / "camera.json", "board": WORD, "eye": direction}
    given |= {"output": folder / "answer.json"} | {name.replace("_", "-"): value for name, value in replace.items()}
    options = [word for name, value in given.items() if value is not None for word in (f"--{name}", str(value))]
    return ["calibrate", str(folder / "images"), *options, *map(str, more)]


def test_the_camera_is_found(made, capfd):
    folder, truth, eye = made
    answer = {"in-hand": "gripper_from_camera", "to-hand": "base_from_camera"}[eye]
    assert run(words(folder, eye, "--report", folder / "report.html", "--json")) == 0
    told = capfd.readouterr()
    document = json.loads(told.out)
    assert document == json.loads((folder / "answer.json").read_text())
    assert document["without_board"] == {"view_9": "the board is not found"} and "view_9: the board" in told.err
    assert [view["name"] for view in document["views"]] == NAMES[:COUNT] and not document["wrong"]
    off = difference(truth.mount_from_camera, read_rigid(folder / "answer.json", answer))
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1 and np.linalg.norm(off[3:6]) < 0.0015
    deviation = document["deviation"]
    assert np.linalg.norm(off[3:6]) < 0.004 * deviation["translation_mm"] and deviation["rotation_deg"] < 0.1
    page = (folder / "report.html").read_text()
    assert answer in page and page.count("data:image/jpeg") == COUNT + 1 and "view_9: the board is not found" in page
    other = {"in-hand": "base_from_camera", "to-hand": "gripper_from_camera"}[eye]
    with pytest.raises(ValueError, match=f"{other} is wanted, but it has {answer}"):
        read_rigid(folder / "answer.json", other)


def test_people_get_a_table_and_poses_in_order_are_read(made, capfd):
    folder, _, eye = made
    assert run(words(folder, eye, robot_poses=folder / "list.json")) == 0
    told = capfd.readouterr()
    lines = told.out.splitlines()
    assert re.split(r"\s{2,}", lines[0]) == ["image", "corners", "pixels", "rotation °", "translation mm"]
    assert [line.split()[0] for line in lines[1 : COUNT + 1]] == NAMES[:COUNT]
    assert re.search(r"by 9 views: ± 0\.\d+°, ± \d\.\d+ mm; a view is off by", lines[COUNT + 1])


def test_a_wrong_pair_is_named_and_a_shifted_one_refused(made, capfd):
    folder, _, eye = made
    poses = json.loads((folder / "poses.json").read_text())
    poses["view_3"] = poses["view_6"]
    (folder / "wrong.json").write_text(json.dumps(poses))
    assert run(words(folder, eye, "--json", robot_poses=folder / "wrong.json")) == 0
    document = json.loads(capfd.readouterr().out)
    assert len(document["wrong"]) == 1 and document["wrong"][0].startswith("view_3: image and robot pose do not")
    assert [view["name"] for view in document["views"] if not view["counted"]] == ["view_3"]
    listed = json.loads((folder / "list.json").read_text())
    (folder / "shifted.json").write_text(json.dumps([*listed[:4], listed[0], *listed[4:]]))  # one pose too many
    assert run(words(folder, eye, robot_poses=folder / "shifted.json", output=folder / "none.json")) == 2
    error = capfd.readouterr().err.splitlines()[-1]
    assert "images from view_4 on seem to belong to the pose after theirs" in error
    assert not (folder / "none.json").exists()


@pytest.mark.parametrize(
    ("replace", "said"),
    [
        ({"eye": None}, "a calibration needs --eye"),
        ({"board": "charuco:4x6:0.05:0.035:DICT_4X4_50"}, "none of 10 images: the board is not found; but charuco:6x4"),
        ({"board": "charuco:6x4:0.05:0.035:DICT_6X6_50"}, "markers of DICT_4X4_50 are seen there"),
        ({"robot_poses": "none.json"}, "none.json: no such file of robot poses"),
        ({"output": "none/answer.json"}, "the folder none does not exist"),
        ({"output": "poses.json", "robot_poses": "poses.json"}, "poses.json: it is read and would be overwritten"),
        ({"output": "answer.yaml"}, "must end in .json"),
        ({"rotation": "best"}, "rotations are written as xyzw"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(made, replace, said, capfd):
    folder, _, eye = made
    status = run(words(folder, eye, "--quiet", **replace))
    told = capfd.readouterr()
    assert status == 2 and told.err.count("\n") == 1 and said in told.err, told.err


def test_another_size_of_image_is_refused(made, capfd, tmp_path):
    folder, _, eye = made
    (tmp_path / "camera.json").write_text(json.dumps({"fx": 330, "fy": 330, "cx": 320, "cy": 240, "size": [640, 480]}))
    assert run(words(folder, eye, "--quiet", camera=tmp_path / "camera.json")) == 2
    assert "320 × 240 pixels, but the camera is of 640 × 480" in capfd.readouterr().err


@pytest.mark.parametrize("word", [WORD, "chessboard:8x5:0.0225", "aruco:4x3:0.04:0.01:DICT_5X5_100"])
def test_a_printed_board_has_its_true_size(word, tmp_path, capfd):
    """The corners on the paper are as far apart as the board's are, and so are the ends of the bar."""
    assert run(["calibrate", "--board", word, "--print-board", str(tmp_path / "board.png"), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["paper"].startswith("A3" if word == WORD else "A4")
    with Image.open(tmp_path / "board.png") as image:
        sheet = np.asarray(image.convert("L"))
        metre = image.info["dpi"][0] / 0.0254
    points, pixels = make_detector(parse_board(word))(sheet)
    points, pixels = points.reshape(-1, 3), pixels.reshape(-1, 2)
    told, there = (np.linalg.norm(x - x[0], axis=1) for x in (points, pixels))
    np.testing.assert_allclose(there / metre, told, atol=2e-4 if word.startswith("aruco") else 5e-5)
    bar = np.flatnonzero(sheet[-round(0.0122 * metre)] == 0)
    assert abs((bar[-1] - bar[0] + 1) / metre - 0.1) < 2e-4


def test_a_board_is_printed_as_pdf_of_that_paper(tmp_path):
    assert run(["calibrate", "--board", WORD, "--print-board", str(tmp_path / "board.pdf")]) == 0
    box = re.search(rb"MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "board.pdf").read_bytes())
    assert box is not None
    np.testing.assert_allclose([float(x) / 72 * 0.0254 for x in box.groups()], [0.420, 0.297], atol=1e-3)
    assert run(["calibrate", "--board", WORD, "--print-board", str(tmp_path / "board.svg")]) == 2


def test_find_board_says_why_not():
    find = make_detector(parse_board(WORD))
    with pytest.raises(ValueError, match="the board is not found"):
        find_board(np.full((240, 320), 90, np.uint8), find, CAMERA.matrix)
