"""Distances of points from what depth images show: the kernel is its slow twin, and a plane's distance is exact."""

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.distances import Sums, add_frame
from ipjax_kernels.reference import distances as reference

REACH = 0.05
FOCAL, CENTRE = np.array([20.0, 22.0]), np.array([7.3, 5.1])
NOTHING = np.zeros(192), np.zeros(192), np.zeros((192, 3)), np.zeros(192)


def make_problem(seed):
    rng = np.random.default_rng(seed)
    depth = 0.5 + 0.02 * rng.uniform(size=(12, 16))
    weight = (rng.uniform(size=(12, 16)) > 0.2) * rng.uniform(0.5, 1, (12, 16))
    lean, rgb = rng.uniform(0.3, 1, (12, 16)), rng.uniform(0, 255, (12, 16, 3))
    points = rng.uniform([-0.25, -0.2, 0.4], [0.25, 0.2, 0.6], (192, 3))
    points[:5, 2] = -0.3  # behind the camera
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    world = (points - 0.01) @ turn  # camera = turn @ world + 0.01
    return world, depth, weight, lean, rgb, FOCAL, CENTRE, turn, np.full(3, 0.01), REACH


def run(sums, problem):
    arrays = [jnp.asarray(x, jnp.float32) for x in problem]
    return add_frame(Sums(*(jnp.asarray(x, jnp.float32) for x in sums)), *arrays)


def test_kernel_is_its_slow_twin():
    # Points at the border of two pixels are nobody's fault: none of these is.
    first, second = make_problem(0), make_problem(1)
    found = run(run(NOTHING, first), second)
    expected = reference.add_frame(reference.add_frame(NOTHING, *first), *second)
    assert (expected[1] > 0).mean() > 0.3
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(mine), theirs, rtol=2e-4, atol=2e-4)


def test_weight_zero_is_absent():
    world, depth, weight, *rest = make_problem(2)
    hidden = np.where(weight > 0, depth, 9.0)
    for mine, theirs in zip(
        run(NOTHING, (world, depth, weight, *rest)), run(NOTHING, (world, hidden, weight, *rest)), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(mine), np.asarray(theirs))


def test_a_plane_is_at_its_distance():
    # n · x = 0.5 seen by every pixel; 1 / z is linear over the image, so z itself is exact at pixels' centres only.
    normal = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    rows, columns = np.mgrid[:12, :16]
    rays = np.stack([(columns - CENTRE[0]) / FOCAL[0], (rows - CENTRE[1]) / FOCAL[1], np.ones((12, 16))], -1)
    depth, lean = 0.5 / (rays @ normal), rays @ normal
    points = (rays * (depth + 0.01)[..., None]).reshape(-1, 3)
    ones = np.ones((12, 16))
    found = run(
        NOTHING, (points, depth, ones, lean, np.zeros((12, 16, 3)), FOCAL, CENTRE, np.eye(3), np.zeros(3), REACH)
    )
    np.testing.assert_allclose(np.asarray(found.distance), 0.5 - points @ normal, atol=1e-5)
