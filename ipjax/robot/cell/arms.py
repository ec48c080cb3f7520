"""Arms with a gripper, as MuJoCo specifications: the Panda from a package, and a gripper of boxes on a gantry, our own.

Both have the same joints of the fingers and one actuator that closes them. The robot's base is the origin, z up, the
table z = 0.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.robot.cell.packages import find_panda, has_panda
from ipjax.robot.cell.physics import PhysicsConfig, finger_force, load_mujoco
from ipjax.robot.records import Gripper

FINGERS = ("finger_joint1", "finger_joint2")  # slides; 0 = closed, half of the opening = open
FINGER_BODIES = ("left_finger", "right_finger")
HAND = "hand"  # the body whose frame is the gripper's
GRIP = "actuator8"  # closes the fingers, as the Panda's model calls it; its input is metres of each finger
ARMS = ("auto", "panda", "gantry")
_STIFFNESS, _DAMPING = 2e4, 150.0  # of the gripper's servo: N/m and N s/m of both fingers
BITE = 0.02  # metres that the servo is told to close beyond closed, so that it presses on what is thin, too


@dataclasses.dataclass(frozen=True)
class Arm:
    """A robot before the cell is built around it."""

    name: str
    spec: Any  # mujoco.MjSpec
    gripper: Gripper
    joints: tuple[str, ...]
    home: Float[np.ndarray, " j"]  # rad or m, of those joints: out of the fixed camera's way
    speed: Float[np.ndarray, " j"]  # largest of each while moving freely, rad/s or m/s


def make_arm(kind: str, gripper: Gripper, config: PhysicsConfig) -> Arm:
    """The arm of a kind: "panda", "gantry", or "auto": the Panda where its package is and the gripper is its hand.

    Raises:
      ValueError: no such kind; or the Panda is asked for and its package is missing, or with another gripper.
    """
    if kind not in ARMS:
        raise ValueError(f"unknown arm {kind!r}: one of {', '.join(ARMS)}")
    if kind == "panda" and gripper.name != "franka":
        raise ValueError(f"the Panda's model has the Franka hand, not {gripper.name}; with another take 'gantry'")
    if kind == "panda" or (kind == "auto" and gripper.name == "franka" and has_panda()):
        return _make_panda(gripper, config)
    return _make_gantry(gripper, config)


def _make_panda(gripper: Gripper, config: PhysicsConfig) -> Arm:
    spec = load_mujoco().MjSpec.from_file(str(find_panda()))
    for key in list(spec.keys):
        spec.delete(key)  # poses of the robot alone: with things in the cell they do not fit
    for light in list(spec.lights):
        spec.delete(light)
    grip = spec.actuator(GRIP)
    force = 2 * finger_force(gripper.force, config)  # the tendon gives half to either finger
    grip.gainprm = [_STIFFNESS, *[0.0] * 9]
    grip.biasprm = [0.0, -_STIFFNESS, -_DAMPING, *[0.0] * 7]
    grip.forcerange = [-force, force]
    grip.ctrlrange = [-BITE, 0.04]
    for body in spec.bodies:
        if body.name != "world":
            body.gravcomp = 1.0  # the real one makes up for its own weight
    home = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    speed = np.array([1.2, 1.2, 1.2, 1.2, 1.5, 1.5, 1.5])  # about half of Franka's limits
    return Arm("panda", spec, gripper, tuple(f"joint{i}" for i in range(1, 8)), home, speed)


def _make_gantry(gripper: Gripper, config: PhysicsConfig) -> Arm:
    """Three slides and three hinges that carry a gripper of boxes, measured as the gripper says."""
    force = 2 * finger_force(gripper.force, config)
    half = float(gripper.opening) / 2
    along, across = (0, 1) if gripper.closing == "x" else (1, 0)
    pad_length, breadth = (float(x) for x in gripper.pad)
    length, thickness = (float(x) for x in gripper.finger)
    tip = float(gripper.tip)

    def put(along_value: float | int, across_value: float | int, z: float | int) -> str:
        values = [0.0, 0.0, z]
        values[along], values[across] = along_value, across_value
        return " ".join(f"{value:.6g}" for value in values)

    boxes = "".join(
        f'<geom type="box" pos="{_numbers(centre)}" size="{_numbers(size)}" rgba=".85 .86 .88 1" mass=".3"/>'
        for centre, size in gripper.boxes
    )
    fingers = ""
    for sign, joint, body in zip((1, -1), FINGERS, FINGER_BODIES, strict=True):
        upper = max(length - pad_length, 0.002)
        fingers += f"""
        <body name="{body}" pos="0 0 {tip - length:.6g}">
          <joint name="{joint}" type="slide" axis="{put(sign, 0, 0)}" range="0 {half:.6g}" armature="0.1" damping="1"/>
          <geom type="box" pos="{put(sign * (thickness / 2 + 0.001), 0, upper / 2)}" mass="0.02"
            size="{put(thickness / 2 - 0.001, breadth / 2, upper / 2)}" rgba=".8 .81 .83 1"/>
          <geom type="box" pos="{put(sign * thickness / 2, 0, length - pad_length / 2)}" mass="0.02"
            size="{put(thickness / 2, breadth / 2, pad_length / 2)}" rgba=".2 .21 .23 1"/>
        </body>"""
    axes = (("x", "slide", "1 0 0", "-.3 1.2"), ("y", "slide", "0 1 0", "-.8 .8"), ("z", "slide", "0 0 1", "-.2 1.2"))
    hinges = (("a", "1 0 0", "-1.55 1.55"), ("b", "0 1 0", "-1.55 1.55"), ("c", "0 0 -1", "-3.14 3.14"))
    opened, servos, inertia = "", "", '<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>'
    for name, kind, axis, reach in axes:
        opened += f'<body gravcomp="1">{inertia}<joint name="{name}" type="{kind}" axis="{axis}" range="{reach}"/>'
        servos += f'<position name="{name}" joint="{name}" kp="40000" kv="1500" forcerange="-400 400"/>'
    for name, axis, reach in hinges:
        opened += f'<body gravcomp="1">{inertia}<joint name="{name}" type="hinge" axis="{axis}" range="{reach}"/>'
        servos += f'<position name="{name}" joint="{name}" kp="2000" kv="80" forcerange="-60 60"/>'
    text = f"""<mujoco model="gantry">
      <compiler angle="radian" autolimits="true"/>
      <default><geom group="2" condim="4"/></default>
      <worldbody><body name="gantry">{opened}
        <body name="{HAND}" quat="0 1 0 0" gravcomp="1">{boxes}{fingers}</body>
      {"</body>" * 6}</body></worldbody>
      <tendon>
        <fixed name="split"><joint joint="{FINGERS[0]}" coef="0.5"/><joint joint="{FINGERS[1]}" coef="0.5"/></fixed>
      </tendon>
      <equality>
        <joint joint1="{FINGERS[0]}" joint2="{FINGERS[1]}" solimp="0.95 0.99 0.001" solref="0.005 1"/>
      </equality>
      <actuator>{servos}
        <general name="{GRIP}" tendon="split" forcerange="{-force} {force}" ctrlrange="{-BITE} {half:.6g}"
          biastype="affine" gainprm="{_STIFFNESS}" biasprm="0 {-_STIFFNESS} {-_DAMPING}"/>
      </actuator>
    </mujoco>"""
    spec = load_mujoco().MjSpec.from_string(text)
    for body in spec.bodies:
        if body.name in FINGER_BODIES:
            body.gravcomp = 1.0
    speed = np.array([0.5, 0.5, 0.5, 1.5, 1.5, 1.5])
    home = np.array([0.3, 0.0, 0.55, 0.0, 0.0, 0.0])
    return Arm("gantry", spec, gripper, ("x", "y", "z", "a", "b", "c"), home, speed)


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.6g}" for value in values)
