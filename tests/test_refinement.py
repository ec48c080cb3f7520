"""Refinement on an exact depth image: it finds back, never worsens, and its linear algebra is right."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.config import RefineConfig
from ipjax.features import lift
from ipjax.refinement import (
    Cloud,
    _nearest_visible,
    nearest_inside,
    refine,
    retract,
    rotation_from_vector,
    solve_positive,
)
from ipjax.types import Camera

CONFIG = RefineConfig(steps=15, points=256)
run = jax.jit(refine, static_argnames="scale_known")


@pytest.fixture(scope="module")
def scene():
    """The ellipsoid's surface, its exact depth on a 28 × 28 grid, and the true pose."""
    query, truth = problems.make_query(4)
    points, cover = lift(query.view, 28, 28, 0.05)
    camera = query.view.camera
    camera = Camera(camera.focal / 4, (camera.centre + 0.5) / 4 - 0.5)
    valid = (cover > 0.3).reshape(28, 28)
    points = points.reshape(28, 28, 3)
    cloud = Cloud(points, valid, camera, valid, jnp.where(valid, points[..., 2], 0), nearest_inside(valid))
    return problems.make_surface(512), cloud, truth


def hide(cloud: Cloud, hidden) -> Cloud:
    """The same scene with something close to the camera over the cells that are `hidden`."""
    mask = cloud.mask & ~hidden
    depth = jnp.where(hidden, 0.3 * jnp.max(cloud.depth), cloud.depth)
    return Cloud(cloud.points, cloud.valid & ~hidden, cloud.camera, mask, depth, nearest_inside(mask))


@given(seed=st.integers(0, 2**31))
def test_a_disturbed_pose_comes_back(scene, seed):
    """From 6° and 4 % of the diameter; a smooth ellipsoid leaves its rotation the least determined."""
    surface, cloud, truth = scene
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=7)
    step = np.concatenate([0.1 * direction[:3] / np.linalg.norm(direction[:3]), 0.02 * direction[3:6], [0.0]])
    start = retract(truth, jnp.asarray(step, jnp.float32))
    found, cost = run(surface, cloud, start, CONFIG)
    _, before = run(surface, cloud, start, RefineConfig(steps=0, points=256))
    distance = lambda pose: float(jnp.max(jnp.linalg.norm(pose @ surface.points - truth @ surface.points, axis=-1)))
    assert float(cost) <= float(before) + 1e-6
    assert distance(found) < max(0.05 * float(truth.scale), 0.8 * distance(start))


@given(seed=st.integers(0, 2**31))
def test_a_known_scale_stays(scene, seed):
    surface, cloud, truth = scene
    step = jnp.asarray(np.random.default_rng(seed).normal(size=6) * 0.02, jnp.float32)
    found, _ = run(surface, cloud, retract(truth, step), CONFIG, scale_known=True)
    assert float(found.scale) == float(truth.scale)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-5)


def test_without_depth_nothing_moves(scene):
    surface, cloud, truth = scene
    nothing = jnp.zeros_like(cloud.valid)
    blind = Cloud(
        jnp.zeros_like(cloud.points),
        nothing,
        cloud.camera,
        nothing,
        jnp.zeros_like(cloud.depth),
        nearest_inside(nothing),
    )
    found, cost = run(surface, blind, truth, CONFIG)
    assert bool(jnp.isfinite(cost))
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-6)


@given(seed=st.integers(0, 2**31), share=st.floats(0, 0.3))
def test_the_nearest_cell_of_a_mask(seed, share):
    mask = np.random.default_rng(seed).random((9, 13)) < share
    found = np.asarray(jax.jit(nearest_inside)(jnp.asarray(mask)))
    rows, columns = np.mgrid[:9, :13]
    if not mask.any():
        np.testing.assert_array_equal(found, np.stack([columns, rows], axis=-1))
        return
    assert mask[found[..., 1], found[..., 0]].all()
    r, c = np.nonzero(mask)
    least = ((rows[..., None] - r) ** 2 + (columns[..., None] - c) ** 2).min(-1)
    np.testing.assert_array_equal((found[..., 0] - columns) ** 2 + (found[..., 1] - rows) ** 2, least)


def test_a_mask_alone_pulls_sideways(scene):
    """No depth at all: what sticks out of the mask still comes back, across the rays."""
    surface, cloud, truth = scene
    blind = Cloud(
        cloud.points, jnp.zeros_like(cloud.valid), cloud.camera, cloud.mask, jnp.zeros_like(cloud.depth), cloud.outline
    )
    start = retract(truth, jnp.array([0, 0, 0, 0.15, 0.0, 0.0], jnp.float32))
    found, _ = run(surface, blind, start, CONFIG, scale_known=True)
    aside = lambda pose: float(jnp.linalg.norm((pose.translation - truth.translation)[:2])) / float(truth.scale)
    assert aside(start) > 0.14 and aside(found) < 0.07


@pytest.mark.parametrize("side", ["left", "top"])
def test_what_is_hidden_does_not_count(scene, side):
    """With a third of the object behind something nearer, the truth stays where it is and keeps its size."""
    surface, cloud, truth = scene
    inside = np.argwhere(np.asarray(cloud.mask))
    row, column = (inside.min(0) + (inside.max(0) - inside.min(0)) / 3).round().astype(int)
    hidden = jnp.asarray((np.mgrid[:28, :28][1] < column) if side == "left" else (np.mgrid[:28, :28][0] < row))
    found, _ = run(surface, hide(cloud, hidden), truth, CONFIG)
    assert abs(float(found.scale / truth.scale) - 1) < 0.03
    assert float(jnp.linalg.norm(found.translation - truth.translation)) < 0.03 * float(truth.scale)


@given(seed=st.integers(0, 2**31))
def test_small_systems_are_solved(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(20, 7))
    matrix, right = factor.T @ factor, rng.normal(size=7)
    found = jax.jit(solve_positive)(jnp.asarray(matrix, jnp.float32), jnp.asarray(right, jnp.float32))
    np.testing.assert_allclose(matrix @ np.asarray(found, np.float64), right, atol=2e-3 * np.abs(right).max())


def test_a_singular_system_gives_finite_numbers():
    found = solve_positive(jnp.zeros((7, 7)), jnp.zeros(7))
    assert bool(jnp.all(jnp.isfinite(found)))


@given(seed=st.integers(0, 2**31), power=st.integers(-8, 0))
def test_rotations_are_rotations(seed, power):
    vector = jnp.asarray(np.random.default_rng(seed).normal(size=3) * 10.0**power, jnp.float32)
    matrix = np.asarray(rotation_from_vector(vector), np.float64)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=2e-6)
    np.testing.assert_allclose(matrix @ np.asarray(vector), vector, atol=1e-5)
    assert bool(jnp.all(jnp.isfinite(jax.jacfwd(rotation_from_vector)(vector))))


NEAREST = jax.jit(_nearest_visible)


@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.0, 0.3, 1.0]))
def test_the_nearest_visible_point_is_the_first_of_the_nearest(seed, share):
    rng = np.random.default_rng(seed)
    # Small integers: distances are exact, and ties abound.
    targets, placed = (jnp.asarray(rng.integers(-2, 3, (n, 3)), jnp.float32) for n in (30, 21))
    visible = rng.random(21) < share
    squared = np.sum((np.asarray(targets)[:, None] - np.asarray(placed)) ** 2, axis=-1)
    expected = np.where(visible, squared, np.inf).argmin(axis=1)
    np.testing.assert_array_equal(NEAREST(targets, placed, jnp.asarray(visible)), expected)
