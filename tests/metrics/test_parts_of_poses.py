"""The parts of a pose's error."""

import jax.numpy as jnp
import numpy as np
import pytest

from ipjax import metrics
from ipjax.transforms import Similarity


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-3, 1.0, 3.0, np.pi - 1e-4, np.pi])
def test_rotation_error_is_accurate_at_both_ends(angle):
    rotation, _ = metrics.discretise_symmetries([], [(np.array([1.0, 2.0, 3.0]), np.zeros(3))], np.pi)
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = rotation[0] + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    error = metrics.rotation_error(jnp.eye(3), jnp.asarray(turn, jnp.float32))
    np.testing.assert_allclose(error, angle, atol=1e-6)


def a_pose(degrees: float, translation=(0.0, 0.0, 0.0)) -> Similarity:
    """Turned about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return Similarity(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array(translation), 1.0)


def test_of_symmetric_poses_the_nearest_rotation_counts():
    # Quarter turns about an axis through (20, 0, 0) mm: the origin moves with them.
    quarters = [np.eye(4)]
    for turn in (90, 180, 270):
        pose, centre = a_pose(turn), np.array([0.02, 0, 0])
        quarters.append(pose.to_matrix())
        quarters[-1][:3, 3] = centre - pose.rotation @ centre
    symmetries = Similarity.from_matrix(np.stack(quarters))
    truth = a_pose(30, (0.1, 0.2, 0.7))
    moved = truth @ Similarity.from_matrix(quarters[2])
    estimate = Similarity(a_pose(30 + 180 + 4).rotation, moved.translation + np.array([0, 0, 0.03]), 1.0)
    turn, shift = metrics.symmetric_errors(symmetries, truth, estimate)
    np.testing.assert_allclose([np.degrees(turn), shift], [4, 0.03], atol=1e-12)
    in_jax = metrics.symmetric_errors(symmetries.to_jax(), truth.to_jax(), estimate.to_jax())
    np.testing.assert_allclose(in_jax, [turn, shift], atol=1e-6)
    alone = Similarity.from_matrix(np.eye(4)[None])
    np.testing.assert_allclose(np.degrees(metrics.symmetric_errors(alone, truth, estimate)[0]), 176, atol=1e-9)
    # Any symmetry of the truth changes nothing.
    for quarter in quarters:
        again = metrics.symmetric_errors(symmetries, truth @ Similarity.from_matrix(quarter), estimate)
        np.testing.assert_allclose(again, (turn, shift), atol=1e-12)
    for wrong in (truth, Similarity(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))):
        with pytest.raises(ValueError, match="symmetries must have one leading axis"):
            metrics.symmetric_errors(wrong, truth, estimate)
