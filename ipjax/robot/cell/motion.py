"""Where the arm can go: joints for a pose of the hand, by damped least squares on MuJoCo's Jacobians; and the way.

Equations: Buss, "Introduction to inverse kinematics with Jacobian transpose, pseudoinverse and damped least squares
methods", 2004; joints that the pose leaves free are drawn towards where the arm was.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.robot.cell.arms import FINGERS, HAND
from ipjax.robot.cell.cell import Cell, body_pose
from ipjax.robot.cell.physics import load_mujoco
from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation

_NEAR, _ALIGNED = 0.001, 0.01  # metres and rad, within which a pose is reached
_DAMPING, _STEPS, _LONGEST = 0.03, 120, 0.25  # the last: rad or m of one joint in one step
_SPACING = 0.02  # metres between the poses of a straight line
_JUMP = 0.4  # rad or m that a joint may go between two of them
_STARTS = 8  # guesses from which a pose is sought
_MARGIN = 0.03  # rad or m from the joints' limits


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """Settings of a pick's way."""

    back: float = 0.10  # metres behind the grasp, against the approach, from which it goes straight
    over: float = 0.12  # metres above that place, through which it comes, if the arm can
    lift: float = 0.20  # metres straight up


@dataclasses.dataclass(frozen=True)
class Reach:
    """Whether the arm can do a grasp by its joints, the table and itself; things are not heeded."""

    possible: bool
    why: str  # why not, in words; "" where it is possible
    base_from_gripper: Similarity[np.ndarray]  # or the same turned by half about the approach: the fingers are alike
    arrival: Float[np.ndarray, "ka j"]  # joints from home to the place behind the grasp; [0 j] where not possible
    approach: Float[np.ndarray, "k j"]  # straight to the grasp
    lift: Float[np.ndarray, "kl j"]  # straight up


def reach(cell: Cell, base_from_gripper: Similarity[Any], config: MotionConfig = MotionConfig()) -> Reach:
    """Joints for the way of a pick at one pose of the hand, rigid.

    Raises:
      ValueError: the pose is not rigid.
    """
    pose = base_from_gripper.to_numpy()
    if pose.translation.shape != (3,) or abs(float(pose.scale) - 1) > 1e-4:
        raise ValueError("one rigid base_from_gripper is wanted: the scale is 1, there is no leading axis")
    body = Body(cell)
    half_turn = Similarity(rotation_from_vector(np.array([0, 0, np.pi])), np.zeros(3), np.ones(()))
    first = None
    for target in (pose, pose @ half_turn):
        found = _plan(body, target, config)
        if found.possible:
            return found
        first = first or found
    assert first is not None
    return first


def solve(cell: Cell, base_from_gripper: Similarity[np.ndarray]) -> Float[np.ndarray, " j"] | None:
    """Joints of the arm that bring the hand to a pose; None where none are found."""
    body = Body(cell)
    return next(body.solutions(base_from_gripper), None)


