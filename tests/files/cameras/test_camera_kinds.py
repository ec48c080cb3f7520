"""Camera files of every kind give one camera; bad ones are refused by name, in one sentence."""

import json

import numpy as np
import pytest

from ipjax.files.cameras.reading import read_camera

K = np.array([[110.0, 0, 63.2], [0, 108.0, 47.4], [0, 0, 1]])
ROS = """\
image_width: 128
image_height: 96
camera_name: d435
camera_matrix:
  rows: 3
  cols: 3
  data: [110.0, 0.0, 63.2,
         0.0, 108.0, 47.4, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.0, 0.0, 0.01]
"""
ECHO = "header:\n  frame_id: camera\nheight: 96\nwidth: 128\ndistortion_model: plumb_bob\nd:\n" + "".join(
    f"- {x}\n" for x in (0.1, -0.2, 0.0, 0.0, 0.01)
)
ECHO += "k:\n" + "".join(f"- {x}\n" for x in K.reshape(-1)) + "r: [1, 0, 0]\n---\n"
FLAT = K.reshape(-1).tolist()


@pytest.mark.parametrize(
    ("name", "text", "lens", "scale"),
    [
        (
            "scene_camera.json",
            json.dumps({"3": {"cam_K": FLAT, "depth_scale": 0.1}, "4": {"cam_K": FLAT}}),
            False,
            1e-4,
        ),
        ("camera.json", json.dumps(dict(fx=110, fy=108, cx=63.2, cy=47.4, depth_scale=1.0)), False, 1e-3),
        ("camera.txt", "110 108 63.2 47.4\n", False, None),
        ("cam_K.txt", "\n".join(" ".join(map(str, row)) for row in K), False, None),
        ("info.yaml", ROS, True, None),
        ("echo.yaml", ECHO, True, None),
        ("info.json", json.dumps(dict(K=FLAT, D=[0.1, -0.2, 0, 0, 0.01], distortion_model="plumb_bob")), True, None),
        ("open3d.json", json.dumps(dict(intrinsic_matrix=K.T.reshape(-1).tolist(), width=128, height=96)), False, None),
    ],
)
def test_cameras_are_read(tmp_path, name, text, lens, scale):
    (tmp_path / name).write_text(text)
    camera = read_camera(tmp_path / name, 3)
    np.testing.assert_allclose(camera.matrix, K)
    assert camera.distortion == ((0.1, -0.2, 0.0, 0.0, 0.01) if lens else ())
    assert camera.depth_scale == (None if scale is None else pytest.approx(scale))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("{", "not valid JSON"),
        ("hello there", "neither"),
        ("1 2 3", "3 numbers"),
        ('{"a": 1}', "no camera among"),
        ('{"1": {"cam_K": [1]}, "2": {}}', "say which one"),
        (json.dumps({"cam_K": [0.0] * 8 + [1.0]}), "singular"),
        (json.dumps({"cam_K": "abc"}), "numbers"),
        (json.dumps({"K": FLAT, "D": [1, 2, 3], "distortion_model": "plumb_bob"}), "do not fit"),
        (json.dumps({"K": FLAT, "D": [1], "distortion_model": "omni"}), "unknown lens"),
        (json.dumps({"cam_K": FLAT, "depth_scale": 0}), "depth scale"),
    ],
)
def test_bad_camera_files_are_refused_by_name(tmp_path, text, words):
    path = tmp_path / "camera.file"
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as caught:
        read_camera(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
