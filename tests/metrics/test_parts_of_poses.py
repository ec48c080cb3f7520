"""The parts of a pose's error."""

import jax.numpy as jnp
import numpy as np
import pytest

from ipjax import metrics


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-3, 1.0, 3.0, np.pi - 1e-4, np.pi])
def test_rotation_error_is_accurate_at_both_ends(angle):
    rotation, _ = metrics.discretise_symmetries([], [(np.array([1.0, 2.0, 3.0]), np.zeros(3))], np.pi)
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = rotation[0] + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    error = metrics.rotation_error(jnp.eye(3), jnp.asarray(turn, jnp.float32))
    np.testing.assert_allclose(error, angle, atol=1e-6)
