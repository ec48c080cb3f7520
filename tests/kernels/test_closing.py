"""Hands that close on points: the kernel is its slow twin, and knows the width of what it holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ipjax_kernels.closing import Hand, close_hands
from ipjax_kernels.reference import closing as reference

HAND = Hand(
    *(np.float32(x) for x in (0.08, 0.015, 0.021, 0.058, 0.094, 0.112)),
    np.array([[-0.1, -0.03, -0.02], [-0.02, -0.02, -0.06]], np.float32),
    np.array([[0.1, 0.03, 0.066], [0.02, 0.02, -0.02]], np.float32),
)
close = jax.jit(close_hands, static_argnames=("centred", "batch"))
NUMBERS = 0.1, 0.01, 0.3  # retreat, depth, facing


def make_problem(seed, hands=24, count=300):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.05, -0.03, 0.05], [0.05, 0.03, 0.13], (count, 3))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    turns = np.linalg.qr(np.eye(3) + 0.3 * rng.normal(size=(hands, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    linear = turns * rng.uniform(0.9, 1.1, (hands, 1, 1))
    offset = 0.01 * rng.normal(size=(hands, 3))
    offset[-1] = 9.0  # a hand that meets nothing
    return points, normals, rng.uniform(size=count), linear, offset


@pytest.mark.parametrize("centred", [False, True])
def test_kernel_is_its_slow_twin(centred):
    problem = make_problem(3)
    arrays = [jnp.asarray(x, jnp.float32) for x in problem]
    hand = Hand(*(jnp.asarray(x) for x in HAND))
    numbers = [jnp.asarray(x, jnp.float32) for x in NUMBERS]
    found = close(*arrays, hand, *numbers, centred=centred, batch=5)
    expected = reference.close_hands(*(np.asarray(x, np.float64) for x in arrays), HAND, *NUMBERS, centred=centred)
    assert (expected["facing"] > 0).mean() > 0.2 and (expected["hits"] > 0).any()
    for name, values in expected.items():
        np.testing.assert_allclose(np.asarray(getattr(found, name)), values, atol=2e-6, err_msg=name)


def test_a_slab_is_as_wide_as_it_is():
    side = np.stack(np.meshgrid(np.linspace(-0.01, 0.01, 9), np.linspace(0.095, 0.111, 9)), -1).reshape(-1, 2)
    points = np.concatenate([np.insert(side, 0, u, axis=1) for u in (-0.012, 0.018)])
    normals = np.repeat([[-1.0, 0, 0], [1.0, 0, 0]], len(side), axis=0)
    seen = np.repeat([0.0, 1.0], len(side))
    arrays = [jnp.asarray(x, jnp.float32) for x in (points, normals, seen, np.eye(3)[None], np.zeros((1, 3)))]
    hand = Hand(*(jnp.asarray(x) for x in HAND))
    found = close(*arrays, hand, *(jnp.asarray(x, jnp.float32) for x in NUMBERS), centred=True)
    np.testing.assert_allclose(found.high - found.low, 0.03, atol=1e-7)
    np.testing.assert_allclose(found.centre, 0.003, atol=1e-7)
    np.testing.assert_allclose(found.cosine, 1, atol=1e-6)
    np.testing.assert_allclose(found.seen, [[0, 1]], atol=1e-6)
    np.testing.assert_allclose(found.contact[0, :, 2], 0.103, atol=1e-6)
    assert found.hits[0] == 0 and (found.facing == len(side)).all()
