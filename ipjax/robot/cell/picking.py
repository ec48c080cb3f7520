"""A pick: to the grasp, close, lift, hold; and what became of it, in figures and in words."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.robot.cell.arms import BITE, FINGER_BODIES, FINGERS, GRIP, HAND
from ipjax.robot.cell.cell import Cell, body_pose
from ipjax.robot.cell.motion import MotionConfig, Reach, reach
from ipjax.robot.cell.physics import load_mujoco
from ipjax.transforms import Similarity, vector_from_rotation

_WATCH = 10  # steps after which it is looked how far the thing has slipped


@dataclasses.dataclass(frozen=True)
class PickConfig:
    """Settings of a pick, and what counts as success."""

    motion: MotionConfig = MotionConfig()
    approach_speed: float = 0.10  # m/s
    lift_speed: float = 0.15  # m/s
    closing_speed: float = 0.06  # m/s of each finger
    squeeze: float = 0.4  # seconds after the fingers could be closed, before the lift
    hold: float = 1.0  # seconds
    risen: float = 0.10  # metres that the thing must have risen at the end
    slip: float = 0.02  # metres that it may move in the hand
    frames: float | int = 20  # a second that are recorded; 0 = none


@dataclasses.dataclass(frozen=True)
class Recording:
    """Where everything was, for a film."""

    times: Float[np.ndarray, " f"]  # seconds
    stages: tuple[str, ...]  # of every frame
    base_from_body: Similarity[np.ndarray]  # [f b]: every body of the model


@dataclasses.dataclass(frozen=True)
class Pick:
    """What happened."""

    success: bool
    why: str  # in words, of a success, too
    grasp: int | None  # which of the grasps was done; None where the arm can do none
    refused: tuple[str, ...]  # of those before it, why the arm cannot
    reach: Reach | None
    reached: bool = False  # the hand came to where it was sent, to 5 mm and 3°
    touched: bool = False  # a finger or the hand touched the thing before the fingers closed
    pushed: float = 0.0  # metres that the thing had moved by then
    opening: float = 0.0  # metres between the pads once closed
    fingers: int = 0  # that touch the thing once closed: 0, 1, 2
    force: float = 0.0  # newtons, the smaller of both fingers' once closed
    risen: float = 0.0  # metres that the thing is higher at the end
    slip: float = 0.0  # metres that it moved in the hand from the lift on, at most
    turned: float = 0.0  # rad that it turned in the hand from the lift on
    disturbed: float = 0.0  # metres that another thing was moved, at most
    recording: Recording | None = dataclasses.field(default=None, repr=False)

    @property
    def possible(self) -> bool:
        """Whether the arm can do one of the grasps."""
        return self.grasp is not None

    @property
    def recording_rate(self) -> float:
        """Frames a second of the recording; 0 where there is none."""
        if self.recording is None or len(self.recording.times) < 2:
            return 0.0
        return float((len(self.recording.times) - 1) / np.ptp(self.recording.times))

    def as_json(self) -> dict[str, Any]:
        """The figures with names that end in their unit."""
        return {
            "success": self.success,
            "why": self.why,
            "grasp": self.grasp,
            "refused": list(self.refused),
            "reached": self.reached,
            "touched": self.touched,
            "pushed_mm": 1e3 * self.pushed,
            "opening_mm": 1e3 * self.opening,
            "fingers": self.fingers,
            "force_n": self.force,
            "risen_mm": 1e3 * self.risen,
            "slip_mm": 1e3 * self.slip,
            "turned_deg": float(np.degrees(self.turned)),
            "disturbed_mm": 1e3 * self.disturbed,
        }


def pick(
    cell: Cell,
    base_from_gripper: Similarity[Any],
    *,
    target: int = 0,
    most: int = 20,
    config: PickConfig = PickConfig(),
) -> Pick:
    """Do the first of the grasps that the arm can do, from the start of the cell; the cell stays as it is.

    Args:
      cell: whose state is the truth; nothing of it is told to the grasps.
      base_from_gripper: where the hand goes, best first, [n]: rigid, as `ipjax.robot.records.place_grasps` gives them.
      target: the number of the thing to be picked.
      most: grasps that are tried to be reached.

    Raises:
      ValueError: there is no such thing, or the poses are not rigid or have no leading axis.
    """
    poses = base_from_gripper.to_numpy()
    if poses.translation.ndim != 2:
        raise ValueError(f"base_from_gripper has one leading axis, of grasps; it has {poses.translation.ndim - 1}")
    if not 0 <= target < len(cell.things):
        raise ValueError(f"there is no thing {target}: the cell has {len(cell.things)}")
    refused = []
    for number in range(min(most, len(poses.translation))):
        found = reach(cell, poses.take(number), config.motion)
        if found.possible:
            return _Run(cell, target, config).do(found, number, tuple(refused))
        refused.append(found.why)
    why = f"the arm can do none of the {len(refused)} grasps; of the first, {refused[0]}" if refused else "no grasp"
    return Pick(False, why, None, tuple(refused), None)


class _Run:
    """One pick as it runs: the state, its inputs, and the recording."""

    def __init__(self, cell: Cell, target: int, config: PickConfig):
        self.mujoco, self.cell, self.config = load_mujoco(), cell, config
        self.model, self.data = cell.model, cell.state()
        self.thing = cell.things[target].body
        self.body = cell.model.body(self.thing).id
        self.others = [one.body for one in cell.things if one.body != self.thing]
        self.finger_ids = [cell.model.body(name).id for name in FINGER_BODIES]
        self.finger_places = [cell.model.joint(name).qposadr[0] for name in FINGERS]
        self.half = float(cell.gripper.opening) / 2
        self.grip = self.half  # metres from closed, as told
        self.servo = cell.model.actuator(GRIP).id
        self.stage, self.watched = "", False
        self.touched, self.slip = False, 0.0
        self.hand_from_thing: Similarity[np.ndarray] | None = None  # at the lift
        self.frames: list[tuple[float, str, np.ndarray, np.ndarray]] = []

    def do(self, found: Reach, number: int, refused: tuple[str, ...]) -> Pick:
        config, start = self.config, body_pose(self.data, self.thing)
        before = {name: body_pose(self.data, name).translation for name in self.others}
        motion, speed = config.motion, self.cell.arm.speed
        self.stage = "move"
        for first, second in zip(found.arrival[:-1], found.arrival[1:], strict=True):
            self.move(np.stack([first, second]), max(float((np.abs(second - first) / speed).max()) * 1.9, 0.3))
        self.stage, self.watched = "approach", True
        self.move(found.approach, motion.back / config.approach_speed)
        self.wait(0.2)
        self.watched = False
        hand = body_pose(self.data, HAND)
        off = found.base_from_gripper.inverse() @ hand
        reached = np.linalg.norm(off.translation) < 0.005 and np.linalg.norm(vector_from_rotation(off.rotation)) < 0.052
        pushed = float(np.linalg.norm(body_pose(self.data, self.thing).translation - start.translation))

        self.stage = "close"
        self.close(-BITE, (self.half + BITE) / config.closing_speed)
        self.wait(config.squeeze)
        opening = float(self.data.qpos[self.finger_places].sum())
        forces = self.finger_forces()

        self.stage = "lift"
        self.hand_from_thing = body_pose(self.data, HAND).inverse() @ body_pose(self.data, self.thing)
        self.move(found.lift, motion.lift / config.lift_speed)
        self.stage = "hold"
        self.wait(config.hold)
        end = body_pose(self.data, self.thing)
        held = body_pose(self.data, HAND).inverse() @ end
        assert self.hand_from_thing is not None
        turn = vector_from_rotation(self.hand_from_thing.rotation.T @ held.rotation)
        moved = [float(np.linalg.norm(body_pose(self.data, n).translation - at)) for n, at in before.items()]
        told = Pick(
            success=False,
            why="",
            grasp=number,
            refused=refused,
            reach=found,
            reached=bool(reached),
            touched=self.touched,
            pushed=pushed,
            opening=opening,
            fingers=sum(force > 0.1 for force in forces),
            force=min(forces),
            risen=float(end.translation[2] - start.translation[2]),
            slip=self.slip,
            turned=float(np.linalg.norm(turn)),
            disturbed=max(moved, default=0.0),
            recording=self.recording(),
        )
        success, why = judge(told, config)
        return dataclasses.replace(told, success=success, why=why)

    def move(self, way: np.ndarray, seconds: float) -> None:
        """Along joint positions, from rest to rest."""
        steps = max(int(seconds * 1.5 / self.model.opt.timestep), 1)
        t = np.arange(1, steps + 1) / steps
        smooth, share = t * t * (3 - 2 * t), np.linspace(0, 1, len(way))
        joints = np.stack([np.interp(smooth, share, column) for column in way.T], axis=-1)
        self.joints = way[-1]
        self.advance(joints, np.full(steps, self.grip))

    def wait(self, seconds: float) -> None:
        steps = int(seconds / self.model.opt.timestep)
        self.advance(np.repeat(self.joints[None], steps, 0), np.full(steps, self.grip))

    def close(self, to: float, seconds: float) -> None:
        steps = int(seconds / self.model.opt.timestep)
        grips = np.linspace(self.grip, to, steps + 1)[1:]
        self.grip = to
        self.advance(np.repeat(self.joints[None], steps, 0), grips)

    def advance(self, joints: np.ndarray, grips: np.ndarray) -> None:
        """The simulation with these inputs, one of each for a step."""
        data, rate = self.data, self.config.frames
        for number in range(len(grips)):
            data.ctrl[: joints.shape[1]] = joints[number]
            data.ctrl[self.servo] = grips[number]
            self.mujoco.mj_step(self.model, data)
            if self.watched and not self.touched:
                self.touched = any(self.body in pair for pair in self.pairs())
            if self.hand_from_thing is not None and number % _WATCH == 0:
                now = body_pose(data, HAND).inverse() @ body_pose(data, self.thing)
                away = np.linalg.norm(now.translation - self.hand_from_thing.translation)
                self.slip = max(self.slip, float(away))
            if rate and data.time >= len(self.frames) / rate:
                self.frames.append((data.time, self.stage, data.xmat.copy(), data.xpos.copy()))

    def pairs(self) -> list[tuple[int, int]]:
        """Bodies in contact."""
        return [
            (int(self.model.geom_bodyid[a]), int(self.model.geom_bodyid[b]))
            for a, b in self.data.contact.geom[: self.data.ncon]
            if self.model.geom_bodyid[a] != 0 and self.model.geom_bodyid[b] != 0
        ]

    def finger_forces(self) -> list[float]:
        """Newtons along the contacts' normals with which each finger presses on the thing."""
        totals, wrench = [0.0, 0.0], np.zeros(6)
        for number in range(self.data.ncon):
            a, b = (int(self.model.geom_bodyid[geom]) for geom in self.data.contact.geom[number])
            if self.body not in (a, b):
                continue
            for side, finger in enumerate(self.finger_ids):
                if finger in (a, b):
                    self.mujoco.mj_contactForce(self.model, self.data, number, wrench)
                    totals[side] += float(abs(wrench[0]))
        return totals

    def recording(self) -> Recording | None:
        if not self.frames:
            return None
        times, stages, turns, places = zip(*self.frames, strict=True)
        rotations = np.stack(turns).reshape(len(times), -1, 3, 3)
        poses = Similarity(rotations, np.stack(places), np.ones(rotations.shape[:2]))
        return Recording(np.array(times), tuple(stages), poses)


def judge(told: Pick, config: PickConfig) -> tuple[bool, str]:
    """Whether it was a success, and a sentence on it."""
    if told.risen >= config.risen and told.slip <= config.slip:
        return True, f"lifted by {1e3 * told.risen:.0f} mm and held, with {1e3 * told.slip:.1f} mm of slip"
    if told.risen >= config.risen:
        why = f"it slipped by {1e3 * told.slip:.0f} mm in the hand"
    elif not told.reached:
        cause = "it landed on the thing" if told.touched else "something was in the way"
        why = f"the hand did not come to the grasp: {cause}"
    elif told.fingers == 0:
        why = "the fingers closed on nothing"
    elif told.fingers == 1:
        why = "only one finger held it"
    elif told.slip > config.slip:
        why = f"it slipped out of the fingers, which pressed with {told.force:.0f} N"
    else:
        why = f"it rose by {1e3 * told.risen:.0f} mm only"
    if told.touched and told.pushed > 0.002:
        why += f"; the hand had touched it on the way and pushed it by {1e3 * told.pushed:.0f} mm"
    return False, why
