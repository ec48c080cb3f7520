"""The plane that things stand on, found or clicked."""

import numpy as np
import pytest

from ipjax.capture.models.frames import PosedFrame, lift
from ipjax.capture.models.support import find_support, find_support_at
from ipjax.capture.records import CaptureError
from ipjax.transforms import Similarity, rotation_from_vector

K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])


def photograph(turn):
    """A table, z = 0, with a box of 10 cm on it, from 0.6 m, from a side."""
    tilt = rotation_from_vector(np.array([np.pi - 0.7, 0.0, 0.0]))  # looks down and ahead
    rotation = rotation_from_vector(np.array([0.0, 0.0, turn])) @ tilt
    eye = -0.6 * rotation[:, 2]
    rows, columns = np.mgrid[:120, :160]
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones((120, 160))], -1) @ rotation.T
    depth = -eye[2] / rays[..., 2]
    with np.errstate(divide="ignore"):
        first, last = (np.array(c) - eye for c in ([-0.05, -0.05, 0.0], [0.05, 0.05, 0.1]))
        near, far = np.minimum(first / rays, last / rays).max(-1), np.maximum(first / rays, last / rays).min(-1)
    depth = np.where((near < far) & (near < depth), near, depth)
    depth = np.where((depth > 0) & (depth < 1.2), depth, 0).astype(np.float32)
    pose = Similarity(rotation, eye, np.ones(()))
    return PosedFrame(f"{turn:.1f}", np.full((120, 160, 3), 99, np.uint8), depth, np.ones(depth.shape, bool), K, pose)


FRAMES = [photograph(turn) for turn in np.arange(8) * np.pi / 4]
POINTS = np.concatenate([lift(frame, 2)[0] for frame in FRAMES])


@pytest.mark.parametrize("clicked", [False, True])
def test_the_table_is_found(clicked):
    found = find_support_at(FRAMES[1], 20, 60, POINTS) if clicked else find_support(FRAMES, POINTS)
    np.testing.assert_allclose(found.axes[:, 2], [0, 0, 1], atol=2e-3)
    top = np.array([[0.0, 0, 0.1], [0.04, 0.04, 0.0], [5, 5, 0.02]])
    np.testing.assert_allclose(found.heights(top[:2]), [0.1, 0], atol=2e-3)
    assert found.covers(top).tolist() == [True, True, False]  # what stands on it hides it, and it is there all the same


def test_a_click_may_mean_another_plane():
    found = find_support_at(FRAMES[0], *locate_top(FRAMES[0]), POINTS)
    np.testing.assert_allclose(found.heights(np.array([[0.0, 0, 0.1]])), [0], atol=2e-3)


def locate_top(frame):
    """The pixel of the middle of the box's top."""
    point = (frame.camera_from_world @ np.array([[0.0, 0, 0.1]]))[0]
    return (K @ point / point[2])[:2].tolist()


def test_clicks_that_mean_nothing_are_refused():
    with pytest.raises(CaptureError, match="outside"):
        find_support_at(FRAMES[0], 400, 10, POINTS)
    blind = photograph(0.0)
    blind.depth[:] = 0
    with pytest.raises(CaptureError, match="no depth"):
        find_support_at(blind, 80, 100, POINTS)
