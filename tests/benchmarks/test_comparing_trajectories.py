"""Trajectories are compared with the worlds free, and a constant offset of the camera where that is asked."""

import numpy as np
from builders.recognised import look_around

from benchmarks.captures.comparing import compare, compare_scale
from ipjax.transforms import Similarity, rotation_from_vector


def test_worlds_and_a_constant_offset_are_free():
    truth, known = look_around(10, arc=4.0), np.array([True] * 9 + [False])
    rigid = lambda turn, shift: Similarity(rotation_from_vector(np.array(turn)), np.array(shift), np.ones(()))
    world, camera = rigid([0.3, -2.0, 1.0], [1.0, 2, -3]), rigid([0.01, -0.02, 0.005], [0.004, 0.003, -0.006])
    places, turned = compare(world @ truth, truth, known)
    assert len(places) == 9 and places.max() < 1e-6 and turned.max() < 1e-4
    moved = world @ truth @ camera
    assert compare(moved, truth, known)[0].max() > 0.002
    places, turned = compare(moved, truth, known, offset=True)
    assert places.max() < 4e-4 and turned.max() < 0.03  # small offsets are taken for likelier
    larger = Similarity(truth.rotation, 1.01 * truth.translation, truth.scale)
    assert abs(compare_scale(world @ larger, truth, known) - 0.01) < 1e-9
