"""Features lie where they are, matches belong together, and what moves with the camera is found."""

import cv2
import numpy as np
import pytest
from builders.recognised import SIZE, K, look_around, recognise

from ipjax.capture.poses.features import choose_pairs, detect, find_still, match, sample_depth
from ipjax.capture.records import CaptureFrame


def make_frame(image: np.ndarray, depth: np.ndarray | None = None) -> CaptureFrame:
    return CaptureFrame("a", image, depth, None, np.ones(image.shape[:2], bool))


def draw_texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).random((240, 320, 3)).astype(np.float32)
    image = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (2, 4, 8))
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def test_features_lie_where_they_are():
    """The mean offset of matched points is the shift of the image, a fraction of a pixel, and so is a turned one's."""
    image = draw_texture()
    for angle, shift in ((0.0, (3.25, -2.5)), (0.3, (10.4, 5.7))):
        turn = np.array([[np.cos(angle), -np.sin(angle), shift[0]], [np.sin(angle), np.cos(angle), shift[1]]])
        features = [detect(make_frame(x)) for x in (image, cv2.warpAffine(image, turn, (320, 240)))]
        (pair,), still = match(features, K, SIZE)
        first, second = features[0].pixel[pair.points[:, 0]], features[1].pixel[pair.points[:, 1]]
        off = first @ turn[:, :2].T + turn[:, 2] - second
        assert len(pair) > 100 and not still.any()
        assert np.abs(np.median(off, axis=0)).max() < 0.05 and np.median(np.abs(off)) < 0.15


def test_nothing_is_recognised_where_nothing_is_usable():
    image, usable = draw_texture(), np.ones((240, 320), bool)
    usable[:, :160] = False
    found = detect(CaptureFrame("a", image, None, None, usable))
    assert len(found) > 50 and found.pixel[:, 0].min() >= 160 and not found.depth.any()
    flat = detect(make_frame(np.full((240, 320, 3), 90, np.uint8)))
    assert len(flat) == 0 and flat.descriptor.shape == (0, 128)


def test_depth_between_pixels():
    rows, columns = np.mgrid[:40, :50]
    plane = 1 + 0.001 * rows + 0.002 * columns
    pixel = np.random.default_rng(1).uniform(1, 38, (200, 2))
    true = 1 + 0.001 * pixel[:, 1] + 0.002 * pixel[:, 0]
    np.testing.assert_allclose(sample_depth(plane, pixel), true, atol=1e-12)
    holes = np.where(np.random.default_rng(2).random(plane.shape) < 0.6, 0, plane)
    found = sample_depth(holes, pixel)
    assert (found > 0).mean() > 0.9 and np.abs(found - true)[found > 0].max() < 0.003
    step = np.where(columns < 25, 1.0, 1.5)
    assert sample_depth(step, np.array([[24.5, 10.0], [-0.7, 5], [49, 39], [5, 5]])).tolist() == [0, 0, 1.5, 1]
    assert not sample_depth(np.zeros((40, 50)), pixel).any()


def test_matches_belong_together():
    """Of points with descriptors of their own nearly all are matched, and none with another's, or with what is new."""
    poses = look_around(4)
    features = recognise(poses, strange=200)
    matches, _ = match(features, K, SIZE)
    assert {(m.first, m.second) for m in matches} == {(i, j) for i in range(4) for j in range(i + 1, 4)}
    for found in matches:
        first, second = features[found.first], features[found.second]
        looks = first.descriptor[found.points[:, 0]] * second.descriptor[found.points[:, 1]]
        assert looks.sum(1).min() > 0.9 and len(found) > 60
        assert len(np.unique(found.points[:, 0])) == len(np.unique(found.points[:, 1])) == len(found)


def test_of_many_frames_those_are_paired_that_see_the_same():
    """Two scenes, 45 frames: beyond neighbours in time no pair goes from one to the other."""
    one, other = recognise(look_around(23, arc=1), points=300), recognise(look_around(22, arc=1), points=300, seed=8)
    pairs = choose_pairs(one + other)
    assert len(pairs) < 45 * 44 / 2 * 0.7
    assert all((i < 23) == (j < 23) for i, j in pairs if j - i > 2)
    assert {(i, i + 1) for i in range(44)} <= set(pairs)


@pytest.mark.parametrize("gripper", [True, False])
def test_what_moves_with_the_camera_is_found(gripper):
    """A patch that every frame has at the same place, while the scene behind it moves by 60 pixels a frame."""
    scene, finger = draw_texture(3), draw_texture(4)[:90, :80]
    wide = np.concatenate([scene, draw_texture(5), draw_texture(6)], axis=1)
    images = [wide[:, 60 * step : 60 * step + 320].copy() for step in range(6)]
    if gripper:
        for image in images:
            image[150:, 20:100] = finger
    features = [detect(make_frame(image)) for image in images]
    matches, still = match(features, K, SIZE)
    assert still.any() == gripper
    if gripper:
        inside = np.zeros((240, 320), bool)
        inside[135:, 5:115] = True
        # Found from its own points, of which none lies at its border; and not much more than it is.
        assert still[165:230, 35:85].mean() > 0.9 and not (still & ~inside).any()
    moved = [features[m.second].pixel[m.points[:, 1]] - features[m.first].pixel[m.points[:, 0]] for m in matches]
    assert np.abs(np.concatenate(moved)[:, 0]).min() > 50
    assert not find_still(features, [], SIZE).any()