class Body:
    """The arm as kinematics: a state of its own, in which only the joints are moved."""

    def __init__(self, cell: Cell):
        self.mujoco, self.model = load_mujoco(), cell.model
        self.data = cell.state()
        self.places = cell.arm_places
        joints = [cell.model.joint(name) for name in cell.arm.joints]
        self.dofs = np.array([joint.dofadr[0] for joint in joints])
        self.low, self.high = np.array([joint.range for joint in joints]).T + np.array([[_MARGIN], [-_MARGIN]])
        self.hand = cell.model.body(HAND).id
        self.home = cell.arm.home
        self.seed = cell.seed
        self.fingers = [cell.model.joint(name).qposadr[0] for name in FINGERS]
        things = {cell.model.body(thing.body).id for thing in cell.things}
        self.robot = {i for i in range(1, cell.model.nbody) if i not in things}
        self.size = np.array([1.0 if joint.type[0] == 3 else 0.3 for joint in joints])  # of a start's change: rad, m

    def place(self, joints: np.ndarray) -> Similarity[np.ndarray]:
        """``base_from_gripper`` at joint positions."""
        self.data.qpos[self.places] = joints
        self.mujoco.mj_kinematics(self.model, self.data)
        self.mujoco.mj_comPos(self.model, self.data)
        return body_pose(self.data, HAND)

    def solve(self, target: Similarity[np.ndarray], start: np.ndarray) -> np.ndarray | None:
        """Joints near a start for a pose; None where the search does not end there."""
        joints, near = np.clip(start, self.low, self.high), start
        moving, turning = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        eye = np.eye(len(joints))
        for _ in range(_STEPS):
            here = self.place(joints)
            away = target.translation - here.translation
            turn = vector_from_rotation(target.rotation @ here.rotation.T)
            if np.linalg.norm(away) < _NEAR and np.linalg.norm(turn) < _ALIGNED:
                return joints
            self.mujoco.mj_jacBody(self.model, self.data, moving, turning, self.hand)
            jacobian = np.concatenate([moving[:, self.dofs], turning[:, self.dofs]])
            error = np.concatenate([away, turn])
            damped = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + _DAMPING**2 * np.eye(6))
            step = damped @ error + 0.1 * (eye - damped @ jacobian) @ (near - joints)
            joints = np.clip(joints + step * min(1.0, _LONGEST / np.abs(step).max()), self.low, self.high)
        return None

    def solutions(self, target: Similarity[np.ndarray]):
        """Joints for a pose from several starts, that from home first."""
        rng = np.random.default_rng([self.seed, 89])
        for number in range(_STARTS):
            start = self.home if number == 0 else self.home + self.size * rng.uniform(-1.2, 1.2, len(self.home))
            joints = self.solve(target, start)
            if joints is not None:
                yield joints

    def follow(self, poses: list[Similarity[np.ndarray]], start: np.ndarray) -> np.ndarray | None:
        """Joints for poses one after the other, without jumps; None where one is out of reach."""
        way = [start]
        for pose in poses:
            joints = self.solve(pose, way[-1])
            if joints is None or np.abs(joints - way[-1]).max() > _JUMP:
                return None
            way.append(joints)
        return np.stack(way)

    def touches(self, joints: np.ndarray) -> str:
        """What of the robot touches the table or itself, in words; "" where nothing does."""
        self.place(joints)
        self.mujoco.mj_forward(self.model, self.data)
        for contact in self.data.contact[: self.data.ncon]:
            first, second = (int(self.model.geom_bodyid[geom]) for geom in contact.geom)
            pair = {first, second}
            if contact.dist < -0.0005 and pair <= self.robot | {0} and len(pair) == 2:
                name = self.model.body(max(pair)).name.replace("_", " ")
                other = "the table" if 0 in pair else f"the {self.model.body(min(pair)).name.replace('_', ' ')}"
                return f"the {name} would touch {other}"
        return ""


def _plan(body: Body, target: Similarity[np.ndarray], config: MotionConfig) -> Reach:
    none = np.zeros((0, len(body.home)))
    behind = _shift(target, -config.back * target.rotation[:, 2])
    straight = [_shift(behind, share * config.back * target.rotation[:, 2]) for share in _shares(config.back)]
    upwards = [_shift(target, share * config.lift * np.array([0, 0, 1.0])) for share in _shares(config.lift)]
    why = f"no joints bring the hand to the grasp at {_words(target)}"
    for joints in body.solutions(target):
        # From the grasp outwards: it is what must be reached exactly.
        outwards = body.follow([*straight[-2::-1], behind], joints)
        lift = body.follow(upwards, joints)
        if outwards is None:
            why = "the arm cannot go straight to the grasp"
        elif lift is None:
            why = "the arm cannot lift straight up from the grasp"
        elif touched := next(filter(None, map(body.touches, (joints, outwards[-1], lift[-1]))), ""):
            why = touched
        else:
            above = body.solve(_shift(behind, np.array([0, 0, config.over])), outwards[-1])
            arrival = [body.home, *([] if above is None else [above]), outwards[-1]]
            return Reach(True, "", target, np.stack(arrival), outwards[::-1], lift)
    return Reach(False, why, target, none, none, none)


def _shares(length: float) -> np.ndarray:
    return np.linspace(0, 1, max(int(np.ceil(length / _SPACING)), 1) + 1)[1:]


def _shift(pose: Similarity[np.ndarray], by: np.ndarray) -> Similarity[np.ndarray]:
    return Similarity(pose.rotation, pose.translation + by, pose.scale)


def _words(pose: Similarity[np.ndarray]) -> str:
    x, y, z = (1000 * pose.translation).round().astype(int)
    return f"({x}, {y}, {z}) mm"
