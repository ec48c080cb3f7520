"""Refinement on an exact depth image: it finds back, never worsens, and its linear algebra is right."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.bias import contour_errors, pose_errors, summary
from ipjax.config import RefineConfig
from ipjax.estimation.contour import trace_contour
from ipjax.estimation.features import observe
from ipjax.estimation.refinement import refine, settle, unevenness
from ipjax.estimation.residuals import Cloud, linearise, nearest_visible, strained
from ipjax.estimation.scene import SceneGrid
from ipjax.inference.frames import frame
from ipjax.records import Pairs
from ipjax.synthetic import problems
from ipjax.transforms import retract

GRID = 56  # as the defaults have it
CONFIG = RefineConfig(steps=15, points=256)
run = jax.jit(refine, static_argnames="scale_known")
run_settle = jax.jit(settle, static_argnames="scale_known")
NO_PAIRS = Pairs(jnp.zeros((512, 3)), jnp.zeros((512, 3)), jnp.zeros(512))


@pytest.fixture(scope="module")
def scene():
    """The ellipsoid's surface, its exact depth on a 56 × 56 grid, and the true pose."""
    query, truth = problems.make_query(4)
    return problems.make_surface(2048), reduced(query), truth


@jax.jit
def reduced(query) -> Cloud:
    """The query on the grid, as the pipeline makes it."""
    return SceneGrid(query, GRID, 96).cloud


def test_the_border_and_the_fit_are_off_to_no_side():
    """Signed errors over exact images, the user's way from the whole image on: within three standard errors of zero."""
    surface, encoder, look = problems.make_surface(2048), problems.make_encoder(), jax.jit(observe)
    border, fit = [], []
    for seed in range(40):
        whole = problems.make_frame(seed)
        view = frame(whole.rgb, whole.depth, whole.mask, whole.matrix, resolution=112)
        cloud, truth = reduced(look(encoder, view)), whole.camera_from_object
        border.append(contour_errors(cloud, truth)[[0, 1, 3]])
        fit.append(pose_errors(run(surface, cloud, truth, CONFIG)[0], truth)[[0, 1, 3]])
    for errors, spread in ((border, 0.15), (fit, 0.2)):
        mean, error = summary(errors)
        assert (np.abs(mean) <= 3 * error).all(), (mean, error)
        assert np.std(errors, axis=0).max() < spread  # of the diameter in %, or three standard errors would say little


@pytest.mark.parametrize("radius", [6, 12, 25])
def test_the_border_of_a_disc_is_a_circle_of_its_radius(radius):
    """What cells and lines between them cut off a bend, 0.07 / radius of a cell, is given back."""
    rng = np.random.default_rng(radius)
    fine = (np.arange(GRID * 16) + 0.5) / 16 - 0.5
    trace = jax.jit(lambda cover: trace_contour(cover, jnp.zeros_like(cover), 0.1, 400))
    gaps = []
    for _ in range(60):
        centre = 27.5 + rng.uniform(-1, 1, 2)
        disc = (fine - centre[0]) ** 2 + (fine[:, None] - centre[1]) ** 2 < radius**2
        contour = trace(jnp.asarray(disc.reshape(GRID, 16, GRID, 16).mean((1, 3)), jnp.float32))
        points = np.asarray(contour.points, np.float64)[np.asarray(contour.valid)] - centre
        gaps.append([np.mean(np.hypot(*points.T) - radius)])
        bend = np.asarray(contour.bend)[np.asarray(contour.valid)]
        assert abs(np.mean(bend) * radius - 1) < 0.1
    mean, error = summary(gaps)
    assert np.abs(mean[0]) <= 3 * error[0]
    assert error[0] < 0.07 / radius / 3  # or the test would not see it


def gather(points, valid, camera, mask, depth) -> Cloud:
    """A cloud with the border of its mask, on any of whose cells something 3 cm nearer is an occluder."""
    depth = jnp.where(jnp.isfinite(depth), depth, 0)
    return Cloud(points, valid, camera, mask, depth, trace_contour(mask, depth, 0.03, 96))


def hide(cloud: Cloud, hidden) -> Cloud:
    """The same scene with something close to the camera over the cells that are `hidden`."""
    mask = cloud.mask & ~hidden
    depth = jnp.where(hidden, 0.3 * jnp.max(cloud.depth), cloud.depth)
    return gather(cloud.points, cloud.valid & ~hidden, cloud.camera, mask, depth)


