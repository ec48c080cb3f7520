"""Surface on the other side: the kernels are their slow twins, and a sphere's is a diameter away."""

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.antipodal import find_opposite, smooth_normals
from ipjax_kernels.reference import antipodal as reference


def make_cloud(seed, count=400):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    normals = rng.normal(size=(count, 3)) + points
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def to_float32(*arrays):
    return [jnp.asarray(x, jnp.float32) for x in arrays]


def test_opposite_is_its_slow_twin():
    points, normals = make_cloud(0)
    start, axis = points[:30], -normals[:30]
    numbers = (0.1, 2.0), 0.3, 0.5
    expected = reference.find_opposite(points, normals, start, axis, *numbers)
    reach = tuple(to_float32(*numbers[0]))
    found = find_opposite(*to_float32(points, normals, start, axis), reach, *to_float32(*numbers[1:]))
    assert np.isfinite(expected[0]).sum() > 5 and (expected[1] > expected[0]).any()
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(mine), theirs, atol=1e-5)


def test_smooth_normals_are_their_slow_twin():
    points, normals = make_cloud(1)
    expected = reference.smooth_normals(points, normals, points[:30], normals[:30], 0.6, 0.5)
    found = smooth_normals(*to_float32(points, normals, points[:30], normals[:30], 0.6, 0.5))
    assert np.abs(expected - normals[:30]).max() > 0.1
    np.testing.assert_allclose(np.asarray(found), expected, atol=1e-5)


def test_the_other_side_of_a_sphere_is_a_diameter_away():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    cloud = to_float32(points, points, points[:50], -points[:50])
    nearest, farthest = find_opposite(*cloud, tuple(to_float32(0.01, 3.0)), *to_float32(0.1, 0.9))
    np.testing.assert_allclose(np.asarray(farthest), 2, atol=6e-3)  # a point 0.1 beside the ray is 0.005 nearer
    assert (np.asarray(nearest) > 1.98).all()
