"""The benchmark of a wrong focal length: its truth shows the same photo, and its tables count what was measured."""

import sys

import numpy as np
import pytest

from benchmarks import photo_focal
from benchmarks.pairs import Group, Shot, rigid
from ipjax.cameras import project
from ipjax.files.storage.writing import append_json
from ipjax.transforms import rotation_from_vector

K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.6])
def test_the_truth_shows_the_same_photo_through_another_lens(factor):
    pose = rigid(rotation_from_vector(np.array([0.3, 0.5, -0.2])), np.array([0.05, -0.03, 0.6]))
    nothing = np.zeros((1, 1))
    group = Group("ball", None, 1.0, None, Shot("photo", nothing, nothing, nothing, K, pose), [])
    told = photo_focal.in_told_camera(group, photo_focal.refocus(K, factor)).reference
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.01
    # What is left is perspective, which tells a near camera from a far one.
    off = project(told.K, told.camera_from_object @ points) - project(K, pose @ points)
    assert np.abs(off).max() < 0.5 and np.linalg.norm(off.mean(0)) < 0.05
    assert told.camera_from_object.translation[2] == pytest.approx(0.6 * factor)
    np.testing.assert_allclose(told.K[[0, 1], [0, 1]], factor * K[[0, 1], [0, 1]])


def test_the_tables_count_misses_and_compare_pair_by_pair(tmp_path, monkeypatch, capsys):
    lines, page = tmp_path / "lines.jsonl", tmp_path / "focal.md"
    good = {"rotation": 5.0, "scale": 1.0, "add_s": 0.02, "translation_mm": 4.0, "confidence": 0.9}
    good |= {"scale_deviations": 0.5, "angle": 20.0, "commit": "0123456789"}
    for told, scale in (("1.0", 1.01), ("0.6", 1.2)):
        row = good | {"scale": scale, "factor": float(told), "scale_deviations": (scale - 1) / scale / 0.05}
        append_json(lines, row | {"key": [told, "ball", "scene 0"]})
        missed = {"factor": float(told), "failure": "no pose found", "angle": 50.0, "commit": "0123456789"}
        append_json(lines, missed | {"key": [told, "ball", "scene 1"]})
    words = ["photo_focal", "--table", "--output", str(lines), "--page", str(page)]
    monkeypatch.setattr(sys, "argv", words)
    photo_focal.main()
    text = page.read_text()
    assert "| 0.6 | 2 | 50% | 5.0° | 50% | 4 mm | 1.200 | 0% | 20.0% | 0% | 1 of 1 |" in text
    assert "| 1.0 | 2 | 50% | 5.0° | 50% | 4 mm | 1.010 | 50% | 1.0% | 50% | 1 of 1 |" in text
    assert f"| 0.6 | 1 | +0.0° | {1.2 / 1.01:.3f} |" in text and "| 0.050 |" in text
    assert "commit 0123456789" in text and "| 0.6 | 2 |" in capsys.readouterr().out
