"""Whether to grasp: what raises and lowers the probability, what is decided, and where to look from instead."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from builders.graspable import estimate_of, from_above, make_graspable, on_table, plan_from_above

from ipjax.config import DecisionConfig
from ipjax.robot.grasps.decision import FEATURES, decide, predict_success, propose_view
from ipjax.robot.grasps.judging import check_grasps
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import place_grasps
from ipjax.transforms import Similarity


@pytest.fixture(scope="module")
def box():
    return make_graspable(trimesh.creation.box((0.05, 0.10, 0.08)))


@pytest.fixture(scope="module")
def grasps(box):
    return plan_from_above(box)


def sure(box, **deviations):
    """An estimate that explains all that is seen."""
    known = estimate_of(from_above(box.diameter), **deviations)
    score = jnp.full_like(known.hypotheses.score, 0.9)
    return dataclasses.replace(
        known,
        confidence=jnp.asarray(0.99, jnp.float32),
        present=jnp.asarray(True),
        hypotheses=dataclasses.replace(known.hypotheses, score=score),
    )


def doubtful(box, **deviations):
    low = {"turn_std": 0.2, "place_std": 0.02} | deviations
    return dataclasses.replace(sure(box, **low), confidence=jnp.asarray(0.05, jnp.float32))


def test_a_sure_pose_is_grasped_and_a_doubtful_one_looked_at_again(box, grasps):
    decision = decide(FRANKA_HAND, grasps, sure(box))
    assert decision.action == "grasp" and decision.camera_from_view is None and decision.grasp is not None
    assert decision.probability == pytest.approx(float(predict_success(FRANKA_HAND, grasps, sure(box)).max()))
    poor = dataclasses.replace(grasps, safe=0.2 * grasps.safe)
    again = decide(FRANKA_HAND, poor, doubtful(box))
    assert again.action == "look again from here" and again.camera_from_view is not None
    assert again.probability < decision.probability and "were the pose certain" in again.why
    assert again.as_json()["base_from_view"] is None and "the present camera's frame" in again.describe()


def test_where_no_view_helps_it_is_left(box, grasps):
    none = grasps.take(slice(0, 0))
    decision = decide(FRANKA_HAND, none, sure(box))
    assert (decision.action, decision.grasp, decision.probability) == ("do not", None, 0.0)
    unsure = dataclasses.replace(doubtful(box), present=jnp.asarray(False))
    assert decide(FRANKA_HAND, none, unsure).action == "look again from here"
    lost = dataclasses.replace(sure(box), success=jnp.asarray(False))
    assert decide(FRANKA_HAND, grasps, lost).why == "no pose was found"
    never = DecisionConfig(grasp=0.9999)
    assert decide(FRANKA_HAND, grasps, doubtful(box), config=never).action == "do not"


def test_every_feature_counts_in_its_direction():
    signs = dict(zip(FEATURES, DecisionConfig().weights[1:], strict=True))
    assert signs.pop("deviation") <= 0 and all(weight >= 0 for weight in signs.values())
    assert len(DecisionConfig().weights) == 1 + len(FEATURES) and sum(map(abs, signs.values())) > 0.5


def test_an_uncertain_turn_is_looked_at_along_its_axis(box):
    # The camera looks straight down; the box may have turned about its x, which lies across.
    known = estimate_of(from_above(box.diameter), axis_std=0.5, axis=(1.0, 0.0, 0.0))
    view = propose_view(known, table=on_table(box).table)
    assert view is not None
    centre = np.asarray(known.camera_from_object.translation)
    towards = (centre - view.translation) / np.linalg.norm(centre - view.translation)
    assert abs(towards[0]) > 0.85, "as low as is allowed, along x"
    np.testing.assert_allclose(view.rotation[:, 2], towards, atol=1e-6)
    assert np.linalg.norm(view.translation - centre) == pytest.approx(np.linalg.norm(centre), rel=1e-6)
    assert view.translation[2] < centre[2], "above the table"
    assert np.linalg.det(view.rotation) == pytest.approx(1)


def test_a_view_out_of_reach_is_not_proposed(box):
    known = doubtful(box)
    far = Similarity(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, 0.8]), np.ones(()))
    assert propose_view(known, far, config=DecisionConfig(away=3.0)) is None
    near = propose_view(known, far)
    assert near is not None and np.linalg.norm((far @ near).translation) <= 0.85 + 1e-6


def test_planned_grasps_hold_where_the_object_is_and_not_beside_it(box, grasps):
    pose = from_above(box.diameter)
    hands = place_grasps(grasps.object_from_gripper, pose)
    held = np.asarray(check_grasps(FRANKA_HAND, box.surface, pose, hands))
    assert held.mean() > 0.95
    moved = Similarity(pose.rotation, pose.translation + jnp.asarray([0.0, 0.0, 0.2]), pose.scale)
    assert not np.asarray(check_grasps(FRANKA_HAND, box.surface, moved, hands)).any()
