"""Refined poses: they converge from afar, know how well they are known, and say what the scene does not tell."""

import numpy as np
import pytest
from builders.ray_cast import K, cast, go_around

from ipjax.capture.records import CaptureError, Tracks, Trajectory
from ipjax.capture.refinement.certainty import off_by
from ipjax.capture.refinement.refining import describe, refine_frames
from ipjax.records import Camera
from ipjax.transforms import Similarity

COUNT = 8
CAMERA = Camera.from_matrix(K)
NAMES = tuple("abcdefgh")


def perturb(poses, degrees, millimetres, seed=0):
    rng = np.random.default_rng([seed, 9])
    size = np.repeat([np.deg2rad(degrees), millimetres / 1000], 3)
    return poses @ Similarity.exp(size * rng.normal(size=(len(poses.scale), 6)))


def given(poses, registered=None):
    return Trajectory(NAMES, poses, np.ones(COUNT, bool) if registered is None else registered, "given")


@pytest.fixture(scope="module")
def scene():
    truth = go_around(COUNT, arc=np.pi)
    return truth, list(cast(truth, noise=0.001))


def sizes(error):
    return np.linalg.norm(error[:, 3:], axis=1), np.rad2deg(np.linalg.norm(error[:, :3], axis=1))


@pytest.fixture(scope="module")
def refined(scene):
    return refine_frames(scene[1], None, CAMERA, given(perturb(scene[0], 2, 15)))


def test_converges_from_two_degrees_and_15_mm(scene, refined):
    apart, turned = sizes(off_by(refined.trajectory.world_from_camera, scene[0]))
    assert np.median(apart) < 0.001 and apart.max() < 0.002
    assert np.median(turned) < 0.06 and turned.max() < 0.15
    assert refined.sure.all() and not any(refined.remarks)
    assert refined.trajectory.covariance.shape == (COUNT, 6, 6)
    assert refined.share_after.mean() > refined.share_before.mean() + 0.2
    assert "8 of 8 poses are sure" in describe(refined, 0.02, 0.001)[0]


def test_a_frame_without_a_pose_stays_without(scene):
    truth, depths = scene
    registered = ~np.isin(np.arange(COUNT), [2, 7])
    one = given(perturb(truth, 0.2, 2), registered)
    found = refine_frames([d for d, known in zip(depths, registered, strict=True) if known], None, CAMERA, one)
    assert not found.trajectory.registered[2] and not found.sure[2] and not np.isin(found.pairs, [2, 7]).any()
    assert found.sure[registered].all()
    with pytest.raises(CaptureError, match="1 of 8 frames have a pose"):
        refine_frames(depths[:1], None, CAMERA, given(truth, np.arange(COUNT) == 0))


def test_says_what_a_plane_does_not_tell():
    truth = go_around(COUNT, arc=np.pi)
    start = perturb(truth, 0.5, 8)
    found = refine_frames(list(cast(truth, things=False, noise=0.001)), None, CAMERA, given(start))
    assert not found.sure.any()
    assert all("not determined" in text and "sliding along" in text for text in found.remarks)
    # What is told, the height above the plane and the tilt, is right; what is not stays where it was said to be.
    apart, _ = sizes(off_by(found.trajectory.world_from_camera, truth))
    assert apart.max() < 0.05


def test_points_tell_what_the_registration_of_depth_is_off_by(scene):
    truth, depths = scene
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.25, -0.25, 0], [0.25, 0.25, 0.1], (150, 3))
    off = Similarity.exp(np.array([0.003, -0.002, 0.002, 0.003, -0.002, 0.001]))
    cameras = truth @ off.inverse()  # the depth is seen from beside the colours
    frame, track, pixel = [], [], []
    for k in range(COUNT):
        local = cameras.take(k).inverse() @ points
        seen = local[:, :2] / local[:, 2:] * np.diag(K)[:2] + K[:2, 2]
        frame += [k] * len(points)
        track += list(range(len(points)))
        pixel.append(seen + rng.normal(0, 0.2, seen.shape))
    order = np.lexsort((frame, track))
    tracks = Tracks(np.array(frame)[order], np.array(track)[order], np.concatenate(pixel)[order],
                    np.zeros(len(frame)), len(points))  # fmt: skip
    found = refine_frames(depths, None, CAMERA, given(perturb(cameras, 0.2, 3)), tracks)
    assert found.offset_told
    left = (found.camera_from_depth.inverse() @ off).log()
    assert np.abs(left[3:6]).max() < 0.0012 and np.rad2deg(np.abs(left[:3]).max()) < 0.06
    apart, turned = sizes(off_by(found.trajectory.world_from_camera, cameras))
    assert np.median(apart) < 0.001 and np.median(turned) < 0.06