def surface_gap(pose, truth, surface) -> float:
    """Root mean square distance of the placed surface from the true ellipsoid, in diameters.

    To the ellipsoid, not between points of the same name: a smooth one may slide along itself, which no depth forbids.
    """
    placed = np.asarray(pose @ surface.points, np.float64)
    inside = (placed - np.asarray(truth.translation)) @ np.asarray(truth.rotation) / float(truth.scale)
    radius = np.linalg.norm(inside / problems.AXES, axis=1)
    slope = np.linalg.norm(inside / problems.AXES**2, axis=1) / radius
    return float(np.sqrt(np.mean(((radius - 1) / slope) ** 2)))


def test_disturbed_poses_come_back(scene):
    """From 6° and 4 % of the diameter: all onto the surface, half of them to less than half of where they began."""
    surface, cloud, truth = scene
    began, ended = [], []
    for seed in range(40):
        direction = np.random.default_rng(seed).normal(size=7)
        step = np.concatenate([0.1 * direction[:3] / np.linalg.norm(direction[:3]), 0.02 * direction[3:6], [0.0]])
        start = retract(truth, jnp.asarray(step, jnp.float32))
        found, cost = run(surface, cloud, start, CONFIG)
        _, before = run(surface, cloud, start, RefineConfig(steps=0, points=256))
        assert float(cost) <= float(before) + 1e-6
        began.append(surface_gap(start, truth, surface))
        ended.append(surface_gap(found, truth, surface))
    assert max(ended) < 0.03
    assert np.median(ended) < 0.5 * np.median(began)


@given(seed=st.integers(0, 2**31))
def test_a_known_scale_stays(scene, seed):
    surface, cloud, truth = scene
    step = jnp.asarray(np.random.default_rng(seed).normal(size=6) * 0.02, jnp.float32)
    found, _ = run(surface, cloud, retract(truth, step), CONFIG, scale_known=True)
    assert float(found.scale) == float(truth.scale)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-5)


def test_wrong_proportions_give_way(scene):
    """A body too flat and too long by a tenth: whoever trusts it turns and moves it farther from the truth."""
    surface, cloud, truth = scene
    stretch = jnp.array([1.0, 0.9, 1.1])
    normals = surface.normals / stretch
    wrong = dataclasses.replace(
        surface,
        points=surface.points * stretch,
        normals=normals / jnp.linalg.norm(normals, axis=-1, keepdims=True),
    )
    off = lambda pose: float(jnp.linalg.norm(pose @ surface.points - truth @ surface.points, axis=-1).mean())
    trusted, doubted = [], []
    for seed in range(20):
        direction = np.random.default_rng(seed).normal(size=7)
        step = np.concatenate([0.1 * direction[:3] / np.linalg.norm(direction[:3]), 0.02 * direction[3:6], [0.0]])
        rigid, _ = run(wrong, cloud, retract(truth, jnp.asarray(step, jnp.float32)), CONFIG)
        trusted.append(off(rigid))
        doubted.append(off(run_settle(wrong, cloud, rigid, NO_PAIRS, CONFIG)))
    assert np.median(doubted) < 0.6 * np.median(trusted)


def test_widths_fixed_in_metres_do_not_reward_growth(scene):
    """A mesh that has grown by a tenth and fits badly costs more where its growth does not widen the losses."""
    surface, cloud, truth = scene
    grown = jnp.array([0, 0, 0, 0, 0, 0, 0.1], jnp.float32)
    bumpy = uneven(surface, 0, 0.03)
    units = truth.scale, 0 * truth.scale
    fixed, relative = (
        np.asarray(linearise(truth, grown, bumpy, cloud, None, unit, CONFIG, rigid=7)[0]) for unit in units
    )
    assert np.sum(fixed**2) > 1.02 * np.sum(relative**2)
    there = [linearise(truth, 0 * grown, bumpy, cloud, None, unit, CONFIG, rigid=7)[0] for unit in units]
    np.testing.assert_array_equal(*there)  # at the start both are the same


def test_what_is_right_is_left_alone():
    """On an even surface of the right proportions the last step does what one more refinement would.

    Most of the way: along a valley as flat as the size's against the distance, either may go on by thousandths.
    """
    surface, apart = problems.make_surface(2048), []
    for seed in range(8):
        query, truth = problems.make_query(seed)
        cloud = reduced(query)
        fitted, cost = run(surface, cloud, truth, CONFIG)
        wrong_pairs = Pairs(surface.points[:512], truth @ surface.points[:512] + 0.1 * truth.scale, jnp.ones(512))
        settled = run_settle(surface, cloud, fitted, wrong_pairs, CONFIG)
        again, _ = run(surface, cloud, fitted, CONFIG)
        moved = jnp.linalg.norm(settled @ surface.points - again @ surface.points, axis=-1) / truth.scale
        apart.append(float(moved.max()))
        still = run(surface, cloud, settled, dataclasses.replace(CONFIG, steps=0))[1]
        assert float(still) <= float(cost) + 1e-5
    assert np.median(apart) < 1e-3, apart
    assert max(apart) < 5e-3, apart


