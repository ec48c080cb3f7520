"""Whether to grasp at all: the probability that a planned grasp succeeds, and another place to look from.

The planner ranks grasps; it does not say whether the best is good enough. A logistic rule does, learned on made objects
in the simulated cell (``python -m benchmarks.grasp_rule``). Where it says no, the same rule is asked once more as if
the pose were certain: if that would help, another look is proposed, else the object is not to be grasped.
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ipjax.capture.views.paths import look_from
from ipjax.config import DecisionConfig
from ipjax.onboarding.viewpoints import directions_on_sphere
from ipjax.records import PoseEstimate, Surface, Templates
from ipjax.robot.grasps.hands import closing_from_gripper
from ipjax.robot.grasps.uncertainty import deviation_along
from ipjax.robot.records import Grasps, Gripper
from ipjax.transforms import Similarity

# What the rule knows of a grasp, each in [0, 1] or nearly so.
FEATURES = (
    "confidence",  # of the pose: what it agrees with of what is seen is in it
    "safe",  # share of the likely poses at which the grasp holds
    "score",  # the planner's
    "spare",  # m to spare at each finger, in units of 16 mm, 1 at most
    "deviation",  # of the pose along the closing axis, in units of 5 mm, 2 at most
)
_SPARE, _DEVIATION = 0.016, 0.005
_CERTAIN = {"confidence": 1.0, "safe": 1.0, "deviation": 0.0}  # what a better view may bring
_DIRECTIONS = 200  # of another look that are compared


@dataclasses.dataclass(frozen=True)
class Decision:
    """What to do, and why."""

    action: Literal["grasp", "look again from here", "do not"]
    probability: float  # that the best grasp succeeds; 0 where there is none
    grasp: int | None  # the likeliest of the planned grasps to succeed
    why: str  # in words
    camera_from_view: Similarity[np.ndarray] | None = None  # where to look from instead: a camera's pose, rigid, metres
    base_from_view: Similarity[np.ndarray] | None = None  # the same in the robot's base, where that is known

    def describe(self) -> str:
        """A line for people."""
        view = self.camera_from_view if self.base_from_view is None else self.base_from_view
        if view is None:
            return f"{self.action}: {self.why}"
        x, y, z = (f"{1e3 * value:.0f}" for value in view.translation)
        frame = "the present camera's frame" if self.base_from_view is None else "the robot's base"
        return f"{self.action}: {self.why}; the camera at ({x}, {y}, {z}) mm in {frame}"

    def as_json(self) -> dict[str, Any]:
        """With names that say the frames."""
        matrix = lambda pose: None if pose is None else pose.to_matrix().tolist()
        return {
            "action": self.action,
            "probability": round(self.probability, 4),
            "grasp": self.grasp,
            "why": self.why,
            "camera_from_view": matrix(self.camera_from_view),
            "base_from_view": matrix(self.base_from_view),
        }


def make_features(confidence, safe, score, spare, off) -> tuple[Float[Array, " n"], ...]:
    """The columns of the features, in the order of `FEATURES`, from an estimate's and its grasps' numbers (m)."""
    return (
        confidence,
        safe,
        score,
        jnp.clip(spare / _SPARE, 0, 1),
        jnp.clip(off / _DEVIATION, 0, 2),
    )


def describe_grasps(gripper: Gripper, grasps: Grasps, estimate: PoseEstimate) -> Float[Array, "n f"]:
    """The features of each grasp, in the order of `FEATURES`."""
    off = grasp_deviation(gripper, grasps, estimate)
    one = jnp.ones_like(grasps.score)
    columns = make_features(estimate.confidence * one, grasps.safe, grasps.score, grasps.spare, off)
    return jnp.stack(columns, axis=-1)


def grasp_deviation(gripper: Gripper, grasps: Grasps, estimate: PoseEstimate) -> Float[Array, " n"]:
    """By how much (m, standard deviation) the object may be off along each closing axis."""
    axis = jnp.asarray(closing_from_gripper(gripper.closing)[0], grasps.score.dtype)
    closing = jnp.sum(grasps.object_from_gripper.rotation * axis, axis=-1)
    return deviation_along(estimate, jnp.mean(grasps.contacts, axis=-2), closing, grasps.width)


def predict_success(
    gripper: Gripper,
    grasps: Grasps,
    estimate: PoseEstimate,
    config: DecisionConfig = DecisionConfig(),
    *,
    certain: bool = False,
) -> Float[Array, " n"]:
    """The probability that each grasp succeeds; 0 where it is not valid.

    Args:
      certain: as if the pose were certain.
    """
    features = describe_grasps(gripper, grasps, estimate)
    if certain:
        for name, value in _CERTAIN.items():
            features = features.at[..., FEATURES.index(name)].set(value)
    weights = jnp.asarray(config.weights, features.dtype)
    chance = jax.nn.sigmoid(weights[0] + jnp.sum(features * weights[1:], axis=-1))
    return jnp.where(grasps.valid, chance, 0)


def decide(
    gripper: Gripper,
    grasps: Grasps,
    estimate: PoseEstimate,
    base_from_camera: Similarity | None = None,
    *,
    known: Templates | Surface | None = None,
    table: Float[Array, "4"] | None = None,
    config: DecisionConfig = DecisionConfig(),
) -> Decision:
    """Grasp, look again from another place, or leave it; on the host, not to be jitted.

    Args:
      grasps: of :func:`~ipjax.robot.grasps.planning.plan_grasps`, for this estimate.
      base_from_camera: rigid; then a look is sought within the robot's reach.
      known: the object: sides of its surface that were not seen are looked at, too.
      table: as :class:`~ipjax.robot.records.Workspace` has it, camera frame; None: with ``base_from_camera``, z = 0 of
        the base; else up is against the camera's view.
    """
    chance = np.asarray(predict_success(gripper, grasps, estimate, config))
    better = np.asarray(predict_success(gripper, grasps, estimate, config, certain=True))
    if not bool(estimate.success):
        return Decision("do not", 0.0, None, "no pose was found")
    best = int(chance.argmax()) if chance.size and chance.max() > 0 else None
    likely = 0.0 if best is None else float(chance[best])
    if likely >= config.grasp:
        return Decision("grasp", likely, best, f"it succeeds with a probability of {likely:.0%}")
    if best is None:
        helps = not bool(estimate.present)
        why = "no grasp was planned" + (", and the pose is a guess" if helps else " at a pose that is sure")
    else:
        helps = bool(better.max() >= config.grasp)
        why = f"the best grasp succeeds with a probability of {likely:.0%}, "
        certain = f"{better.max():.0%}"
        why += f"were the pose certain with {certain}" if helps else f"and with {certain} were the pose certain"
    view = propose_view(estimate, base_from_camera, known=known, table=table, config=config) if helps else None
    if view is None:
        return Decision("do not", likely, best, why + ("; there is nowhere to look from" if helps else ""))
    base = None if base_from_camera is None else base_from_camera.to_numpy() @ view
    return Decision("look again from here", likely, best, why, view, base)


def propose_view(
    estimate: PoseEstimate,
    base_from_camera: Similarity | None = None,
    *,
    known: Templates | Surface | None = None,
    table: Float[Array, "4"] | None = None,
    config: DecisionConfig = DecisionConfig(),
) -> Similarity[np.ndarray] | None:
    """``camera_from_view``: where a camera, as far from the object as now, sees best what is uncertain; None: nowhere.

    A view tells the object's place across its rays but not along them, and a turn about its rays better than one about
    an axis across. Of views above the table that differ from the present one, that is taken which tells most of the
    variance: of the place across, of the turn along the view (with the ambiguity's axis, so a mug whose handle is
    uncertain is looked at from above), and of surface that faces it and was guessed. Metres of the turn are those at
    the object's radius.
    """
    pose = estimate.camera_from_object.to_numpy()
    centre, radius = np.asarray(pose.translation, np.float64), float(estimate.diameter) / 2
    distance = float(np.linalg.norm(centre))
    seen_from = -centre / distance
    up = _find_up(base_from_camera, table)
    directions = directions_on_sphere(_DIRECTIONS)
    elevation = np.arcsin(np.clip(directions @ up, -1, 1))
    allowed = (elevation >= config.least_elevation) & (elevation <= config.most_elevation)
    allowed &= directions @ seen_from <= np.cos(config.away)
    if base_from_camera is not None:
        base = base_from_camera.to_numpy()
        places = base @ (centre + distance * directions)
        # From as far as now, or from as far as it holds a camera, but not too near to see the object whole.
        allowed &= np.linalg.norm(places, axis=-1) <= max(config.reach, float(np.linalg.norm(base.translation)))
    if not allowed.any():
        return None
    covariance = np.asarray(estimate.covariance, np.float64)
    axis = np.asarray(pose.rotation @ np.asarray(estimate.ambiguity, np.float64))
    turn = radius**2 * (covariance[:3, :3] + np.outer(axis, axis))
    place = covariance[3:, 3:]
    along = lambda matrix: np.einsum("na,ab,nb->n", directions, matrix, directions)
    told = along(turn) + np.trace(place) - along(place)
    if known is not None:
        surface = known.surface if isinstance(known, Templates) else known
        normals = np.asarray(surface.normals, np.float64) @ pose.rotation.T
        guessed = 1 - np.asarray(surface.seen, np.float64)
        shown = (np.maximum(directions @ normals.T, 0) * guessed).mean(-1)
        told = told + config.rough * (np.trace(turn) + np.trace(place)) * shown
    told = np.where(allowed, told, -np.inf)
    chosen = centre + distance * directions[int(told.argmax())]
    return look_from(chosen[None], centre, up).take(0)


def _find_up(base_from_camera: Similarity | None, table: Any) -> np.ndarray:
    """Away from the table, in camera axes."""
    if table is not None:
        return np.asarray(table, np.float64)[:3]
    if base_from_camera is not None:
        return np.asarray(base_from_camera.to_numpy().rotation[2], np.float64)
    return np.array([0.0, 0.0, -1.0])
