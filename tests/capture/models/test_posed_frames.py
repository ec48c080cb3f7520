"""Frames whose poses are known, with the depth that an earlier step made."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from ipjax.capture.models.frames import CaptureFrames, lift, trust_depth
from ipjax.capture.records import Capture, CaptureError, CaptureFrame, Trajectory
from ipjax.records import Camera
from ipjax.transforms import Similarity

NAMES = ("a", "b", "c")


def read_frame(index):
    depth = np.full((6, 8), 0.5, np.float32)
    depth[:, 6:] = 0.9  # a step
    usable = np.ones((6, 8), bool)
    usable[0] = False
    return CaptureFrame(NAMES[index], np.zeros((6, 8, 3), np.uint8), depth if index else None, None, usable)


CAPTURE = Capture(Path("table"), "frames", NAMES, Camera(jnp.full(2, 100.0), jnp.array([3.5, 2.5])), (8, 6), read_frame)


def trajectory(*known):
    poses = Similarity(np.tile(np.eye(3), (3, 1, 1)), np.arange(9.0).reshape(3, 3), np.ones(3))
    return Trajectory(NAMES, poses, np.array(known), "given")


def test_frames_without_a_pose_are_left_out():
    frames = CaptureFrames(CAPTURE, trajectory(False, True, True))
    assert [frame.name for frame in frames] == ["b", "c"] and len(frames[0:1]) == 1
    np.testing.assert_array_equal(frames[1].world_from_camera.translation, [6, 7, 8])
    with pytest.raises(CaptureError, match="two are needed"):
        CaptureFrames(CAPTURE, trajectory(False, False, True))
    with pytest.raises(CaptureError, match="ipjax capture depth"):
        CaptureFrames(CAPTURE, trajectory(True, True, True))[0]


def test_pixels_on_steps_and_on_what_moves_along_are_not_trusted():
    frame = CaptureFrames(CAPTURE, trajectory(False, True, True), ignore=np.indices((6, 8))[1] == 0)[0]
    trusted = trust_depth(frame) > 0
    assert not trusted[0].any() and not trusted[:, 0].any() and not trusted[:, 5:7].any() and trusted[1:, 1:5].all()
    points, _ = lift(frame)
    assert set(np.round(points[:, 2] - 5, 6)) == {0.5, 0.9}


def test_depth_of_the_step_before_is_taken_with_its_confidence(tmp_path):
    for folder, image in (("depth", np.full((6, 8), 4321, np.uint16)), ("confidence", np.full((6, 8), 51, np.uint8))):
        (tmp_path / folder).mkdir()
        Image.fromarray(image).save(tmp_path / folder / "b.png")
    frames = CaptureFrames(CAPTURE, trajectory(False, True, True), tmp_path)
    np.testing.assert_allclose(frames[0].depth, 0.4321, rtol=1e-6)
    np.testing.assert_allclose(trust_depth(frames[0])[1:], 0.2, rtol=1e-6)
    with pytest.raises(CaptureError, match=r"c\.png"):
        frames[1]