def uneven(surface, seed: int, amplitude: float):
    """The surface moved along its normals by a smooth field of that root mean square, normals as they were."""
    random = np.random.default_rng(seed)
    waves, phase = random.normal(size=(32, 3)) / 0.15, random.uniform(0, 2 * np.pi, 32)
    field = np.cos(np.asarray(surface.points) @ waves.T + phase).sum(1)
    field *= amplitude / np.sqrt(np.mean(field**2))
    return dataclasses.replace(
        surface, points=surface.points + jnp.asarray(field, jnp.float32)[:, None] * surface.normals
    )


@pytest.mark.parametrize("amplitude", [0.01, 0.03])
def test_unevenness_is_that_of_the_surface(scene, amplitude):
    surface, cloud, truth = scene
    exact = float(unevenness(surface, cloud, truth, CONFIG))
    assert exact < 0.006  # sampling alone
    told = [float(unevenness(uneven(surface, seed, amplitude), cloud, truth, CONFIG)) for seed in range(8)]
    assert 0.5 * amplitude < np.mean(told) < 1.5 * amplitude


def test_pairs_hold_an_uneven_surface(scene):
    """Bumps of 3 % pull the fit; the pairs, a third of them wrong, pull it back, and the size with it."""
    surface, cloud, truth = scene
    held, free = [], []
    for seed in range(12):
        random = np.random.default_rng(seed)
        bumpy = uneven(surface, seed, 0.03)
        start = retract(truth, jnp.asarray(random.normal(size=7) * 0.03, jnp.float32))
        rigid, _ = run(bumpy, cloud, start, CONFIG)
        chosen = random.choice(2048, 512, replace=False)
        target = np.array(truth @ surface.points[chosen]) + random.normal(size=(512, 3)) * 0.02 * float(truth.scale)
        target[:170] = random.permutation(target[:170])
        pairs = Pairs(bumpy.points[chosen], jnp.asarray(target, jnp.float32), jnp.ones(512))
        off = lambda pose: float(jnp.linalg.norm(pose @ surface.points - truth @ surface.points, axis=-1).mean())
        free.append(off(rigid))
        held.append(off(run_settle(bumpy, cloud, rigid, pairs, CONFIG)))
    assert np.median(held) < 0.7 * np.median(free)


@given(seed=st.integers(0, 2**31))
def test_a_strain_keeps_volume_and_normals(seed):
    """To first order; and the normals stay those of the changed surface."""
    surface = problems.make_surface(500)
    strain = np.random.default_rng(seed).normal(size=5) * 0.01
    a, b, ab, ac, bc = strain
    matrix = np.eye(3) + np.array([[a, ab, ac], [ab, b, bc], [ac, bc, -a - b]])
    changed = strained(surface, jnp.asarray(strain, jnp.float32))
    assert abs(np.linalg.det(matrix) - 1) < 3 * np.sum(strain**2)
    expected = jnp.matmul(surface.points, matrix.T, precision="highest")
    np.testing.assert_allclose(changed.points, expected, atol=1e-6)
    exact = np.asarray(surface.normals) @ np.linalg.inv(matrix)
    exact /= np.linalg.norm(exact, axis=-1, keepdims=True)
    np.testing.assert_allclose(changed.normals, exact, atol=10 * np.sum(strain**2) + 1e-6)


def test_without_depth_nothing_moves(scene):
    surface, cloud, truth = scene
    nothing = jnp.zeros_like(cloud.valid)
    blind = gather(jnp.zeros_like(cloud.points), nothing, cloud.camera, nothing, jnp.zeros_like(cloud.depth))
    found, cost = run(surface, blind, truth, CONFIG)
    assert bool(jnp.isfinite(cost))
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-6)


def disc(radius, height=21, width=25):
    row, column = np.mgrid[:height, :width]
    return (row - 10) ** 2 + (column - 11) ** 2 <= radius**2


trace = jax.jit(trace_contour, static_argnames="count")


