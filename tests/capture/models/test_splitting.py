"""Surfaces are cut where two things meet, and nowhere else."""

import numpy as np
import pytest
from skimage.measure import marching_cubes

from ipjax.capture.models.splitting import make_affinity, split_alone, split_by_seeds
from ipjax.capture.models.surfaces import cut
from ipjax.files.meshes.mesh import make_mesh

STEP = 0.002


def make_surface(*boxes):
    """The surface of boxes (low and high corner, metres) that stand on z = 0, open below."""
    low, high = np.min([b[0] for b in boxes], 0) - 0.01, np.max([b[1] for b in boxes], 0) + 0.01
    grid = np.stack(np.meshgrid(*(np.arange(a, b, STEP) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
    distance = np.inf
    for first, last in boxes:
        out = np.maximum(np.asarray(first) - grid, grid - np.asarray(last))
        distance = np.minimum(distance, np.linalg.norm(np.maximum(out, 0), axis=-1) + np.minimum(out.max(-1), 0))
    vertices, faces, _, _ = marching_cubes(distance, 0.0)
    points = low + vertices * STEP
    return cut(make_mesh(points, faces), (points[faces][:, :, 2] > 0.003).all(1))


TWO = make_surface(([0, 0, 0], [0.06, 0.06, 0.05]), ([0.059, 0.03, 0], [0.12, 0.1, 0.08]))
TEE = make_surface(([0, 0, 0], [0.04, 0.1, 0.04]), ([0.04, 0.035, 0], [0.12, 0.065, 0.04]))


@pytest.mark.parametrize("mesh", [TWO, TEE])
def test_seeds_get_their_sides(mesh):
    seeds = [
        np.flatnonzero(np.linalg.norm(mesh.vertices - p, axis=-1) < 0.02) for p in ([0, 0.03, 0.02], [0.12, 0.05, 0.03])
    ]
    label = split_by_seeds(make_affinity(mesh), seeds)
    assert agrees(label, mesh.vertices[:, 0], 0.06 if mesh is TWO else 0.04)


def agrees(label, x, border):
    """Whether labels are 0 and 1 on the sides of a border, or 1 and 0; what is on the border may be of either."""
    apart = np.abs(x - border) > 0.004
    same = (label == (x > border))[apart].mean()
    return max(same, 1 - same) > 0.99


def test_two_things_are_cut_and_one_is_not():
    stands = lambda mesh: mesh.vertices[:, 2] < 0.01
    label = split_alone(make_affinity(TWO), stands(TWO))
    assert label.max() == 1
    assert agrees(label, TWO.vertices[:, 0], 0.06)
    assert split_alone(make_affinity(TEE), stands(TEE)).max() == 0


def test_a_handle_that_does_not_stand_stays():
    cup = make_surface(([0, 0, 0], [0.06, 0.06, 0.08]), ([0.059, 0.025, 0.03], [0.1, 0.035, 0.06]))
    assert split_alone(make_affinity(cup), cup.vertices[:, 2] < 0.01).max() == 0


def test_seeds_are_asked_for():
    with pytest.raises(ValueError, match="seed"):
        split_by_seeds(make_affinity(TWO), [np.zeros(0, int)])
