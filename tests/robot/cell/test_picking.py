"""Picks hold what Coulomb's law says they hold, and tell what went wrong where they do not."""

import dataclasses

import numpy as np
import pytest
from builders.cells import SIDES, grasp_from_above, lie, make_block

from ipjax.robot.cell.cell import make_cell
from ipjax.robot.cell.physics import PhysicsConfig
from ipjax.robot.cell.picking import PickConfig, pick
from ipjax.robot.grippers import FRANKA_HAND, ROBOTIQ_2F_85
from ipjax.transforms import Similarity

REAL = PhysicsConfig()
MENAGERIE = PhysicsConfig(force=2.0)  # its gripper pulls the tendon of both fingers with 4 N at most
GRAVITY = 9.81


def run(mass=0.5, config=REAL, along=0.0, **options):
    cell = make_cell([make_block()], masses=[mass], arm="gantry", base_from_object=[lie()], config=config, **options)
    return pick(cell, grasp_from_above(cell, along), config=PickConfig(frames=0))


def test_a_block_is_lifted_and_held():
    done = run()
    assert done.success and done.possible and done.reached and not done.touched and done.fingers == 2
    assert abs(done.risen - 0.2) < 0.005 and done.slip < 0.001 and done.pushed < 0.001
    assert abs(done.opening - SIDES[1]) < 0.001
    assert done.force == pytest.approx(FRANKA_HAND.force, rel=0.03)  # with which each finger presses
    assert "held" in done.why


@pytest.mark.parametrize("share, holds", [(0.8, True), (1.2, False)])
def test_what_is_held_is_what_coulomb_says(share, holds):
    """Two fingers hold 2 µ F, and no more: neither creep nor anything that sticks decides."""
    config = PhysicsConfig(force=10.0, friction=0.5)
    done = run(share * 2 * 0.5 * 10.0 / GRAVITY, config)
    assert done.success == holds
    assert not holds or done.slip < 0.002


def test_the_gripper_as_menagerie_ships_it_fails():
    assert not run(0.5, MENAGERIE).success
    assert run(0.5, dataclasses.replace(MENAGERIE, force=20.0)).success


def test_the_default_cone_of_friction_fails():
    """Held away from its middle, what is not beyond friction creeps all the same: it sags in the hand."""
    default = PhysicsConfig(elliptic=False, impratio=1.0, noslip=0)
    assert run(0.6, along=0.055).slip < 0.005
    assert not run(0.6, default, along=0.055).success


def test_other_grippers_close_on_their_own_axis():
    for gripper in (ROBOTIQ_2F_85, dataclasses.replace(FRANKA_HAND, name="own", closing="x")):
        assert run(gripper=gripper).success, gripper.name


def test_failures_are_told():
    cell = make_cell([make_block()], masses=[0.5], arm="gantry", base_from_object=[lie()])
    config = PickConfig(frames=0)
    beside = grasp_from_above(cell, along=0.15)
    assert pick(cell, beside, config=config).why == "the fingers closed on nothing"
    turned = grasp_from_above(cell)
    turned = Similarity(turned.rotation[:, :, [1, 0, 2]] * [1, -1, 1], turned.translation, turned.scale)
    landed = pick(cell, turned, config=config)  # closes along the long side
    assert not landed.success and landed.touched and "it landed on the thing" in landed.why
    far = Similarity(turned.rotation, turned.translation + np.array([3.0, 0, 0]), turned.scale)
    refused = pick(cell, far, config=config)
    assert not refused.possible and refused.grasp is None and "no joints bring the hand" in refused.why
    both = Similarity(*(np.concatenate(pair) for pair in zip(_parts(far), _parts(grasp_from_above(cell)), strict=True)))
    second = pick(cell, both, config=config)
    assert second.success and second.grasp == 1 and len(second.refused) == 1


def _parts(pose):
    return pose.rotation, pose.translation, pose.scale


def test_a_pick_changes_nothing_and_repeats():
    cell = make_cell([make_block()], 5, masses=[0.5], arm="gantry", clutter=2)
    before = cell.start.copy()
    first, second = (pick(cell, grasp_from_above(cell), config=PickConfig(frames=10)) for _ in range(2))
    assert (cell.start == before).all()
    assert first.as_json() == second.as_json()
    assert (first.recording.base_from_body.translation == second.recording.base_from_body.translation).all()
    assert list(dict.fromkeys(first.recording.stages)) == ["move", "approach", "close", "lift", "hold"]
    assert np.ptp(np.diff(first.recording.times)) < 0.005


def test_what_is_no_pick_is_refused():
    cell = make_cell([make_block()], arm="gantry", base_from_object=[lie()])
    one = grasp_from_above(cell)
    with pytest.raises(ValueError, match="one leading axis"):
        pick(cell, one.take(0))
    with pytest.raises(ValueError, match="no thing 3"):
        pick(cell, one, target=3)
    with pytest.raises(ValueError, match="rigid"):
        pick(cell, Similarity(one.rotation, one.translation, 2 * one.scale))