@pytest.mark.parametrize("count", [16, 200])
def test_the_border_of_a_mask(count):
    """Half a cell outside the disc's own cells, its normals outward; no more points than neighbours that differ."""
    mask = disc(7)
    found = trace(jnp.asarray(mask), jnp.ones(mask.shape, jnp.float32), 0.1, count=count)
    points, outward, valid = (np.asarray(x) for x in (found.points, found.outward, found.valid))
    beside = (mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum()
    assert valid.sum() == min(count, beside)
    away = points[valid] - [11, 10]
    distance = np.linalg.norm(away, axis=-1)
    assert (np.abs(distance - 7.2) < 0.8).all()
    assert (np.sum(away / distance[:, None] * outward[valid], axis=-1) > 0.95).all()
    directions = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    gaps = np.diff(np.append(directions, directions[0] + 2 * np.pi))
    assert gaps.max() < (1.5 if count == 16 else 0.5)  # spread around it, not bunched


def test_a_border_that_something_cuts_is_no_silhouette():
    """What is nearer, and the image's own border, cut the object; what is farther or unknown does not."""
    mask, column = disc(7), np.mgrid[:21, :25][1]
    mask &= column <= 14
    depth = np.where(column > 14, 0.5, 1.0).astype(np.float32)  # an occluder on the right
    depth[~mask & (column < 8)] = 0  # unknown on the left
    depth[~mask & (column >= 8) & (column <= 14)] = 2
    found = trace(jnp.asarray(mask), jnp.asarray(depth), 0.1, count=200)
    kept = np.asarray(found.points)[np.asarray(found.valid)]
    assert kept[:, 0].min() < 5 and kept[:, 0].max() < 14
    whole = trace(jnp.asarray(mask), jnp.ones_like(jnp.asarray(depth)), 0.1, count=200)
    assert np.asarray(whole.points)[np.asarray(whole.valid), 0].max() == pytest.approx(14.5, abs=0.05)
    beyond = trace(jnp.asarray(mask[:, 8:]), jnp.ones((21, 17), jnp.float32), 0.1, count=200)  # cut by the image
    assert np.asarray(beyond.points)[np.asarray(beyond.valid), 0].min() == pytest.approx(0, abs=1e-3)


def test_a_mask_alone_pulls_sideways(scene):
    """No depth at all: the silhouette alone still brings the object back, across the rays."""
    surface, cloud, truth = scene
    nothing = jnp.zeros_like(cloud.depth)
    blind = gather(cloud.points, jnp.zeros_like(cloud.valid), cloud.camera, cloud.mask, nothing)
    aside = lambda pose: float(jnp.linalg.norm((pose.translation - truth.translation)[:2])) / float(truth.scale)
    start = retract(truth, jnp.array([0, 0, 0, 0.08, 0.0, 0.0], jnp.float32))
    found, _ = run(surface, blind, start, CONFIG, scale_known=True)
    assert aside(start) > 0.075 and aside(found) < 0.025


def test_a_mask_alone_knows_the_size(scene):
    """No depth at all: the wrong size in the image costs, either way."""
    surface, cloud, truth = scene
    nothing = jnp.zeros_like(cloud.depth)
    blind = gather(cloud.points, jnp.zeros_like(cloud.valid), cloud.camera, cloud.mask, nothing)
    sized = lambda step: retract(truth, jnp.array([0, 0, 0, 0, 0, 0, step], jnp.float32))
    cost = [float(run(surface, blind, sized(step), RefineConfig(steps=0))[1]) for step in (-0.06, 0.0, 0.06)]
    assert cost[1] < 0.5 * cost[0] and cost[1] < 0.5 * cost[2]


@pytest.mark.parametrize("side", ["left", "top"])
def test_what_is_hidden_does_not_count(scene, side):
    """With a third of the object behind something nearer, the truth stays where it is and keeps its size."""
    surface, cloud, truth = scene
    inside = np.argwhere(np.asarray(cloud.mask))
    row, column = (inside.min(0) + (inside.max(0) - inside.min(0)) / 3).round().astype(int)
    hidden = jnp.asarray((np.mgrid[:GRID, :GRID][1] < column) if side == "left" else (np.mgrid[:GRID, :GRID][0] < row))
    found, _ = run(surface, hide(cloud, hidden), truth, CONFIG)
    assert abs(float(found.scale / truth.scale) - 1) < 0.03
    assert float(jnp.linalg.norm(found.translation - truth.translation)) < 0.03 * float(truth.scale)


NEAREST = jax.jit(nearest_visible)


@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.0, 0.3, 1.0]))
def test_the_nearest_visible_point_is_the_first_of_the_nearest(seed, share):
    rng = np.random.default_rng(seed)
    # Small integers: distances are exact, and ties abound.
    targets, placed = (jnp.asarray(rng.integers(-2, 3, (n, 3)), jnp.float32) for n in (30, 21))
    visible = rng.random(21) < share
    squared = np.sum((np.asarray(targets)[:, None] - np.asarray(placed)) ** 2, axis=-1)
    expected = np.where(visible, squared, np.inf).argmin(axis=1)
    np.testing.assert_array_equal(NEAREST(targets, placed, jnp.asarray(visible)), expected)
