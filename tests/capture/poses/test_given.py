"""Poses that were given are taken as they are where they fit the images; how they were misread is told."""

from pathlib import Path

import numpy as np
import pytest
from builders.recognised import SIZE, K, look_around, recognise

from ipjax.capture.poses.features import match
from ipjax.capture.poses.given import check_given, read_given
from ipjax.capture.poses.tracks import join
from ipjax.capture.records import Capture, CaptureError
from ipjax.records import Camera
from ipjax.transforms import Similarity, rotation_from_vector


@pytest.fixture(scope="module")
def tracks():
    features = recognise(look_around(6))
    return join(features, match(features, K, SIZE)[0])


def give(poses: Similarity[np.ndarray] | None) -> Capture:
    camera = Camera.from_matrix(K)
    return Capture(Path("c"), "frames", tuple("abcdef"), camera, SIZE, lambda i: None, world_from_camera=poses)


def test_good_ones_are_kept(tracks):
    poses = look_around(6)
    rng = np.random.default_rng(1)
    rough = poses @ Similarity(
        rotation_from_vector(rng.normal(0, 0.01, (6, 3))), rng.normal(0, 0.003, (6, 3)), np.ones(6)
    )
    for given in (poses, rough):
        found = check_given(read_given(give(given)), tracks, K)
        assert found.source == "given" and found.registered.all() and found.agreement > 0.6
        np.testing.assert_array_equal(found.world_from_camera.translation, given.translation)


FLIP = Similarity(np.diag([1.0, -1, -1]), np.zeros(3), np.ones(()))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: Similarity(p.rotation, 1000 * p.translation, p.scale), r"unit is 0\.001 m"),
        (lambda p: p.inverse(), "camera_from_world, turned around"),
        (lambda p: p @ FLIP, "OpenGL's camera axes"),
        (lambda p: (p @ FLIP).inverse(), "camera_from_world in OpenGL's"),
        (lambda p: Similarity(p.rotation[::-1], p.translation[::-1].copy(), p.scale), "do not fit the images"),
    ],
)
def test_misread_ones_are_refused(tracks, change, said):
    with pytest.raises(CaptureError, match=said):
        check_given(read_given(give(change(look_around(6)))), tracks, K)


def test_what_is_no_trajectory_is_refused():
    poses = look_around(6)
    with pytest.raises(CaptureError, match="no poses are given"):
        read_given(give(None))
    still = Similarity(poses.rotation, np.zeros((6, 3)), np.ones(6))
    with pytest.raises(CaptureError, match="never moves"):
        read_given(give(still))
    broken = Similarity(poses.rotation, np.full((6, 3), np.nan), np.ones(6))
    with pytest.raises(CaptureError, match="not finite"):
        read_given(give(broken))
