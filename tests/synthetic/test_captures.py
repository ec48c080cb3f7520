"""Made captures: the truth that comes with them is true, the light hangs in the room, and what is written hides it."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from ipjax.cameras import project, unproject
from ipjax.files.images.depth import read_depth
from ipjax.synthetic.captures import DEPTH_UNIT, make_capture, write_capture
from ipjax.synthetic.sensor import PERFECT


@pytest.fixture(scope="module")
def capture():
    """Without noise, the factory right; two objects touch, and two fingers move with the camera."""
    return make_capture(
        5, views=4, objects=3, touching=1, size=(200, 150), arc=60, sensor=PERFECT, factory_error=0, gripper=True
    )


def lift(camera, depth):
    """Points of all pixels with depth, and where they are."""
    rows, columns = np.nonzero(depth > 0)
    pixels = np.stack([columns, rows], -1).astype(float)
    return unproject(camera.to_matrix(), pixels, depth[rows, columns].astype(float)), rows, columns


def at(poses, index):
    return type(poses)(poses.rotation[index], poses.translation[index], poses.scale[index])


def look(capture, source, target):
    """What frame `source` shows, seen by frame `target`: rows and columns there and here, and whether both see it."""
    points, rows, columns = lift(capture.camera, capture.true_depth[source])
    moved = at(capture.world_from_camera, target).inverse() @ (at(capture.world_from_camera, source) @ points)
    x, y = np.rint(project(capture.camera.to_matrix(), moved)).astype(int).T
    height, width = capture.true_depth.shape[1:]
    inside = (x >= 1) & (x < width - 1) & (y >= 1) & (y < height - 1) & (moved[:, 2] > 0)
    rows, columns, x, y, z = (v[inside] for v in (rows, columns, x, y, moved[:, 2]))
    table = (capture.ids[source][rows, columns] >= -1) & (capture.ids[target][y, x] >= -1)
    return (rows, columns), (y, x), z, table


def test_poses_carry_what_one_frame_shows_into_the_others(capture):
    for target in (1, 3):
        _, there, z, seen = look(capture, 0, target)
        off = np.abs(capture.true_depth[target][there] - z)[seen]
        assert np.median(off) < 0.002 and seen.mean() > 0.4


def test_light_stays_where_it_hangs(capture):
    # A light that turned with the camera would shade the same place another way from another side.
    here, there, z, seen = look(capture, 0, 3)
    seen &= (np.abs(capture.true_depth[3][there] - z) < 0.003) & (capture.ids[0][here] >= 0)
    ratio = capture.rgb[3][there][seen].sum(-1) / np.maximum(capture.rgb[0][here][seen].sum(-1).astype(float), 1)
    assert seen.sum() > 200 and abs(np.median(ratio) - 1) < 0.03


def test_objects_are_where_the_truth_has_them(capture):
    for index, mesh in enumerate(capture.meshes):
        pose = at(capture.world_from_object, index)
        points, _, _ = lift(capture.camera, np.where(capture.ids[1] == index, capture.true_depth[1], 0))
        assert len(points) > 100
        inside = pose.inverse() @ (at(capture.world_from_camera, 1) @ points)
        near = np.concatenate([mesh.vertices, mesh.vertices[mesh.faces].mean(1)])
        distance, _ = KDTree(near).query(inside)
        assert np.quantile(distance, 0.95) < 0.04  # of the diameter: vertices are at most 0.06 apart


def test_touching_objects_touch_and_others_do_not(capture):
    clouds = [at(capture.world_from_object, i) @ mesh.vertices for i, mesh in enumerate(capture.meshes)]
    gap = lambda a, b: KDTree(clouds[a][:, :2]).query(clouds[b][:, :2])[0].min()
    assert gap(0, 1) < 0.012 and min(gap(0, 2), gap(1, 2)) > 0.025
    assert all(cloud[:, 2].min() == pytest.approx(0, abs=1e-6) for cloud in clouds)


def test_raw_depth_registers_onto_the_truth(capture):
    known = (capture.depth > 0) & (capture.ids >= -1)
    assert known.mean() > 0.75
    assert np.median(np.abs(capture.depth - capture.true_depth)[known]) < 0.002
    band = round(0.065 * capture.raw_depth.shape[2])
    assert not capture.raw_depth[:, :, :band].any() and (capture.raw_depth[:, :, band:] > 0).mean() > 0.95
    points, _, _ = lift(capture.depth_camera, capture.raw_depth[2])
    moved = capture.colour_from_depth @ points
    x, y = np.rint(project(capture.camera.to_matrix(), moved)).astype(int).T
    inside = (x >= 0) & (x < 200) & (y >= 0) & (y < 150)
    off = np.abs(capture.true_depth[2][y[inside], x[inside]] - moved[inside, 2])
    assert np.median(off) < 0.002
    shift = capture.colour_from_depth.translation
    assert 0.02 < np.linalg.norm(shift) < 0.03


def test_the_gripper_moves_with_the_camera(capture):
    assert 0.01 < capture.gripper.mean() < 0.1
    assert ((capture.ids == -2) == capture.gripper).all()


def test_seeds_decide_and_noise_is_added():
    one, same = (make_capture(1, views=2, objects=1, size=(64, 48)) for _ in range(2))
    np.testing.assert_array_equal(one.rgb, same.rgb)
    np.testing.assert_array_equal(one.depth, same.depth)
    difference = one.factory_colour_from_depth.inverse() @ one.colour_from_depth
    assert 1e-4 < np.linalg.norm(difference.log()[:6]) < 0.05
    assert 0.0002 < np.median(np.abs(one.depth - one.true_depth)[one.depth > 0]) < 0.02


def test_written_captures_hold_no_truth(capture, tmp_path):
    write_capture(capture, tmp_path)
    names = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    images = [f"{kind}/{name}.png" for kind in ("depth", "raw", "rgb") for name in capture.names]
    assert names == sorted([*images, "camera.json", "depth_camera.json"])
    stored = read_depth(tmp_path / "depth" / "000002.png")
    np.testing.assert_allclose(stored * DEPTH_UNIT, capture.depth[2], atol=0.6 * DEPTH_UNIT)
    told = json.loads((tmp_path / "depth_camera.json").read_text())
    np.testing.assert_allclose(told["colour_from_depth"], capture.factory_colour_from_depth.to_matrix())
    write_capture(capture, tmp_path, poses=True)
    poses = json.loads((tmp_path / "poses.json").read_text())
    np.testing.assert_allclose(poses["000003"], capture.world_from_camera.to_matrix()[3])


def test_refuses_what_is_no_capture():
    faults: dict[str, dict[str, Any]] = {
        "two views or more": {"views": 1},
        "at least one object": {"objects": 0},
        "as many positive sizes": {"objects": 2, "sizes": (0.1,)},
    }
    for said, arguments in faults.items():
        with pytest.raises(ValueError, match=said):
            make_capture(0, **arguments)
