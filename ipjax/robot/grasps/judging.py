"""How good hands are that close on an object: whether they hold at all, and a score in [0, 1].

The score is a product, so that each part can only lower it: how much of both pads is supported, how straight the pads
press, how much width is to spare, whether the surface was seen, how far the weight is to the side, how far the approach
is from the wanted one, how much of the hand's way is out of sight, and the share of possible poses at which it holds.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from ipjax_kernels.closing import Hand, Touch, close_hands
from ipjax_kernels.positive import root
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.config import GraspConfig
from ipjax.metrics.poses import turn_angle
from ipjax.records import PoseEstimate, Surface, Templates
from ipjax.robot.grasps.hands import closing_from_gripper, make_hand
from ipjax.robot.grasps.obstacles import above_table, compare_with_depth, look_past, table_in_object
from ipjax.robot.grasps.solid import Solid, make_solid, pose_of
from ipjax.robot.grasps.uncertainty import deviation_along, sample_poses
from ipjax.robot.records import Gripper, Workspace, rigid
from ipjax.transforms import Similarity

_HIDDEN = 0.1  # share of the hand's way that is out of sight, above which more is no worse


class Judged(NamedTuple):
    """Hands, closed on the object at the estimated pose."""

    object_from_closing: Similarity  # leading axis g
    touch: Touch
    width: Float[Array, " g"]  # m
    spare: Float[Array, " g"]  # m, each finger
    score: Float[Array, " g"]  # [0, 1]; 0 where not valid
    valid: Bool[Array, " g"]


class Surroundings(NamedTuple):
    """What the hand must heed besides the object, in the metric object frame."""

    wanted: Float[Array, "3"]  # the approach that is wanted: down on the table, or along the camera's view
    normal: Float[Array, "3"] | None  # of the table
    offset: Float[Array, ""] | None


def find_surroundings(workspace: Workspace, estimate: PoseEstimate | Similarity) -> Surroundings:
    """The table in the object's frame, and the approach that is wanted.

    Raises:
      ValueError: there is a depth without its camera.
    """
    if workspace.depth is not None and workspace.camera is None:
        raise ValueError("the depth of a workspace needs its camera")
    camera_from_object = rigid(pose_of(estimate))
    if workspace.table is None:
        return Surroundings(camera_from_object.rotation[2], None, None)
    normal, offset = table_in_object(workspace, camera_from_object)
    return Surroundings(-normal, normal, offset)


def judge(
    solid: Solid,
    hand: Hand,
    object_from_closing: Similarity,
    given: Bool[Array, " g"],
    estimate: PoseEstimate | Similarity,
    workspace: Workspace,
    around: Surroundings,
    config: GraspConfig,
) -> Judged:
    """Close each hand on the object as it was estimated; hands are moved so that both fingers have the same way.

    Args:
      given: False for hands that do not count.
    """
    touch = _close(solid, hand, object_from_closing, config, centred=True)
    closing = object_from_closing.rotation[..., 0]
    poses = Similarity(
        object_from_closing.rotation,
        object_from_closing.translation + closing * touch.centre[:, None],
        object_from_closing.scale,
    )
    width = jnp.where(touch.high >= touch.low, touch.high - touch.low, 0)
    spare = hand.opening / 2 - jnp.maximum(jnp.abs(touch.low), jnp.abs(touch.high))
    spare = jnp.where(jnp.isfinite(spare), spare, 0)
    valid = given & _holds(touch, solid, hand, config) & (spare > config.least_spare)
    if isinstance(estimate, PoseEstimate):
        # No pose, no grasp; and an uncertainty that is not known is not taken for none.
        valid &= estimate.success & jnp.all(jnp.isfinite(estimate.covariance))
    if around.normal is not None and around.offset is not None:
        _, height = above_table(poses, hand, around.normal, around.offset, config)
        valid &= height > 0.99 * config.clearance
    unknown = jnp.zeros_like(width)
    if workspace.depth is not None:
        assert workspace.camera is not None  # `find_surroundings` has seen to it
        camera_from_object = rigid(pose_of(estimate))
        others = look_past(workspace.depth, workspace.camera, solid, camera_from_object, config)
        hits, unknown = compare_with_depth(poses, hand, others, workspace.camera, camera_from_object, config)
        valid &= hits == 0
    tilt = turn_angle(1 + 2 * jnp.sum(poses.rotation[..., 2] * around.wanted, axis=-1))
    valid &= tilt <= config.tilt
    middle = poses.translation + poses.rotation[..., 2] * (hand.pad + hand.tip)[None] / 2
    wanted_spare = root(config.spare**2 + (config.spare_deviations * solid.rough) ** 2) * jnp.ones_like(width)
    if isinstance(estimate, PoseEstimate):
        off = deviation_along(estimate, middle, closing, width)
        wanted_spare = root(wanted_spare**2 + (config.spare_deviations * off) ** 2)
    ramp = lambda x: jnp.clip(x, 0, 1)
    support = ramp(_support(touch, solid, hand) / config.support)
    least = jnp.cos(jnp.asarray(config.cone, width.dtype))
    straight = ramp((jnp.min(touch.cosine, axis=-1) - least) / (1 - least))
    arm = middle - jnp.mean(solid.points, axis=0)
    arm = arm - around.wanted * jnp.sum(arm * around.wanted, axis=-1, keepdims=True)
    parts = [
        support,
        0.5 + 0.5 * straight,
        config.tight + (1 - config.tight) * ramp(spare / wanted_spare),
        1 - config.unseen * (1 - jnp.mean(touch.seen, axis=-1)),
        jnp.exp(-jnp.sum(arm**2, axis=-1) / (2 * config.arm**2)),
        1 - config.aslant * tilt / jnp.pi,
        1 - config.unknown * ramp(unknown / _HIDDEN),
    ]
    score = jnp.prod(jnp.stack(parts), axis=0)
    score = jnp.where(valid & jnp.isfinite(score), score, 0)
    return Judged(poses, touch, width, spare, score, valid & (score > 0))


def share_safe(
    solid: Solid,
    hand: Hand,
    object_from_closing: Similarity,
    estimate: PoseEstimate | Similarity,
    key: PRNGKeyArray,
    config: GraspConfig,
) -> Float[Array, " g"]:
    """The share of the poses that the object may have at which the same hand, unmoved, hits nothing and holds it."""
    count = object_from_closing.translation.shape[0]
    if not isinstance(estimate, PoseEstimate) or config.poses == 0:
        return jnp.ones(count, object_from_closing.translation.dtype)
    object_from_truth = sample_poses(estimate, key, count=config.poses)
    one = lambda poses, at: Similarity(*(jnp.expand_dims(x, at) for x in _parts(poses)))
    closing_from_truth = one(object_from_closing.inverse(), 1) @ one(object_from_truth, 0)
    flat = Similarity(*(x.reshape(-1, *x.shape[2:]) for x in _parts(closing_from_truth)))
    touch = _close(solid, hand, flat.inverse(), config, centred=False)
    holds = _holds(touch, solid, hand, config).reshape(count, config.poses)
    return jnp.mean(holds.astype(object_from_closing.translation.dtype), axis=-1)


def check_grasps(
    gripper: Gripper,
    surface: Templates | Surface,
    camera_from_object: Similarity,
    camera_from_gripper: Similarity,
    config: GraspConfig = GraspConfig(),
) -> Bool[Array, " g"]:
    """Whether hands hold an object whose pose is known: nothing is hit on the straight way, both pads press.

    What the planner asks of the pose it was given, asked of another: the true one tells what a planned grasp was worth
    without a simulation. Table and measured depth are not asked.

    Args:
      surface: of the object, in the units of its pose.
      camera_from_object: metres per model unit.
      camera_from_gripper: rigid, leading axis g.
    """
    solid = make_solid(surface, camera_from_object)
    hand = make_hand(gripper, solid.points.dtype)
    pose = rigid(camera_from_object)
    object_from_camera = Similarity(*(x[None] for x in _parts(pose.inverse())))
    poses = object_from_camera @ camera_from_gripper
    turn = jnp.asarray(closing_from_gripper(gripper.closing).T, poses.rotation.dtype)
    rotation = jnp.matmul(poses.rotation, turn, precision="highest")
    touch = _close(
        solid, hand, Similarity(rotation, poses.translation, jnp.ones_like(poses.scale)), config, centred=False
    )
    return _holds(touch, solid, hand, config)


def _close(solid: Solid, hand: Hand, object_from_closing: Similarity, config: GraspConfig, *, centred: bool) -> Touch:
    closing_from_object = object_from_closing.inverse()
    dtype = solid.points.dtype
    numbers = (jnp.asarray(x, dtype) for x in (config.retreat, config.depth, config.facing))
    linear = closing_from_object.scale[..., None, None] * closing_from_object.rotation
    cloud = (solid.points, solid.normals, solid.seen)
    return close_hands(*cloud, linear, closing_from_object.translation, hand, *numbers, centred=centred, batch=32)


def _support(touch: Touch, solid: Solid, hand: Hand) -> Float[Array, " g"]:
    """The share of the less supported pad under which surface faces it."""
    return jnp.min(touch.facing, axis=-1) * solid.area / ((hand.tip - hand.pad) * hand.breadth)


def _holds(touch: Touch, solid: Solid, hand: Hand, config: GraspConfig) -> Bool[Array, " g"]:
    """Nothing is in the way, and both pads press on enough surface without slipping."""
    least = jnp.cos(jnp.asarray(config.cone, touch.cosine.dtype))
    pressed = (_support(touch, solid, hand) >= config.least_support) & (jnp.min(touch.cosine, axis=-1) > least)
    return (touch.hits == 0) & pressed


def _parts(pose: Similarity) -> tuple[jax.Array, jax.Array, jax.Array]:
    return pose.rotation, pose.translation, pose.scale
