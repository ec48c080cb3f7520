"""What is measured of a mask does not depend on how the mask is held, and has the values that its shape says."""

import dataclasses

import numpy as np
import pytest
from builders.tables import RED, THREE, table_frame

from ipjax.detection.proposals.objectness import count_votes, find_steps, judge, measure_masks, measure_regions
from ipjax.detection.proposals.segments import describe_segments
from ipjax.detection.proposals.surfaces import make_surfaces


@pytest.fixture(scope="module")
def surfaces():
    rgb, depth, matrix, _ = table_frame(THREE, 120, 160)
    return make_surfaces(rgb, depth, matrix, 160, 120)


def test_masks_of_segments_are_measured_as_any_others(surfaces):
    rng = np.random.default_rng(0)
    y, x = np.indices(surfaces.shape)
    segments = describe_segments(surfaces, (y // 20) * 8 + x // 20)
    members = rng.uniform(size=(12, len(segments.area))) < 0.4
    on = rng.uniform(size=surfaces.shape) < 0.5
    steps = find_steps(surfaces)
    one = measure_regions(members, segments, steps, surfaces, on)
    other = measure_masks(members[:, segments.labels], steps, surfaces, on)
    for field in dataclasses.fields(one):
        name = field.name
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=2e-4, atol=1e-5, err_msg=name)


def test_measures_of_a_block_and_of_a_piece_of_table():
    rgb, depth, matrix, masks = table_frame([((60, 40, 100, 80), RED, 0.1)], 120, 160, noise=0)
    surfaces = make_surfaces(rgb, depth, matrix, 160, 120)
    beside = np.zeros_like(masks[0])
    beside[20:60, 0:40] = True
    around = np.zeros_like(masks[0])
    around[35:85, 55:105] = ~masks[0][35:85, 55:105]  # a ring: the block is a hole in it
    on = ~masks[0]
    measured = measure_masks(np.stack([masks[0], beside, around]), find_steps(surfaces), surfaces, on)
    assert measured.strength[0] > 0.95 and measured.strength[1] < 0.2
    assert measured.ahead[0] > 0.9 and measured.ahead[2] < -0.3
    np.testing.assert_allclose(measured.share[:2], 1600 / 19200)
    np.testing.assert_allclose(measured.solidity[:2], 3 / np.pi, rtol=1e-2)  # of a rectangle
    np.testing.assert_allclose(measured.at_rim, [0, 0.25, 0])
    np.testing.assert_allclose(measured.on_plane, [0, 1, 1])
    # 40 pixels at 0.9 m, of a bar of the same spread.
    np.testing.assert_allclose(measured.length[0], 40 * 0.9 / 300, rtol=0.05)
    score = judge(measured)
    assert score[0] > score[1] and score[0] > score[2]


def test_votes_count_ways_not_masks():
    masks = np.zeros((4, 50), bool)
    masks[0, :10] = masks[1, :10] = masks[2, :9] = masks[3, 30:] = True
    np.testing.assert_array_equal(count_votes(masks, np.array([0b001, 0b001, 0b110, 0b100])), [3, 3, 3, 1])


def test_no_masks_are_no_error(surfaces):
    none = np.zeros((0, *surfaces.shape), bool)
    measured = measure_masks(none, find_steps(surfaces), surfaces, np.zeros(surfaces.shape, bool))
    assert judge(measured).shape == (0,)
