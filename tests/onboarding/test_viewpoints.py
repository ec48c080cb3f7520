"""Template poses: where they stand, where they look, and how far apart they are."""

import numpy as np
import pytest

from ipjax.config import OnboardConfig
from ipjax.onboarding.viewpoints import viewpoints


def test_poses_are_rotations_that_look_at_the_origin():
    poses = viewpoints(40, 10, distance=3.0)
    rotation, translation = np.asarray(poses.rotation), np.asarray(poses.translation)
    assert rotation.shape == (400, 3, 3) and translation.shape == (400, 3)
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-6)
    # The origin is on the optical axis, ahead of the camera.
    np.testing.assert_allclose(translation, np.broadcast_to([0, 0, 3.0], (400, 3)), atol=1e-6)
    assert (np.asarray(poses.scale) == 1).all()


def test_order_is_direction_major_and_rolls_are_even():
    rotation = np.asarray(viewpoints(7, 4).rotation, np.float64).reshape(7, 4, 3, 3)
    ahead = rotation[..., 2, :]
    np.testing.assert_allclose(ahead, np.broadcast_to(ahead[:, :1], ahead.shape), atol=1e-6)
    turn = rotation[:, 1:] @ rotation[:, :-1].transpose(0, 1, 3, 2)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(turn, np.broadcast_to(quarter, turn.shape), atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 40, 200])
def test_directions_cover_the_sphere(count):
    ahead = np.asarray(viewpoints(count, 1).rotation)[:, 2]
    probes = np.random.default_rng(0).normal(size=(500, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    gap = np.arccos(np.clip((probes @ ahead.T).max(1), -1, 1)).max()
    # A cap of that angle around every direction would have about three times the area of the sphere.
    assert gap <= min(np.pi, 2 * np.sqrt(3.2 / count))
    np.testing.assert_allclose(ahead.sum(0) / count, 0, atol=0.1 if count > 2 else 1.1)


def test_upright_views_show_z_upwards():
    rotation = np.asarray(viewpoints(40, 1).rotation)
    assert (rotation[:, 1, 2] < 0).all()  # the image's y is down


def test_templates_are_seen_from_where_the_configuration_says():
    distance = OnboardConfig().distance
    np.testing.assert_allclose(viewpoints(3, 2).translation, np.broadcast_to([0, 0, distance], (6, 3)))


def test_bad_arguments_are_told():
    for call in (
        lambda: viewpoints(0, 10),
        lambda: viewpoints(4, 0),
        lambda: viewpoints(4, 1, distance=0.4),
    ):
        with pytest.raises(ValueError, match=r"\w+ \w+"):
            call()
