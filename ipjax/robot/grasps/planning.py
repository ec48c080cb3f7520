"""Grasps of an object whose pose and surface are known: by opposite points, and by its box as the paper has it."""

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.closing import Hand
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.config import GraspConfig
from ipjax.records import PoseEstimate, Surface, Templates
from ipjax.robot.grasps.distinct import pick_distinct
from ipjax.robot.grasps.hands import closing_from_gripper, fan, make_hand
from ipjax.robot.grasps.judging import Judged, Surroundings, find_surroundings, judge, share_safe
from ipjax.robot.grasps.obstacles import above_table
from ipjax.robot.grasps.sampling import sample_pairs
from ipjax.robot.grasps.solid import Solid, make_solid
from ipjax.robot.records import Grasps, Gripper, Workspace
from ipjax.transforms import Similarity

_FACE = 14  # points along each side of a face of the box


def plan_grasps(
    gripper: Gripper,
    templates: Templates | Surface,
    estimate: PoseEstimate | Similarity,
    workspace: Workspace,
    key: PRNGKeyArray,
    config: GraspConfig = GraspConfig(),
) -> Grasps:
    """Where a parallel gripper may close on an object, best first.

    Pairs of surface points with opposite normals, a fan of approaches about the axis through each, and the open hand
    moved to each along a straight line: what hits the object, the table or something that was measured is out, and so
    is what has too little surface under either pad. The best of the rest that differ are closed once more on the
    object at other poses that the estimate allows; the share at which they hold is part of the score. So a grasp of a
    mug's handle is not chosen where the turn about the mug's axis is uncertain, and one of its body is.

    The paper's grasps are :func:`box_grasps` (section IV-D); it names planners such as this one as what comes next.
    Can be jitted, and vmapped over estimates, scenes and keys.

    Args:
      gripper: see :mod:`ipjax.robot.grippers`.
      templates: the object, or its surface alone.
      estimate: with its uncertainty; where it has no ``success`` there is no grasp. A pose alone,
        ``camera_from_object`` in metres per model unit, is taken as exact.
      workspace: the table and the measured depth, camera frame; ``Workspace()`` knows of nothing. Without a table the
        wanted approach is the camera's view, in place of straight down.
      key: of the pairs and poses that are drawn.

    Returns:
      ``config.grasps`` of them, in the metric object frame; ``place_grasps`` brings them to the robot's base.

    Raises:
      ValueError: the surface has fewer than 16 points, or the workspace a depth without its camera.
    """
    around = find_surroundings(workspace, estimate)
    solid = make_solid(templates, estimate)
    hand = make_hand(gripper, solid.points.dtype)
    first, second, third = jax.random.split(key, 3)
    pairs = sample_pairs(solid, hand.opening, first, config)
    poses = fan(pairs.middle, pairs.axis, around.wanted, hand, config.approaches)
    poses = Similarity(*(x.reshape(-1, *x.shape[2:]) for x in (poses.rotation, poses.translation, poses.scale)))
    given = jnp.repeat(pairs.valid, config.approaches)
    poses, given = _above(poses, given, hand, around, config)
    # As many as there is time for; those that come as is wanted are drawn more often.
    along = jnp.sum(poses.rotation[..., 2] * around.wanted, axis=-1)
    given &= along >= jnp.cos(jnp.minimum(jnp.asarray(config.tilt, along.dtype), jnp.pi))
    noise = jax.random.gumbel(second, along.shape, along.dtype)
    tried = jax.lax.top_k(jnp.where(given, noise + along, -jnp.inf), min(config.tried, along.shape[0]))[1]
    judged = judge(solid, hand, poses.take(tried), given[tried], estimate, workspace, around, config)
    return _choose(gripper, solid, hand, judged, estimate, third, config)


def box_grasps(
    gripper: Gripper,
    templates: Templates | Surface,
    estimate: PoseEstimate | Similarity,
    workspace: Workspace,
    key: PRNGKeyArray,
    config: GraspConfig = GraspConfig(),
) -> Grasps:
    """The paper's grasps: by the object's box at the estimated pose (section IV-D), which knows nothing of its shape.

    The fingers close on two faces of the smallest box around the object, or of the box along its own axes for a bare
    surface, from each of the four sides between, at the middle of the box or as deep as the fingers are long. Table,
    depth and uncertainty count as in :func:`plan_grasps`; for the object stands its box.

    Args, Returns, Raises: as :func:`plan_grasps`.
    """
    around = find_surroundings(workspace, estimate)
    solid = make_solid(templates, estimate)
    axes = templates.axes if isinstance(templates, Templates) else jnp.eye(3, dtype=solid.points.dtype)
    spread = jnp.sum(solid.points[:, None] * axes, axis=-1)
    low, high = jnp.min(spread, axis=0), jnp.max(spread, axis=0)
    box = _box_solid(axes, low, high, solid)
    hand = make_hand(gripper, solid.points.dtype)
    poses = _box_poses(axes, low, high, hand)
    given = jnp.ones(poses.translation.shape[0], bool)
    poses, given = _above(poses, given, hand, around, config)
    judged = judge(box, hand, poses, given, estimate, workspace, around, config)
    return _choose(gripper, box, hand, judged, estimate, key, config)


