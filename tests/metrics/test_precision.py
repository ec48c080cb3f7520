"""Which estimate gets which instance, and the precision of detections."""

import numpy as np
import pytest

from ipjax.metrics import average_precision, match_poses


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
