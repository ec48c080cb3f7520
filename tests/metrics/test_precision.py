"""Which estimate gets which instance, and the precision of detections."""

import numpy as np
import pytest

from ipjax.metrics import (
    OVERLAPS,
    average_precision,
    box_overlaps,
    mask_overlaps,
    match_overlaps,
    match_poses,
    overlap_precision,
)


def test_matching_is_greedy_strict_and_one_to_one():
    table = np.array([[0.1, 0.3], [0.05, 0.5]])
    np.testing.assert_array_equal(match_poses(table, np.array([0.9, 0.8]), 0.4), [0, -1])
    np.testing.assert_array_equal(match_poses(table, np.array([0.8, 0.9]), 0.4), [1, 0])
    np.testing.assert_array_equal(match_poses(table, np.array([0.9, 0.8]), 0.1), [-1, 0])
    valid = np.array([False, True])
    np.testing.assert_array_equal(match_poses(table, np.array([0.9, 0.8]), 0.4, valid), [1, -1])


def test_average_precision_by_hand():
    assert average_precision(np.array([0.9, 0.8]), np.array([True, True]), 2) == 1.0
    # Half of the truths, found first: precision 1 at the recalls 0 … 0.5 (51 of 101).
    assert average_precision(np.array([0.9, 0.8]), np.array([True, False]), 2) == pytest.approx(51 / 101)
    assert average_precision(np.array([]), np.array([], bool), 3) == 0.0


def test_overlaps_by_hand():
    boxes = np.array([[0.0, 0, 4, 4], [10, 10, 2, 2]])
    truths = np.array([[2.0, 0, 4, 4], [0, 0, 4, 4], [4, 0, 4, 4]])
    np.testing.assert_allclose(box_overlaps(boxes, truths), [[1 / 3, 1, 0], [0, 0, 0]])
    assert box_overlaps(np.zeros((0, 4)), truths).shape == (0, 3)
    grid = np.arange(6)
    drawn = [np.isin(grid, kept).reshape(2, 3) for kept in ([0, 1, 2], [1, 2, 3, 4], [5], [])]
    expected = [[2 / 5, 0, 0], [1, 0, 0]]
    np.testing.assert_allclose(mask_overlaps(np.stack(drawn[:2]), np.stack([drawn[1], *drawn[2:]])), expected)


def test_matching_by_overlap_by_hand():
    table = np.array([[0.8, 0.7], [0.75, 0.6]])
    thresholds = np.array([0.5, 0.65, 0.78])
    np.testing.assert_array_equal(match_overlaps(table, thresholds), [[0, 1], [0, -1], [0, -1]])
    # What need not be found is matched only where nothing else is left; a threshold itself is enough.
    ignored = np.array([True, False])
    np.testing.assert_array_equal(match_overlaps(table, thresholds, ignored), [[1, 0], [1, 0], [0, -1]])
    np.testing.assert_array_equal(match_overlaps(np.array([[0.5, 0.5]]), np.array([0.5])), [[1]])
    np.testing.assert_array_equal(match_overlaps(np.ones((1, 1)), np.ones(1)), [[0]])
    # One right, one matched to what is ignored, one wrong: precision 1 up to the only recall, at which it is found.
    image = np.array([[0.9, 0.0], [0.0, 0.9], [0.0, 0.0]]), np.array([0.9, 0.5, 0.7]), np.array([False, True])
    found = overlap_precision([image], np.array([0.5, 0.95]))
    assert found is not None
    np.testing.assert_allclose(found, [[1.0, 0.0], [1.0, 0.0]])
    # The wrong one before the right one: half of the precision.
    worse = overlap_precision([(image[0], np.array([0.6, 0.5, 0.7]), image[2])], np.array([0.5]))
    assert worse is not None and worse[0][0] == pytest.approx(0.5)
    assert overlap_precision([(image[0][:, 1:], image[1], image[2][1:])]) is None


def slow_match(overlaps, threshold, ignored):
    """COCO's rule in words: truths that count before those that do not, and of them the best that is free."""
    free = [True] * len(ignored)
    matched = []
    for row in overlaps:
        best = -1
        for wanted in (True, False):
            for truth, iou in enumerate(row):
                if free[truth] and ignored[truth] != wanted and iou >= threshold and (best < 0 or iou >= row[best]):
                    best = truth
            if best >= 0:
                free[best] = False
                break
        matched.append(best)
    return matched


def slow_precision(images, threshold):
    """Area under the interpolated curve, from its definition: at each recall the best precision from there on."""
    judged, count = [], 0
    for overlaps, scores, ignored in images:
        count += sum(not one for one in ignored)
        order = sorted(range(len(scores)), key=lambda i: -scores[i])
        for i, truth in zip(order, slow_match([overlaps[i] for i in order], threshold, ignored), strict=True):
            if truth < 0 or not ignored[truth]:
                judged.append((-scores[i], truth >= 0))
    judged.sort(key=lambda one: one[0])
    points, hits = [], 0
    for place, (_, right) in enumerate(judged, start=1):
        hits += right
        points.append((hits / count, hits / place))
    levels = np.linspace(0, 1, 101)
    return np.mean([max((p for r, p in points if r >= level), default=0.0) for level in levels])


def test_precision_is_that_of_the_slow_definition():
    rng = np.random.default_rng(4)
    for _ in range(30):
        images = []
        for _ in range(5):
            count, truths = rng.integers(0, 7), rng.integers(1, 5)
            overlaps = np.round(rng.uniform(0, 1, (count, truths)) ** 0.5, 1)  # with ties
            images.append((overlaps, np.round(rng.uniform(0, 1, count), 1), rng.random(truths) < 0.3))
        found = overlap_precision(images)
        assert found is not None
        np.testing.assert_allclose(found[0], [slow_precision(images, min(t, 1 - 1e-10)) for t in OVERLAPS], atol=1e-12)