def _above(
    poses: Similarity, given: Bool[Array, " g"], hand: Hand, around: Surroundings, config: GraspConfig
) -> tuple[Similarity, Bool[Array, " g"]]:
    """Hands drawn back to where they clear the table; those that cannot are not given."""
    if around.normal is None or around.offset is None:
        return poses, given
    poses, height = above_table(poses, hand, around.normal, around.offset, config)
    return poses, given & (height > 0.99 * config.clearance)


def _choose(
    gripper: Gripper,
    solid: Solid,
    hand: Hand,
    judged: Judged,
    estimate: PoseEstimate | Similarity,
    key: PRNGKeyArray,
    config: GraspConfig,
) -> Grasps:
    """The best that differ, tried at other poses, in order, as grasps in the gripper's own frame."""
    poses = judged.object_from_closing
    middle = (poses @ jnp.broadcast_to(_pads(hand), (poses.scale.shape[0], 1, 3)))[:, 0]
    count = max(config.distinct, config.grasps)
    chosen, taken = pick_distinct(middle, poses.rotation, judged.score, count, config.apart)
    poses = poses.take(chosen)
    safe = share_safe(solid, hand, poses, estimate, key, config)
    score = jnp.where(taken > 0, taken * safe, 0)
    order = jax.lax.top_k(score, min(config.grasps, score.shape[0]))[1]
    index, poses, score, safe = chosen[order], poses.take(order), score[order], safe[order]
    valid = score > 0
    turn = jnp.asarray(closing_from_gripper(gripper.closing), poses.rotation.dtype)
    rotation = jnp.matmul(poses.rotation, turn, precision="highest")
    # A hand was moved along u after its points were measured.
    contacts = judged.touch.contact[index]
    found = Grasps(
        object_from_gripper=Similarity(rotation, poses.translation, poses.scale),
        width=judged.width[index],
        score=score,
        valid=valid,
        contacts=poses @ jnp.where(jnp.isfinite(contacts), contacts, 0),
        spare=judged.spare[index],
        safe=jnp.where(valid, safe, 0),
    )
    return _fill(found, config.grasps)


def _fill(found: Grasps, count: int) -> Grasps:
    """Empty places behind what was found, and in place of what is not finite."""
    missing = count - found.score.shape[0]
    valid = found.valid & jnp.all(jnp.isfinite(found.object_from_gripper.translation), axis=-1)

    def fill(values, empty):
        shaped = valid.reshape(-1, *(1,) * (values.ndim - 1))
        values = jnp.where(shaped, values, jnp.asarray(empty, values.dtype))
        rest = jnp.broadcast_to(jnp.asarray(empty, values.dtype), (missing, *values.shape[1:]))
        return jnp.concatenate([values, rest])

    pose = found.object_from_gripper
    identity = np.eye(3)
    poses = Similarity(fill(pose.rotation, identity), fill(pose.translation, 0), fill(pose.scale, 1))
    rest = {name: fill(getattr(found, name), 0) for name in ("width", "score", "contacts", "spare", "safe")}
    return Grasps(object_from_gripper=poses, valid=jnp.concatenate([valid, jnp.zeros(missing, bool)]), **rest)


def _pads(hand: Hand) -> Float[Array, "1 3"]:
    """The middle between the pads, closing frame."""
    middle = (hand.pad + hand.tip) / 2
    return jnp.stack([jnp.zeros_like(middle), jnp.zeros_like(middle), middle])[None]


def _box_solid(axes: Float[Array, "3 3"], low: Float[Array, "3"], high: Float[Array, "3"], solid: Solid) -> Solid:
    """Points all over the faces of a box."""
    line = (np.arange(_FACE) + 0.5) / _FACE
    a, b = (x.reshape(-1) for x in np.meshgrid(line, line))
    points, normals = [], []
    for axis in range(3):
        for end in (0, 1):
            face = np.zeros((len(a), 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = end, a, b
            points.append(face)
            normals.append(np.tile(np.eye(3)[axis] * (2 * end - 1), (len(a), 1)))
    share = jnp.asarray(np.concatenate(points), low.dtype)
    outwards = jnp.asarray(np.concatenate(normals), low.dtype)
    map_back = lambda rows: jnp.sum(rows[:, :, None] * axes, axis=1)
    sides = high - low
    area = 2 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0]) / share.shape[0]
    seen = jnp.ones(share.shape[0], low.dtype) * jnp.mean(solid.seen)
    return Solid(map_back(low + share * sides), map_back(outwards), seen, area, solid.rough)


def _box_poses(axes: Float[Array, "3 3"], low: Float[Array, "3"], high: Float[Array, "3"], hand: Hand) -> Similarity:
    """Hands that close along each axis of the box, from each of the four sides between."""
    middle, half = jnp.sum((low + high)[:, None] / 2 * axes, axis=0), (high - low) / 2
    pads = (hand.pad + hand.tip) / 2
    free = pads - (jnp.max(hand.high[:, 2]) if hand.high.shape[0] else hand.root)  # between the body and the pads
    rotations, places = [], []
    for closing in range(3):
        for other in range(3):
            if other == closing:
                continue
            for sign in (-1, 1):
                u, w = axes[closing], sign * axes[other]
                back = jnp.maximum(half[other] - 0.9 * free, 0)
                rotations.append(jnp.stack([u, jnp.cross(w, u), w], axis=-1))
                places.append(middle - w * (pads + back))
    translation = jnp.stack(places)
    return Similarity(jnp.stack(rotations), translation, jnp.ones(len(places), translation.dtype))
