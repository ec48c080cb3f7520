"""The kernels of depth images against their slow twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ipjax_kernels.depth.fusing import fuse_depth
from ipjax_kernels.depth.propagation import propagate_offsets
from ipjax_kernels.depth.sweep import sweep
from ipjax_kernels.depth.warping import warp_depth
from ipjax_kernels.reference import depth as reference
from scipy import ndimage

HEIGHT, WIDTH = 20, 26


def test_a_sweep_equals_the_correlation_of_every_window():
    rng = np.random.default_rng(0)
    images = ndimage.gaussian_filter(rng.uniform(size=(3, HEIGHT, WIDTH)), (0, 0.8, 0.8)).astype(np.float32)
    turn = np.stack([np.eye(3), np.array([[1, 0.02, -0.3], [-0.02, 1, 0.4], [0, 1e-3, 1]])]).astype(np.float32)
    shift = np.array([[3.0, 0, 0], [-2, 1, 0.05]], np.float32)
    base = (0.6 + 0.2 * rng.uniform(size=(HEIGHT, WIDTH))).astype(np.float32)
    offsets = np.linspace(-0.4, 0.4, 5).astype(np.float32)
    found = sweep(images[0], images[1:], turn, shift, base, offsets, np.ones(2, bool), radius=2, keep=1)
    found = [np.asarray(x) for x in found]
    for y, x in rng.integers([3, 3], [HEIGHT - 3, WIDTH - 3], (25, 2)).tolist():
        scores = np.array(
            [
                max(
                    reference.correlate(images[0], images[1 + k], turn[k], shift[k], base + o, (x, y), 2)
                    for k in (0, 1)
                )
                for o in offsets
            ]
        )
        best = scores.argmax()
        assert found[1][y, x] == pytest.approx(scores[best], abs=2e-3)
        apart = [scores[k] for k in range(5) if abs(k - best) >= 2]
        assert found[2][y, x] == pytest.approx(max(apart), abs=2e-3)
        if 0 < best < 4 and scores[best - 1] > -1 and scores[best + 1] > -1:
            before, after = scores[best - 1], scores[best + 1]
            part = 0.5 * (after - before) / (2 * scores[best] - before - after)
            assert found[0][y, x] == pytest.approx(base[y, x] + offsets[best] + 0.2 * part, abs=2e-2)
        else:
            assert found[0][y, x] == 0


def test_neighbours_that_are_not_there_do_not_count():
    rng = np.random.default_rng(1)
    images = ndimage.gaussian_filter(rng.uniform(size=(3, HEIGHT, WIDTH)), (0, 0.8, 0.8)).astype(np.float32)
    images[1] = np.roll(images[0], 3, axis=1)
    turn, shift = np.stack([np.eye(3)] * 2).astype(np.float32), np.array([[6.0, 0, 0]] * 2, np.float32)
    offsets = np.linspace(0.1, 0.9, 9).astype(np.float32)
    base = np.zeros((HEIGHT, WIDTH), np.float32)
    found = sweep(images[0], images[1:], turn, shift, base, offsets, np.array([True, False]), radius=2, keep=2)
    inner = np.asarray(found.inverse)[4:-4, 4:-8]
    np.testing.assert_allclose(inner, 0.5, atol=0.03)
    assert np.asarray(found.score)[4:-4, 4:-8].min() > 0.99


def test_warping_equals_ray_casting():
    rng = np.random.default_rng(2)
    rows, columns = np.mgrid[:7, :9]
    depth = 1 + 0.004 * rows + 0.003 * columns + 0.3 * (columns > 4)
    points = np.stack([(columns - 4) / 10 * depth, (rows - 3) / 10 * depth, depth], -1)
    points = (points + np.array([0.02, -0.01, 0.03])).astype(np.float32)
    valid = rng.uniform(size=depth.shape) > 0.1
    focal, centre, size = np.array([14.0, 13.0]), np.array([8.2, 6.4]), np.array([1.5, 1.4])
    told = {"jump": 0.02, "size": size}
    found = warp_depth(
        points, valid, jnp.asarray(focal, jnp.float32), jnp.asarray(centre, jnp.float32), 14, 18, reach=3, jump=0.02,
        size=size.astype(np.float32),
    )  # fmt: skip
    want = reference.warp_depth(points.astype(float), valid, focal, centre, 14, 18, **told)
    differ = ~np.isclose(np.asarray(found), want, atol=1e-4)
    # Centres on an edge to within rounding may fall on either side.
    assert differ.sum() <= 2 and (want > 0).sum() >= 100


def test_propagation_finds_a_shift_and_its_cost_is_the_twins():
    rng = np.random.default_rng(3)
    captured = (1 + 0.03 * ndimage.gaussian_filter(rng.normal(size=(40, 48)), 2) * 8).astype(np.float32)
    normals = rng.normal(size=(40, 48, 3)).astype(np.float32)
    normals = ndimage.gaussian_filter(normals, (2, 2, 0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    estimated, turned = np.roll(captured, (-2, 3), (0, 1)), np.roll(normals, (-2, 3), (0, 1))
    estimated = np.where(rng.uniform(size=estimated.shape) < 0.9, estimated, 0).astype(np.float32)
    offsets, cost = propagate_offsets(
        estimated, turned, captured, normals, jax.random.key(0), reach=6.0, unit=0.02, angle=0.5
    )
    offsets, cost = np.asarray(offsets), np.asarray(cost)
    right = (offsets[6:-6, 6:-6] == [-3, 2]).all(-1)
    assert right.mean() > 0.98
    for y, x in rng.integers(0, [40, 48], (20, 2)).tolist():
        want = reference.patch_cost(estimated, turned, captured, normals, (x, y), offsets[y, x], 0.02, 0.5)
        assert cost[y, x] == pytest.approx(want, abs=1e-4)


def test_fusing_equals_its_twin():
    rng = np.random.default_rng(4)
    surfaces = rng.choice([0.0, 0.7, 0.72, 0.9], (5, HEIGHT, WIDTH), p=[0.3, 0.4, 0.1, 0.2])
    stack = np.where(surfaces > 0, surfaces + rng.normal(0, 0.0015, surfaces.shape), 0).astype(np.float32)
    weight = np.array([1, 0.5, 1, 1, 0.7], np.float32)
    depth, confidence = (np.asarray(x) for x in fuse_depth(stack, weight))
    for y, x in np.ndindex(HEIGHT, WIDTH):
        want = reference.fuse_depth(stack[:, y, x], weight, 0.012, 0.004, 2, 3)
        assert (depth[y, x], confidence[y, x]) == pytest.approx(want, abs=1e-5)
    known = surfaces[0] > 0
    assert (depth[known] > 0).all() and (confidence[depth == 0] == 0).all()
