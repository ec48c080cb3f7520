"""Degraded meshes: the same everywhere, as bad as their level says, and with a way back."""

import dataclasses

import numpy as np
import pytest
import trimesh

from ipjax.files.meshes.mesh import make_mesh, normalise
from ipjax.synthetic.degradation import MISSING, degrade


def bottle():
    """A coloured, lopsided body of about 2,600 vertices, thinnest along y."""
    shape = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = shape.vertices.T
    vertices = np.stack([60 * x * (1.2 - 0.4 * z), 35 * y * (1 - 0.3 * z), 100 * z], -1) + np.array([500, 20, -3])
    colours = np.stack([127 + 120 * np.sin(5 * x), 127 + 120 * np.sin(4 * z + y), 90 + 60 * y], -1).astype(np.uint8)
    return make_mesh(vertices, shape.faces, colours=colours)


@pytest.fixture(scope="module")
def original():
    return bottle()


@pytest.fixture(scope="module")
def levels(original):
    return {level: degrade(original, level, seed=7) for level in (1, 2, 3, 4)}


def test_same_seed_same_mesh(original, levels):
    for level in (2, 4):
        again, back = degrade(original, level, seed=7)
        np.testing.assert_array_equal(again.vertices, levels[level][0].vertices)
        np.testing.assert_array_equal(again.faces, levels[level][0].faces)
        assert back.scale == levels[level][1].scale
        other, elsewhere = degrade(original, level, seed=8)
        assert elsewhere.scale != back.scale
        assert other.vertices.shape != again.vertices.shape or (other.vertices != again.vertices).any()


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_rounding_of_the_input_does_not_change_the_topology(original, levels, level):
    """What another machine's arithmetic might do: every vertex off by a few units in the last place."""
    noise = np.random.default_rng(0).uniform(-1, 1, original.vertices.shape)
    other = dataclasses.replace(original, vertices=original.vertices * (1 + 4e-16 * noise))
    mesh, _ = degrade(other, level, seed=7)
    np.testing.assert_array_equal(mesh.faces, levels[level][0].faces)
    extent = np.ptp(mesh.vertices, axis=0).max()
    assert np.abs(mesh.vertices - levels[level][0].vertices).max() < 1e-6 * extent


def test_levels_are_as_bad_as_they_say(original, levels):
    unit = normalise(original)
    surface = trimesh.Trimesh(unit.vertices, unit.faces, process=False)
    error = {}
    for level, (mesh, back) in levels.items():
        assert np.isfinite(mesh.vertices).all()
        restored = unit.from_file(back @ mesh.vertices)
        _, distance, _ = trimesh.proximity.closest_point(surface, restored[:: max(1, len(restored) // 300)])
        error[level] = np.sqrt((distance**2).mean())
    # Bumps of 1 % and 3 % (rms, along the normal) on top of little smoothing.
    assert 0.006 < error[1] < 0.014 < 0.02 < error[2] < 0.04
    assert error[2] < error[4] and 0.01 < error[3] < error[4]
    assert np.array_equal(levels[1][0].faces, original.faces)
    assert len(levels[3][0].vertices) < 0.6 * len(original.vertices)


def test_the_back_is_the_mirrored_front(original, levels):
    mesh, back = levels[3]
    unit = normalise(original)
    restored = unit.from_file(back @ mesh.vertices) / np.array([1.0, 0.9, 1.1])
    guessed = mesh.seen < 0.5
    assert 0.3 < guessed.mean() < 0.7
    front = np.sign(np.median(restored[~guessed, 1]))
    assert (front * restored[guessed, 1] < 0.03).all() and (front * restored[~guessed, 1] > -0.03).all()
    mirrored = restored[~guessed] * [1, -1, 1]
    gap = np.linalg.norm(mirrored[:, None] - restored[guessed][None], axis=-1).min(1)
    assert np.median(gap) < 1 / 24


def test_level_four_loses_faces_and_colour(levels):
    whole, torn = levels[3][0], levels[4][0]
    # The grid's offset differs between levels, so the counts agree only roughly.
    assert abs(len(torn.faces) / len(whole.faces) - (1 - MISSING)) < 0.05
    edges = lambda m: np.unique(np.sort(m.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)[1]
    assert (edges(torn) == 1).sum() > (edges(whole) == 1).sum() + 10
    assert len(np.unique(torn.colours[torn.seen == 0], axis=0)) == 1
    assert len(np.unique(whole.colours[whole.seen == 0], axis=0)) > 20


def test_texture_is_blurred(original):
    grid = np.indices((64, 64)).sum(0) % 2
    image = np.repeat((grid * 255).astype(np.uint8)[..., None], 3, axis=-1).repeat(16, 0).repeat(16, 1)
    uv = np.random.default_rng(0).random((len(original.vertices), 2))
    mesh = make_mesh(original.vertices, original.faces, uv=uv, texture=image)
    contrast = [degrade(mesh, level)[0].texture.astype(float).std() for level in (1, 2)]
    assert image.astype(float).std() > contrast[0] + 5 > contrast[1] + 30
    assert degrade(mesh, 3)[0].texture is None


def test_other_levels_are_refused(original):
    for level in (0, 5):
        with pytest.raises(ValueError, match="level"):
            degrade(original, level)
