"""Turns that leave a model as it is."""

import dataclasses

import numpy as np
import pytest
import trimesh

from ipjax.capture.models.symmetries import find_symmetries
from ipjax.files.meshes.mesh import make_mesh


def as_mesh(shape, colours=None):
    dense = shape.subdivide_to_size(0.02)
    return make_mesh(dense.vertices, dense.faces, colours=colours and colours(dense.vertices))


BOX = as_mesh(trimesh.creation.box((0.2, 0.12, 0.07)))


@pytest.mark.parametrize(
    ("shape", "discrete", "continuous"),
    [
        (trimesh.creation.box((0.2, 0.12, 0.07)), 3, 0),
        (trimesh.creation.box((0.12, 0.12, 0.07)), 7, 0),
        (trimesh.creation.cylinder(0.06, 0.1, sections=48), 1, 1),
        (trimesh.creation.cone(0.08, 0.12, sections=48), 0, 1),
    ],
)
def test_shapes_have_the_turns_that_they_have(shape, discrete, continuous):
    found = find_symmetries(as_mesh(shape))
    assert (len(found.discrete), len(found.continuous)) == (discrete, continuous)
    low, high = shape.bounds
    for matrix in found.discrete:
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        turned = np.array([[*low, 1], [*high, 1]]) @ matrix.T  # a box's corners go to corners
        np.testing.assert_allclose(np.sort(turned[:, :3], 0), np.stack([low, high]), atol=2e-3)


def test_colours_contradict():
    left = lambda points: np.where(points[:, :1] > 0, [200, 40, 40], [40, 40, 200]).astype(np.uint8)
    two = as_mesh(trimesh.creation.box((0.2, 0.12, 0.07)), left)
    assert len(find_symmetries(two).discrete) == 1  # about x, the two colours stay where they are
    assert len(find_symmetries(two, colour=None).discrete) == 3


def test_what_is_not_symmetric_is_not():
    wedge = trimesh.Trimesh(
        np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.1, 0], [0.05, 0.03, 0.12]]),
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
    )
    found = find_symmetries(as_mesh(wedge))
    assert not found.discrete and not found.continuous


def test_a_bottom_that_was_not_seen_is_not_asked():
    open_below = BOX.faces[(BOX.vertices[BOX.faces][:, :, 2] > -0.0349).any(1)]
    found = find_symmetries(dataclasses.replace(BOX, faces=open_below))
    assert any(np.allclose(matrix[:3, :3], np.diag([-1, -1, 1]), atol=1e-6) for matrix in found.discrete)


def test_bop_has_millimetres_in_the_last_column():
    moved = dataclasses.replace(BOX, vertices=BOX.vertices + np.array([0.1, 0, 0]))
    entries = find_symmetries(moved).to_bop()["symmetries_discrete"]
    upright = next(np.reshape(e, (4, 4)) for e in entries if e[10] == pytest.approx(1))
    np.testing.assert_allclose(upright[:, 3], [200, 0, 0, 1], atol=0.5)
