"""Hands in their closing frame, and the fan of their poses."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from ipjax.robot.grasps.distinct import pick_distinct
from ipjax.robot.grasps.hands import closing_from_gripper, fan, hand_corners, make_hand
from ipjax.robot.grippers import FRANKA_HAND, GRIPPERS
from ipjax.transforms import rotation_from_vector

FLOAT = np.dtype(np.float32)


def test_the_same_hand_in_other_axes_is_the_same():
    turned = dataclasses.replace(
        FRANKA_HAND,
        closing="x",
        boxes=tuple(((y, -x, z), (b, a, c)) for (x, y, z), (a, b, c) in FRANKA_HAND.boxes),
    )
    for mine, other in zip(make_hand(FRANKA_HAND, FLOAT), make_hand(turned, FLOAT), strict=True):
        np.testing.assert_allclose(np.asarray(mine), np.asarray(other), atol=1e-9)


def test_closing_frames_are_turned_not_mirrored():
    for gripper in GRIPPERS.values():
        turn = closing_from_gripper(gripper.closing)
        assert np.linalg.det(turn) == 1 and turn[2, 2] == 1
        assert turn[0]["xy".index(gripper.closing)] == 1  # u is the closing axis


def test_the_corners_reach_from_base_to_tips():
    corners = np.asarray(hand_corners(make_hand(FRANKA_HAND, FLOAT)))
    np.testing.assert_allclose(corners[:, 2].max(), 0.1124, atol=1e-6)
    np.testing.assert_allclose(np.ptp(corners[:, 0]), 0.205, atol=1e-6)


def test_a_fan_closes_along_its_axis_and_starts_as_is_wanted():
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(20, 3))
    axis[0] = [0, 0, 1]  # along what is wanted: any direction across it will do
    axis = jnp.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True), jnp.float32)
    middle = jnp.asarray(rng.normal(size=(20, 3)), jnp.float32)
    wanted = jnp.asarray([0.0, 0.0, -1.0])
    hand = make_hand(FRANKA_HAND, FLOAT)
    poses = fan(middle, axis, wanted, hand, 8)
    turns = np.asarray(poses.rotation)
    np.testing.assert_allclose(turns @ turns.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-5)
    np.testing.assert_allclose(turns[..., 0], np.broadcast_to(axis[:, None], (20, 8, 3)), atol=1e-5)
    pads = np.asarray(poses.translation) + FRANKA_HAND.reach * turns[..., 2]
    np.testing.assert_allclose(pads, np.broadcast_to(middle[:, None], pads.shape), atol=1e-6)
    down = -turns[..., 2, 2]
    assert (down[1:, 0] >= down[1:].max(axis=1) - 1e-6).all()
    np.testing.assert_allclose(np.sum(turns[:, 0, :, 2] * turns[:, 4, :, 2], -1), -1, atol=1e-5)


def test_distinct_grasps_are_the_best_of_their_neighbours():
    turn = np.asarray(rotation_from_vector(jnp.asarray([[0, 0, 0], [0, 0, np.pi], [0, 0, 1.0], [0.1, 0, 0]], FLOAT)))
    middle = jnp.asarray([[0.0, 0, 0], [0.001, 0, 0], [0, 0, 0], [0.05, 0, 0]])
    score = jnp.asarray([0.9, 0.8, 0.7, 0.6])
    chosen, taken = pick_distinct(middle, jnp.asarray(turn), score, 4, (0.01, 0.26))
    # Half a turn about the approach is the same hand; a turn by 1 rad, or 5 cm away, is not.
    assert chosen[:3].tolist() == [0, 2, 3]
    np.testing.assert_allclose(np.asarray(taken), [0.9, 0.7, 0.6, -1])
