"""Poses of single frames become one, and those that are wrong are voted out."""

import numpy as np
import pytest

from ipjax.capture.labels.known import find_known, fuse_poses
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.records import CaptureError
from ipjax.metrics.poses import rotation_error
from ipjax.transforms import Similarity, rotation_from_vector


def stack(poses):
    return Similarity.stack(poses)


def make_poses(rng, truth, symmetries, right=9, wrong=5):
    """Right ones, off by 1° and 2 mm and each turned by some symmetry; then wrong ones."""
    found = []
    for k in range(right):
        s = symmetries[k % len(symmetries)]
        step = np.concatenate([rng.normal(0, np.deg2rad(0.6), 3), rng.normal(0, 0.0012, 3)])
        off = Similarity(rotation_from_vector(step[:3]), step[3:], np.ones(()))
        placed = truth @ s
        found.append(Similarity(off.rotation @ placed.rotation, placed.translation + off.translation, placed.scale))
    for _ in range(wrong):
        found.append(Similarity(rotation_from_vector(rng.normal(0, 1.5, 3)), rng.normal(0, 0.2, 3), truth.scale))
    return stack(found)


ONE = Similarity(np.eye(3), np.zeros(3), np.ones(()))
HALF = Similarity(np.diag([-1.0, -1, 1]), np.array([0.1, 0, 0]), np.ones(()))


@pytest.mark.parametrize("symmetries", [[ONE], [ONE, HALF]])
def test_the_truth_is_found_among_wrong_poses(symmetries):
    rng = np.random.default_rng(5)
    truth = Similarity(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3), np.asarray(0.2))
    poses = make_poses(rng, truth, symmetries)
    fused = fuse_poses(poses, rng.uniform(0.5, 1, 14), 0.2, stack(symmetries))
    assert fused.agreeing[:9].all() and not fused.agreeing[9:].any()
    off = [rotation_error((truth @ s).rotation, fused.world_from_object.rotation) for s in symmetries]
    best = int(np.argmin(off))
    shift = (truth @ symmetries[best]).translation - fused.world_from_object.translation
    assert np.rad2deg(off[best]) < 0.6 and np.linalg.norm(shift) < 0.0015
    assert float(fused.world_from_object.scale) == pytest.approx(0.2)
    assert fused.share == pytest.approx(9 / 14) and np.rad2deg(fused.turn) < 2 and fused.shift < 0.004


def test_no_pose_is_refused():
    nothing = Similarity(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
    with pytest.raises(ValueError, match="no pose"):
        fuse_poses(nothing, np.zeros(0), 0.2)


def make_frames(rng, count=6):
    """Frames in which a known thing is on the right, and another on the left."""
    frames, masks = [], []
    for k in range(count):
        pose = Similarity(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3), np.ones(()))
        image = np.zeros((4, 6, 3), np.uint8)
        frames.append(PosedFrame(str(k), image, np.ones((4, 6)), np.ones((4, 6), bool), np.eye(3), pose))
        left = np.zeros((4, 6), bool)
        left[:, : 2 + k % 2] = True
        masks.append(np.stack([left, ~left]))
    return frames, masks


def test_the_thing_whose_poses_agree_is_the_object():
    rng = np.random.default_rng(6)
    frames, masks = make_frames(rng)
    truth = Similarity(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3), np.asarray(0.15))

    def estimate(frame, mask):
        if mask[0, 0]:  # what is no object gets poses that no two frames agree on, and sure of them
            return Similarity(rotation_from_vector(rng.normal(0, 2, 3)), rng.normal(size=3), np.asarray(0.15)), 0.9
        return None if frame.name == "3" else (frame.camera_from_world @ truth, 0.6)

    thing, fused = find_known(frames, masks, estimate)
    assert thing == 1 and fused.share == 1 and len(fused.agreeing) == 5
    np.testing.assert_allclose(fused.world_from_object.translation, truth.translation, atol=1e-9)
    np.testing.assert_allclose(fused.world_from_object.rotation, truth.rotation, atol=1e-9)
    with pytest.raises(CaptureError, match="mug"):
        find_known(frames, masks, lambda frame, mask: estimate(frame, ~mask if mask[0, 5] else mask), name="mug")
