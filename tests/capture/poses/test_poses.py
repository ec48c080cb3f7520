"""Poses from features, with their depth or through COLMAP: metric, named where missing, refused where wrong."""

import dataclasses

import numpy as np
import pytest
from builders.recognised import SIZE, K, compare, look_around, recognise

from ipjax.capture.poses import structure
from ipjax.capture.poses.features import Match, match
from ipjax.capture.poses.rgbd import find_by_depth
from ipjax.capture.poses.scale import make_metric, vote
from ipjax.capture.records import CaptureError, Trajectory

NAMES = tuple("abcdefgh")
needs_pycolmap = pytest.mark.skipif(not structure.is_available(), reason="pycolmap is not installed")


def find(way: str, features, matches) -> Trajectory:
    if way == "depth":
        return find_by_depth(NAMES, features, matches, K)
    return make_metric(NAMES, structure.map_incrementally(NAMES, features, matches, K, SIZE))[0]


WAYS = ["depth", pytest.param("structure", marks=needs_pycolmap)]


@pytest.fixture(scope="module")
def truth():
    return look_around(8)


@pytest.mark.parametrize("way", WAYS)
def test_finds_all_frames_in_metres(way, truth):
    features = recognise(truth)
    matches, _ = match(features, K, SIZE)
    found = find(way, features, matches)
    assert found.registered.all() and found.names == NAMES and found.agreement > 0.9
    apart, turned = compare(found.world_from_camera, truth, found.registered)
    assert np.median(apart) < 0.0015 and np.median(turned) < 0.1
    path = lambda poses: np.linalg.norm(np.diff(poses.translation, axis=0), axis=1).sum()
    assert abs(path(found.world_from_camera) / path(truth) - 1) < 0.003
    again = find(way, features, matches)
    np.testing.assert_array_equal(again.world_from_camera.translation, found.world_from_camera.translation)


@pytest.mark.parametrize("way", WAYS)
def test_a_frame_that_sees_something_else_is_named(way, truth):
    features = recognise(truth)
    features[3] = recognise(truth, seed=9)[3]
    found = find(way, features, match(features, K, SIZE)[0])
    assert found.registered.tolist() == [True, True, True, False, True, True, True, True]
    assert (found.world_from_camera.to_matrix()[3] == np.eye(4)).all()


@pytest.mark.parametrize("way", WAYS)
def test_depth_that_does_not_belong_is_refused(way, truth):
    features = recognise(truth)
    rng = np.random.default_rng(2)
    wrong = [dataclasses.replace(one, depth=rng.uniform(0.3, 1.5, len(one))) for one in features]
    matches, _ = match(features, K, SIZE)
    with pytest.raises(CaptureError, match=r"agree|could be placed"):
        find(way, wrong, matches)


@pytest.mark.parametrize("way", WAYS)
def test_too_little_in_common_is_refused(way, truth):
    features = [recognise(truth, seed=seed)[seed] for seed in range(8)]
    with pytest.raises(CaptureError, match=r"without a place are .*texture|no two frames to begin with"):
        find(way, features, match(features, K, SIZE)[0])
    empty = Match(0, 1, np.zeros((0, 2), int), np.zeros(0))
    with pytest.raises(CaptureError, match="texture"):
        find(way, features, [empty])


@pytest.mark.parametrize("unit", [0.001, 1.0, 2.5])
def test_votes_find_the_scale(unit):
    rng = np.random.default_rng(0)
    own = rng.uniform(0.5, 3, 2000)
    measured = own * unit * (1 + rng.normal(0, 0.003, 2000))
    measured[:600] = rng.uniform(0.2, 4, 600) * unit
    measured[600:800] = 0
    found = vote(measured, own)
    assert abs(found.value / unit - 1) < 3e-4 and found.votes == 1800 and 0.64 < found.share < 0.72
    assert not found.agreeing[600:800].any() and found.agreeing[800:].all()
    assert vote(np.zeros(3), np.ones(3)) is None and vote(np.ones(3), -np.ones(3)) is None


def test_without_pycolmap_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(structure, "find_spec", lambda name: None)
    with pytest.raises(CaptureError, match=r"pip install 'ipjax\[capture\]'"):
        structure.map_incrementally(NAMES, [], [], K, SIZE)
