"""Tracks: a point of the scene each, seen once by a frame, and where their rays meet."""

import numpy as np
import pytest
from builders.recognised import SIZE, K, look_around, recognise

from ipjax.capture.poses.features import Features, Match, match
from ipjax.capture.poses.tracks import clean, join, read_tracks, reproject, triangulate, write_tracks
from ipjax.capture.records import CaptureError, Trajectory


@pytest.fixture(scope="module")
def made():
    poses = look_around(6)
    features = recognise(poses)
    return poses, join(features, match(features, K, SIZE)[0])


def test_no_frame_sees_a_track_twice(made):
    _, tracks = made
    pairs = np.stack([tracks.track, tracks.frame], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    np.testing.assert_array_equal(np.lexsort((tracks.frame, tracks.track)), np.arange(len(pairs)))  # sorted
    assert (np.diff(tracks.track) >= 0).all() and np.bincount(tracks.track).min() >= 2
    assert len(tracks) == tracks.count == tracks.track.max() + 1 > 300


def test_a_wrong_match_does_not_join_two_points():
    """Two points, seen by three frames each, and a less likely match between them: two tracks all the same."""
    features = [Features(np.eye(2) * 100, np.ones(2), np.zeros((2, 128), np.float32), np.arange(2)) for _ in range(3)]
    right, alike = np.array([[0, 0], [1, 1]]), np.array([0.99, 0.98])
    matches = [Match(0, 1, right, alike), Match(1, 2, right, alike), Match(0, 2, np.array([[0, 1]]), np.array([0.9]))]
    tracks = join(features, matches)
    assert tracks.count == 2 and np.bincount(tracks.track).tolist() == [3, 3]
    np.testing.assert_array_equal(tracks.pixel[:3], [[100, 0]] * 3)
    assert join(features, []).count == 0


def test_rays_meet_at_the_point(made):
    poses, tracks = made
    points, told = triangulate(tracks, poses, K, np.ones(6, bool))
    off, own = reproject(tracks, points, poses, K)
    good = told[tracks.track] & (off < 2)
    assert good.mean() > 0.97 and np.median(off[good]) < 0.4
    measured = good & (tracks.depth > 0)
    assert abs(np.median(own[measured] / tracks.depth[measured]) - 1) < 5e-4
    none, told = triangulate(tracks, poses, K, np.zeros(6, bool))
    assert np.isfinite(none).all() and not told.any()


def test_what_the_poses_do_not_explain_is_left_out(made):
    poses, tracks = made
    known = np.array([True] * 5 + [False])
    left = clean(tracks, Trajectory(tuple("abcdef"), poses, known, "given"), K, 3.0)
    assert 0.7 * tracks.count < left.count <= tracks.count and left.frame.max() == 4
    points, _ = triangulate(left, poses, K, known)
    assert np.percentile(reproject(left, points, poses, K)[0], 99) < 3


def test_files_come_back_as_they_were(made, tmp_path):
    _, tracks = made
    path = write_tracks(tmp_path / "tracks.npz", tracks)
    again = read_tracks(path)
    for name in ("frame", "track", "pixel", "depth"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))
    assert again.count == tracks.count
    first = path.read_bytes()
    assert write_tracks(path, tracks).read_bytes() == first
    path.write_bytes(first[:100])
    with pytest.raises(CaptureError, match=r"tracks\.npz"):
        read_tracks(path)
    np.savez(path, frame=np.zeros(3, int))
    with pytest.raises(CaptureError, match="no file of tracks"):
        read_tracks(path)
