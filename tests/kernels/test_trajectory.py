"""Equations of pairs of frames against their slow twin, and what must hold of planes through depths."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders.ray_cast import K, cast, go_around
from ipjax_kernels.reference import trajectory as reference
from ipjax_kernels.trajectory import Gates, Images, Samples, compare_pairs, fit_planes

FOCAL, CENTRE = np.diag(K)[:2], K[:2, 2]
SMALL_FOCAL, SMALL_CENTRE = FOCAL / 4, (CENTRE + 0.5) / 4 - 0.5
f = lambda x: jnp.asarray(x, jnp.float32)


@pytest.fixture(scope="module")
def small():
    """Inverse depths of two frames, 30 × 40, with holes."""
    poses = go_around(2, arc=0.5)
    depth = cast(poses, noise=0.001)
    depth[np.random.default_rng(0).uniform(size=depth.shape) < 0.2] = 0
    return poses, np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)


@pytest.mark.parametrize("shrink", [1, 4])
def test_planes_are_those_of_the_twin(small, shrink):
    inverse = small[1][0] if shrink > 1 else small[1][0][40:70, 50:90]
    given = f(SMALL_FOCAL), f(SMALL_CENTRE)
    planes, normals = fit_planes(f(inverse), *given, 0.03, shrink=shrink)
    want_planes, want_normals = reference.fit_planes(inverse, SMALL_FOCAL, SMALL_CENTRE, 0.03, shrink)
    same = (np.asarray(planes) > 0) == (want_planes > 0)
    assert same.mean() > 0.995  # a threshold may fall between float32 and double
    assert 0.3 < (want_planes > 0).mean() <= 1
    np.testing.assert_allclose(np.asarray(planes)[same], want_planes[same], atol=2e-5)
    np.testing.assert_allclose(np.asarray(normals)[same], want_normals[same], atol=2e-3)


def test_a_plane_is_found_exactly_with_gaps():
    normal = np.array([0.3, -0.5, -0.81])
    normal /= np.linalg.norm(normal)
    rows, columns = np.mgrid[:24, :32]
    rays = np.stack([(columns - 15) / 40, (rows - 12) / 41, np.ones(rows.shape)], -1)
    inverse = rays @ normal / -0.6
    gaps = np.random.default_rng(1).uniform(size=inverse.shape) < 0.6
    small = f([40 / 2, 41 / 2]), f([(15 + 0.5) / 2 - 0.5, (12 + 0.5) / 2 - 0.5])
    planes, normals = fit_planes(f(np.where(gaps, 0, inverse)), *small, 0.5, shrink=2)
    known = np.asarray(planes) > 0
    assert known.mean() > 0.5
    np.testing.assert_allclose(np.asarray(normals)[known], np.broadcast_to(normal, (known.sum(), 3)), atol=1e-4)


@pytest.mark.parametrize("colours", [False, True])
def test_equations_are_those_of_the_twin(small, colours):
    poses, inverse = small
    rng = np.random.default_rng(2)
    values = []
    for one in inverse:
        planes, normals = fit_planes(f(one), f(SMALL_FOCAL), f(SMALL_CENTRE), 0.05, shrink=4)
        light = rng.normal(size=(*planes.shape, 1)).cumsum(0) * 0.1
        values.append(np.concatenate([np.asarray(planes)[..., None], np.asarray(normals), light], -1))
    values = np.stack(values)
    rows, columns = np.mgrid[1:30:3, 1:40:3]
    chosen = values[:, rows.ravel(), columns.ravel()]
    there = chosen[..., 0] > 0
    rays = np.stack([(columns.ravel() - SMALL_CENTRE[0]) / SMALL_FOCAL[0],
                     (rows.ravel() - SMALL_CENTRE[1]) / SMALL_FOCAL[1], np.ones(rows.size)], -1)  # fmt: skip
    places = rays / np.where(there, chosen[..., 0], 1)[..., None]
    gates = Gates(*(f(x) for x in (0.0015, 1.2, 6.0, 0.15, 0.7, 0.17, 0.3 if colours else np.inf)))
    samples = Samples(f(places), f(chosen[..., 1:4]), f(chosen[..., 4]), jnp.asarray(there))
    images = Images(f(values), f(SMALL_FOCAL), f(SMALL_CENTRE))
    pairs = [(0, 1), (1, 0)]
    relative = [(pick(poses, target).inverse() @ pick(poses, source)) for source, target in pairs]
    rotation, translation = np.stack([r.rotation for r in relative]), np.stack([r.translation for r in relative])
    source, target = (jnp.asarray([pair[side] for pair in pairs], jnp.int32) for side in (0, 1))
    found = compare_pairs(samples, images, source, target, f(rotation), f(translation), gates, colours=colours)
    single = Gates(*(float(x) for x in gates))
    for index, (one, other) in enumerate(pairs):
        want = reference.compare_pair(
            places[one], chosen[one, :, 1:4], chosen[one, :, 4], there[one], values[other], SMALL_FOCAL, SMALL_CENTRE,
            rotation[index], translation[index], single, colours,
        )  # fmt: skip
        assert want["compared"] > 40 and want["near"] > 20
        for name, value in want.items():
            got = np.asarray(getattr(found, name))[index]
            np.testing.assert_allclose(got, value, rtol=2e-3, atol=2e-3 * np.abs(value).max())


def pick(poses, index):
    return type(poses)(poses.rotation[index], poses.translation[index], poses.scale[index])
