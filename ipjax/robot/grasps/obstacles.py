"""What a hand must not hit besides the object: the table, and what the camera measured around the object."""

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.closing import Hand
from jaxtyping import Array, Float

from ipjax.cameras import project, subsample
from ipjax.config import GraspConfig
from ipjax.records import Camera
from ipjax.robot.grasps.hands import hand_boxes, hand_corners
from ipjax.robot.grasps.solid import Solid
from ipjax.robot.records import Workspace
from ipjax.transforms import Similarity

_WIDE = 160  # pixels: the width of the image in which the object's own pixels are found
_STEPS = 3  # places on the straight way to the object where the hand is compared with the depth


def table_in_object(workspace: Workspace, camera_from_object: Similarity) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """The table's normal and offset in the metric object frame; ``camera_from_object`` is rigid."""
    assert workspace.table is not None
    normal, offset = workspace.table[:3], workspace.table[3]
    there = jnp.sum(camera_from_object.rotation * normal[:, None], axis=0)
    return there, offset - jnp.sum(normal * camera_from_object.translation)


def above_table(
    object_from_closing: Similarity,
    hand: Hand,
    normal: Float[Array, "3"],
    offset: Float[Array, ""],
    config: GraspConfig,
) -> tuple[Similarity, Float[Array, "*g"]]:
    """Hands drawn back along their approach until they clear the table, and the least height on their way, m.

    A hand is drawn back by no more than its pads are long: farther and they would not hold.
    """
    corners = hand_corners(hand)
    approach = object_from_closing.rotation[..., 2]
    height = _heights(object_from_closing, corners, normal, offset)
    falling = -jnp.sum(approach * normal, axis=-1)  # how fast the hand sinks on its way
    wanted = (config.clearance - height) / jnp.maximum(falling, 0.1)
    back = jnp.where(falling > 0.1, jnp.clip(wanted, 0, hand.tip - hand.pad), 0)
    moved = Similarity(
        object_from_closing.rotation,
        object_from_closing.translation - approach * back[..., None],
        object_from_closing.scale,
    )
    height = height + back * falling
    return moved, jnp.minimum(height, height + config.retreat * falling)


def _heights(poses, corners, normal, offset):
    """The lowest corner of each hand above the table."""
    down = jnp.sum(poses.rotation * normal[:, None], axis=-2)  # the normal in each closing frame
    rise = jnp.min(jnp.sum(down[..., None, :] * corners, axis=-1), axis=-1)
    return rise + jnp.sum(poses.translation * normal, axis=-1) - offset


def look_past(
    depth: Float[Array, "h w"], camera: Camera, solid: Solid, camera_from_object: Similarity, config: GraspConfig
) -> Float[Array, "h w"]:
    """The depth of everything but the object: what lies between its front and its back in its outline is taken out.

    Args:
      camera_from_object: rigid, metres.

    Returns:
      0 = unknown, or the object's.
    """
    height, width = depth.shape
    step = max(width // _WIDE, 1)
    small = subsample(camera, step)
    rows, columns = -(-height // step), -(-width // step)
    placed = camera_from_object @ solid.points
    pixels = jnp.round(project(small, placed)).astype(jnp.int32)
    inside = (placed[:, 2] > 1e-3) & jnp.all(
        (pixels >= 0) & (pixels < jnp.asarray([columns, rows], jnp.int32)), axis=-1
    )
    where = jnp.where(inside, pixels[:, 1] * columns + pixels[:, 0], rows * columns)
    z = placed[:, 2]
    front = jnp.full(rows * columns + 1, jnp.inf, z.dtype).at[where].min(z)[:-1].reshape(rows, columns)
    back = jnp.full(rows * columns + 1, -jnp.inf, z.dtype).at[where].max(z)[:-1].reshape(rows, columns)
    # Points lie a few pixels apart: each also covers its neighbours.
    front = jax.lax.reduce_window(front, jnp.asarray(jnp.inf, z.dtype), jax.lax.min, (5, 5), (1, 1), "SAME")
    back = jax.lax.reduce_window(back, jnp.asarray(-jnp.inf, z.dtype), jax.lax.max, (5, 5), (1, 1), "SAME")
    row, column = (np.minimum(np.arange(n) // step, m - 1) for n, m in ((height, rows), (width, columns)))
    front, back = (image[row][:, column] for image in (front, back))
    own = (depth > front - 2 * config.margin) & (depth < back + 2 * config.margin)
    return jnp.where(own, 0, depth)


def compare_with_depth(
    object_from_closing: Similarity,
    hand: Hand,
    depth: Float[Array, "h w"],
    camera: Camera,
    camera_from_object: Similarity,
    config: GraspConfig,
) -> tuple[Float[Array, "g"], Float[Array, "g"]]:
    """How many of a hand's points lie within what was measured, and the share of them that is out of sight.

    A point just behind a measured surface, by ``config.margin`` to ``config.behind``, is in it. A point farther behind
    may be in free space or not. What is in front of it, outside the image, or where no depth is known, counts neither
    way.

    Args:
      object_from_closing: leading axis g.
      depth: of :func:`look_past`.
      camera_from_object: rigid.
    """
    low, high = hand_boxes(hand)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, n) for n in (3, 3, 5)], indexing="ij"), -1).reshape(-1, 3)
    grid = jnp.asarray(grid, low.dtype)
    probes = (low[:, None] + (high - low)[:, None] * grid).reshape(-1, 3)
    away = jnp.asarray(np.linspace(0, 1, _STEPS), low.dtype) * config.retreat
    back = jnp.zeros((_STEPS, 1, 3), low.dtype).at[:, 0, 2].set(away)
    probes = (probes[None] - back).reshape(-1, 3)
    one = Similarity(*(x[None] for x in _parts(camera_from_object)))
    placed = (one @ object_from_closing) @ probes
    height, width = depth.shape
    pixels = jnp.round(project(camera, placed)).astype(jnp.int32)
    inside = (placed[..., 2] > 1e-3) & jnp.all(
        (pixels >= 0) & (pixels < jnp.asarray([width, height], jnp.int32)), axis=-1
    )
    column, row = jnp.clip(pixels[..., 0], 0, width - 1), jnp.clip(pixels[..., 1], 0, height - 1)
    measured = jnp.where(inside, depth[row, column], 0)
    beyond = jnp.where(measured > 0, placed[..., 2] - measured, 0)
    count = lambda mask: jnp.sum(mask.astype(low.dtype), axis=-1)
    hits = count((beyond > config.margin) & (beyond < config.behind))
    return hits, count(beyond >= config.behind) / probes.shape[0]


def _parts(pose: Similarity):
    return pose.rotation, pose.translation, pose.scale
