"""Rigid motions in files: by their names, in metres, and nothing that is not one."""

import json

import numpy as np
import pytest

from ipjax.files.rigid import read_rigid, write_rigid
from ipjax.transforms import Similarity

POSE = Similarity[np.ndarray].exp(np.array([0.3, -2, 0.7, 0.41, -0.2, 0.63]))


def test_what_is_written_is_read(tmp_path):
    path = write_rigid(tmp_path / "a.json", "base_from_camera", POSE, views=15)
    found = read_rigid(path, "base_from_camera")
    np.testing.assert_allclose(found.to_matrix(), POSE.to_matrix(), atol=1e-15)
    assert json.loads(path.read_text())["views"] == 15


def test_a_bare_matrix_short_decimals_millimetres_and_yaml_are_read(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(POSE.to_matrix().round(4).tolist()))
    found = read_rigid(path, "base_from_camera")
    np.testing.assert_allclose(found.to_matrix(), POSE.to_matrix(), atol=1e-4)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-14)
    matrix = POSE.to_matrix()
    matrix[:3, 3] *= 1000
    path.write_text(f"unit: mm\nbase_from_camera: {matrix.tolist()}\n")
    np.testing.assert_allclose(read_rigid(path, "base_from_camera").translation, POSE.translation, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "not valid"),
        ('{"a": 1}', "it has no base_from_camera"),
        ('{"gripper_from_camera": []}', r"base_from_gripper @ gripper_from_camera in every pose"),
        ('{"camera_from_base": []}', "camera_from_base, its inverse"),
        ("[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", r"4 × 4 numbers, not of shape \[3, 3\]"),
        ("[[1, 0, 0, NaN], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "not finite"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]", "mirrors"),
        ("[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]", "enlarges by 2"),
        ("[[1, 0, 0, 410], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "these are millimetres"),
        ("[[1" + 400 * "0" + "]]", "4 × 4 numbers, row by row"),
        ('{"base_from_camera": [], "unit": ["m"]}', r"its unit is \['m'\]; m or mm"),
        ('{"base_from_camera": [], "unit": "inch"}', "its unit is 'inch'; m or mm"),
    ],
)
def test_what_is_none_is_refused_in_words(tmp_path, text, said):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=said) as caught:
        read_rigid(path, "base_from_camera")
    assert str(caught.value).startswith(str(path))
