"""Poses from rays: minimal sets are exact, both mirrors are found, and the robust fit is scipy's, without bias."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ipjax_kernels.perspective import refine_resection, weak_perspective
from ipjax_kernels.reference import resection_loss
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

COUNT = 128
fit_weak = jax.jit(weak_perspective)


def turn_angle(first, second):
    """Degrees between two rotations."""
    return np.degrees(Rotation.from_matrix(np.asarray(first, np.float64).T @ second).magnitude())


def minimal_sets(seed, count=200):
    """Points and rays of random weak-perspective cameras, and their rotations; the set last."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(count, random_state=seed).as_matrix()
    scale, offset = rng.uniform(0.3, 3, count), rng.normal(0, 0.2, (count, 2))
    points = rng.normal(0, 0.1, (count, 3, 3)) + rng.normal(0, 0.3, (count, 1, 3))
    moved = np.einsum("nij,nkj->nki", rotation, points)
    rays = scale[:, None, None] * moved[..., :2] + offset[:, None]
    last = lambda x: jnp.asarray(np.moveaxis(x, 0, -1), jnp.float32)
    return last(points), last(rays), rotation, scale


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_one_of_the_two_poses_is_the_camera_and_both_see_the_same(seed):
    points, rays, rotation, scale = minimal_sets(seed)
    found = fit_weak(points, rays)
    seen = jnp.einsum("ijmn,kjn->kimn", found.rotation[:2], points, precision="highest") * found.scale + found.offset
    span = np.ptp(np.asarray(rays), axis=0).max(axis=0)
    ok = np.asarray(found.success[0])
    assert ok.mean() > 0.8
    gap = np.abs(np.asarray(seen) - np.asarray(rays)[:, :, None]).max(axis=(0, 1)) / span
    assert np.median(gap) < 1e-5
    assert gap[:, ok].max() < 2e-2
    turned = np.moveaxis(np.asarray(found.rotation, np.float64), (2, 3), (0, 1))
    np.testing.assert_allclose(
        turned @ np.swapaxes(turned, -1, -2), np.broadcast_to(np.eye(3), turned.shape), atol=1e-4
    )
    assert (np.linalg.det(turned) > 0.99).all()
    nearest = np.min([[turn_angle(turned[m, i], rotation[i]) for i in np.nonzero(ok)[0]] for m in (0, 1)], axis=0)
    assert np.median(nearest) < 0.05
    assert np.mean(nearest < 1) > 0.95  # the rest are seen edge-on, where rounding turns them
    assert np.median(np.abs(np.asarray(found.scale[0])[ok] / scale[ok] - 1)) < 1e-4


@pytest.mark.parametrize("fault", ["line", "point", "edge-on", "nan"])
def test_sets_that_determine_nothing_have_no_success(fault):
    points, rays, *_ = (np.array(x) for x in minimal_sets(0, 8))
    if fault == "line":
        points[2] = points[0] + 2 * (points[1] - points[0])
    elif fault == "point":
        points[1] = points[0]
    elif fault == "edge-on":
        rays[2] = rays[0] + 2 * (rays[1] - rays[0])
    else:
        rays[0, 0] = np.nan
    found = fit_weak(jnp.asarray(points), jnp.asarray(rays))
    assert not np.asarray(found.success).any()
    if fault != "nan":
        assert all(np.isfinite(np.asarray(x, np.float64)).all() for x in found)


def scene(seed, noise=0.0, outliers=0.0):
    """A camera at four diameters, points on a ball, their rays, and a start some degrees off."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    points = rng.normal(size=(COUNT, 3))
    points = 0.1 * points / np.linalg.norm(points, axis=1, keepdims=True) + [0.3, -0.2, 1.0]
    translation = np.array([0.02, -0.03, 0.8]) - rotation @ points.mean(0)
    placed = points @ rotation.T + translation
    rays = placed[:, :2] / placed[:, 2:] + rng.normal(0, noise, (COUNT, 2))
    wrong = rng.random(COUNT) < outliers
    rays[wrong] += rng.normal(0, 0.15, (wrong.sum(), 2))
    start = Rotation.from_rotvec(np.deg2rad(12) * rng.normal(size=3) / 3**0.5).as_matrix() @ rotation
    shift = np.array([0.02, -0.03, 0.8]) * rng.uniform(0.85, 1.15) - start @ points.mean(0)
    return rotation, translation, points, rays, start, shift


def run(points, rays, start, shift, weight=None, steps=20):
    weight = np.ones(COUNT) if weight is None else weight
    arrays = (jnp.asarray(x, jnp.float32) for x in (start, shift, points, rays, weight))
    return refine_resection(*arrays, 0.02, steps=steps)


def test_a_third_of_wrong_pairs_moves_no_camera():
    errors = []
    for seed in range(20):
        rotation, translation, points, rays, start, shift = scene(seed, outliers=0.33)
        found = run(points, rays, start, shift)
        errors.append((turn_angle(found.rotation, rotation), np.linalg.norm(found.translation - translation)))
    assert np.median(errors, axis=0)[0] < 0.05
    assert np.mean(np.array(errors)[:, 0] < 0.5) >= 0.9


def test_the_fit_is_the_minimum_that_scipy_finds():
    for seed in range(5):
        _, _, points, rays, start, shift = scene(seed, noise=2e-3, outliers=0.2)
        found = run(points, rays, start, shift, steps=40)
        loss = lambda step, points=points, rays=rays, start=start, shift=shift: resection_loss(
            Rotation.from_rotvec(step[:3]).as_matrix() @ start, shift + step[3:], points, rays, np.ones(COUNT), 0.02
        )
        best = least_squares(loss, np.zeros(6), x_scale=[1, 1, 1, 0.1, 0.1, 0.1], xtol=1e-12, ftol=1e-12)
        assert float(found.loss) <= 2 * best.cost + 1e-5


def test_noise_leaves_no_bias():
    """Mean signed errors over many noisy scenes, within three standard errors of zero."""
    errors = []
    for seed in range(200):
        rotation, translation, points, rays, start, shift = scene(seed, noise=3e-3)
        found = run(points, rays, start, shift)
        turned = Rotation.from_matrix(np.asarray(found.rotation, np.float64) @ rotation.T).as_rotvec()
        middle = points.mean(0)
        moved = np.asarray(found.rotation) @ middle + found.translation - (rotation @ middle + translation)
        errors.append([*np.degrees(turned), *(100 * moved)])
    mean, error = np.mean(errors, axis=0), np.std(errors, axis=0) / len(errors) ** 0.5
    assert (np.abs(mean) < 3 * error).all(), (mean, error)
    assert np.std(errors, axis=0)[:3].max() < 1  # degrees


def test_without_pairs_the_start_stays():
    _, _, points, rays, start, shift = scene(0)
    found = run(points, rays, start, shift, weight=np.zeros(COUNT))
    np.testing.assert_allclose(found.rotation, start, atol=1e-6)
    np.testing.assert_allclose(found.translation, shift, atol=1e-5)
    assert np.isfinite(found.information).all()
