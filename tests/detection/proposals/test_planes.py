"""Planes are those that the frame was drawn with; balls of a known size hold what has that size."""

import numpy as np
from builders.tables import RED, THREE, table_frame

from ipjax.detection.proposals.components import find_basins, find_components
from ipjax.detection.proposals.planes import find_planes, mark_planes
from ipjax.detection.proposals.surfaces import make_surfaces
from ipjax.detection.proposals.windows import find_windows


def plane_frame(height=120, width=160):
    """A plane with a given normal, without noise; its depth is exact."""
    matrix = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
    normal = np.array([0.1, -0.6, -0.7])
    normal /= np.linalg.norm(normal)
    y, x = np.indices((height, width))
    rays = np.stack([(x - 80) / 150, (y - 60) / 150, np.ones_like(x)], -1)
    return np.full((height, width, 3), 90, np.uint8), (-0.6 / (rays @ normal)).astype(np.float32), matrix, normal


def test_finds_the_plane_that_was_drawn():
    rgb, depth, matrix, normal = plane_frame()
    surfaces = make_surfaces(rgb, depth, matrix, 160, 120)
    (plane,) = find_planes(surfaces, 3, 0.008, 0.05)
    np.testing.assert_allclose(plane[:3], normal, atol=5e-3)
    np.testing.assert_allclose(plane[3], 0.6, atol=5e-3)  # the camera is in front
    assert mark_planes(surfaces, [plane], 0.008).mean() > 0.98
    # A plane has no steps of depth, however slanted it is seen.
    assert max(jump[5:-5, 5:-5].max() for jump in surfaces.jump) < 2e-3


def test_a_block_is_off_the_plane_and_is_one_piece():
    rgb, depth, matrix, masks = table_frame(THREE)
    surfaces = make_surfaces(rgb, depth, matrix, 320, 240)
    on = mark_planes(surfaces, find_planes(surfaces, 1, 0.008, 0.05), 0.008)
    assert on[masks.any(0)].mean() < 0.1 and on[~masks.any(0)].mean() > 0.9
    for pieces in (find_components(surfaces, ~on), find_basins(surfaces)):
        for mask in masks:
            assert max((piece & mask).sum() / (piece | mask).sum() for piece in pieces) > 0.85


def test_no_plane_where_nothing_is_known():
    rgb, depth, matrix, _ = plane_frame()
    surfaces = make_surfaces(rgb, np.zeros_like(depth), matrix, 160, 120)
    assert find_planes(surfaces, 3, 0.008, 0.05) == []
    assert np.isfinite(surfaces.points).all() and np.isfinite(surfaces.normals).all()
    assert not any(step.any() for step in (*surfaces.jump, *surfaces.crease))


def test_a_ball_of_the_size_of_each_of_two_blocks_tells_them_apart():
    """They touch, have one colour and one height: only their size says that they are two."""
    blocks = [((100, 100, 130, 130), RED, 0.1), ((130, 100, 160, 130), RED, 0.1)]
    rgb, depth, matrix, masks = table_frame(blocks)
    surfaces = make_surfaces(rgb, depth, matrix, 320, 240)
    off = masks[0] | masks[1]
    windows = find_windows(surfaces, off, [0.1])
    for mask in masks:
        assert max((window & mask).sum() / (window | mask).sum() for window in windows) > 0.5
    assert not (windows & ~off).any()
    assert find_windows(surfaces, off, []).shape == (0, 240, 320)
