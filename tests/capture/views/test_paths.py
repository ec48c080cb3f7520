"""Paths of virtual cameras: through the captured ones, around the scene, from a file."""

import json

import numpy as np
import pytest

from ipjax.capture.records import CaptureError
from ipjax.capture.views.paths import find_up, look_from, orbit_path, read_path, smooth_path
from ipjax.transforms import Similarity

UP = np.array([0.0, 0, 1])


def go_around(angles, middle=(0.1, 0.2, 0.0), height=0.4, radius=0.6):
    places = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), height)], -1)
    return look_from(places + np.asarray(middle), np.asarray(middle), UP)


def test_smooth_goes_through_the_cameras_evenly():
    captured = go_around(np.array([0, 0.3, 0.7, 0.9, 1.4]))
    path = smooth_path(captured, 400)
    apart = np.linalg.norm(path.translation[:, None] - captured.translation, axis=-1)
    nearest = apart.argmin(0)
    assert (apart.min(0) < 2e-3).all() and (np.diff(nearest) > 0).all() and nearest[0] == 0 and nearest[-1] == 399
    turned = np.einsum("nij,nij->n", path.rotation[nearest], captured.rotation)
    assert (turned > 2.9999).all()  # the trace: within half a degree
    steps = np.linalg.norm(np.diff(path.translation, axis=0), axis=-1)
    assert steps.max() < 1.6 * steps.min()
    np.testing.assert_allclose(
        path.rotation @ path.rotation.swapaxes(1, 2), np.tile(np.eye(3), (400, 1, 1)), atol=1e-12
    )
    # No kinks: neighbouring steps point the same way, even more so where there are more of them.
    ways = np.diff(path.translation, axis=0) / steps[:, None]
    assert (ways[1:] * ways[:-1]).sum(-1).min() > 0.9995


def test_orbit_is_a_circle_at_the_captured_distance():
    middle = np.array([0.1, 0.2, 0.0])
    captured = go_around(np.linspace(0, 2 * np.pi, 12, endpoint=False))
    np.testing.assert_allclose(find_up(captured), UP, atol=1e-9)
    path = orbit_path(captured, middle, 16)
    away = path.translation - middle
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1), np.hypot(0.6, 0.4), atol=1e-9)
    np.testing.assert_allclose(away[:, 2], 0.4, atol=1e-9)
    ahead = path.rotation[:, :, 2]
    np.testing.assert_allclose((ahead * -away).sum(-1), np.hypot(0.6, 0.4), atol=1e-9)
    assert (path.rotation[:, 2, 1] < 0).all()  # images point down
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    assert np.unique(np.round(azimuth, 6)).size == 16


def test_orbit_stays_where_cameras_were():
    captured = go_around(np.linspace(0.5, 1.7, 6))
    path = orbit_path(captured, np.array([0.1, 0.2, 0]), 20)
    away = path.translation - [0.1, 0.2, 0]
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    assert azimuth.min() > 0.499 and azimuth.max() < 1.701 and np.ptp(azimuth) > 1.1


@pytest.mark.parametrize("form", ["list", "dictionary"])
def test_a_file_of_cameras(form, tmp_path):
    matrices = go_around(np.array([0.0, 1.0])).to_matrix()
    document = matrices.tolist() if form == "list" else dict(zip("ab", matrices.tolist(), strict=True))
    (tmp_path / "path.json").write_text(json.dumps(document))
    np.testing.assert_allclose(read_path(tmp_path / "path.json").to_matrix(), matrices, atol=1e-12)


@pytest.mark.parametrize("text", ["[]", "[[1, 2]]", "{", '{"a": 3}', json.dumps([np.diag([2.0, 1, 1, 1]).tolist()])])
def test_a_file_that_is_no_path_is_refused(text, tmp_path):
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(CaptureError, match=r"path\.json.*4 × 4"):
        read_path(tmp_path / "path.json")


def test_one_camera_is_no_path():
    one = Similarity(np.eye(3)[None], np.zeros((1, 3)), np.ones(1))
    for make in (smooth_path, lambda p, n: orbit_path(p, np.ones(3), n)):
        with pytest.raises(ValueError, match="two cameras"):
            make(one, 5)
