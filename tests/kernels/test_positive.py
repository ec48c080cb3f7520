"""Small positive systems against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ipjax_kernels.positive import invert_positive, principal_axis, solve_positive


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


@given(seed=st.integers(0, 2**31))
def test_small_inverses_and_axes(seed):
    factor = np.random.default_rng(seed).normal(size=(20, 7))
    matrix = factor.T @ factor
    found = jax.jit(invert_positive)(jnp.asarray(matrix, jnp.float32))
    np.testing.assert_allclose(found, np.linalg.inv(matrix), atol=2e-3 * np.linalg.norm(np.linalg.inv(matrix)))
    values, vectors = np.linalg.eigh(matrix[:3, :3])
    axis, value = principal_axis(jnp.asarray(matrix[:3, :3], jnp.float32))
    assert float(value) == pytest.approx(values[-1], rel=1e-3)
    if values[-2] < 0.8 * values[-1]:
        assert abs(float(np.asarray(axis) @ vectors[:, -1])) > 0.999
    assert np.isfinite(np.asarray(principal_axis(jnp.zeros((3, 3)))[0])).all()
