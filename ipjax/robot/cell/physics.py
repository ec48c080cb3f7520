"""What the simulation rests on: MuJoCo, imported so that no GL library is touched, and the physics of contacts.

The settings are those with which a gripper holds what a real one holds, and no more: with MuJoCo's default cone of
friction things creep out of the fingers, and with the force of MuJoCo Menagerie's gripper (4 N at most) they fall
(`tests/robot/cell`). Nothing is welded to the hand.
"""

import dataclasses
import os
import sys
from typing import Any


@dataclasses.dataclass(frozen=True)
class PhysicsConfig:
    """Settings of the simulation; sources: MuJoCo's documentation, "Preventing slip", and Franka's data sheet."""

    step: float = 0.002  # seconds
    elliptic: bool = True  # MuJoCo's cone of friction; the pyramidal one lets things creep
    impratio: float = 10.0  # stiffness of friction against that of contacts
    noslip: int = 5  # iterations that undo what soft contacts let creep below the limit of friction
    friction: float = 0.7  # between a thing and all it touches
    torsion: float = 0.004  # metres: friction against turning about a contact's normal
    rolling: float = 0.0005  # metres: friction against rolling
    stiffness: float = 0.005  # seconds: time constant of contacts (MuJoCo's solref)
    force: float | None = None  # newtons with which each finger presses; None: the gripper's, 70 at most


def load_mujoco() -> Any:
    """The module ``mujoco``. It reads MUJOCO_GL when it is imported, and a wrong value may end the process; the physics
    needs no GL, so it is hidden meanwhile. Pictures are drawn by `ipjax.rendering`, in a process of its own.
    """
    if "mujoco" in sys.modules:
        return sys.modules["mujoco"]
    given = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    finally:
        os.environ.pop("MUJOCO_GL")
        if given is not None:
            os.environ["MUJOCO_GL"] = given
    return mujoco


def set_options(spec: Any, config: PhysicsConfig) -> None:
    """Physics of a whole cell. Set on the specification that is compiled: one that is attached keeps nothing of it."""
    mujoco = load_mujoco()
    spec.option.timestep = config.step
    cones = mujoco.mjtCone
    spec.option.cone = cones.mjCONE_ELLIPTIC if config.elliptic else cones.mjCONE_PYRAMIDAL
    spec.option.impratio = config.impratio
    spec.option.noslip_iterations = config.noslip
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def describe_contact(config: PhysicsConfig) -> dict[str, Any]:
    """Arguments of a thing's geoms. Their priority makes them count, whatever the geom that they touch says."""
    return {
        "condim": 6,
        "priority": 1,
        "friction": [config.friction, config.torsion, config.rolling],
        "solref": [config.stiffness, 1.0],
        "solimp": [0.95, 0.99, 0.001, 0.5, 2.0],
    }


def finger_force(gripper_force: Any, config: PhysicsConfig) -> float:
    """Newtons with which each finger presses."""
    return min(float(gripper_force), 70.0) if config.force is None else config.force
