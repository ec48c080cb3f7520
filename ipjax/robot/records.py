"""What a robot needs beside the pose: a gripper, as data, and grasps.

Frames. ``gripper``: origin at the hand's base, where it is bolted to the arm; +z is the approach, along which the hand
moves towards the object; the fingers close along x or along y, whichever the gripper says. ``object`` is here the
metric object: axes and origin of the estimate's object, but in metres. ``base`` is the robot's. All lengths are metres,
and poses between these frames are rigid: the estimate's scale, the object's diameter, has been divided out, so that ::

    base_from_gripper = base_from_camera @ camera_from_object @ object_from_gripper

holds with ``camera_from_object`` made rigid (:func:`rigid`), as :func:`place_grasps` does it.
"""

import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ipjax.records import Camera, PoseEstimate
from ipjax.transforms import A, Similarity

Number = Float[Array, ""] | float


class Gripper(eqx.Module):
    """A parallel gripper: two fingers with flat pads, on a body that does not move. The fingers move alike."""

    name: str = eqx.field(static=True)
    closing: Literal["x", "y"] = eqx.field(static=True)  # the axis of the gripper along which the fingers close
    opening: Number  # the largest width between the pads, m
    reach: Number  # from the origin along +z to the middle of the pads, m
    pad: tuple[Number, Number]  # of each pad: length along z and breadth across the closing axis, m
    finger: tuple[Number, Number]  # of each finger: length along z to its tip, and thickness behind its pad, m
    # Boxes of the body, without the fingers: each its centre and its half sizes, gripper's frame, m.
    boxes: tuple[tuple[tuple[Number, Number, Number], tuple[Number, Number, Number]], ...]
    force: Number  # with which a real one closes, N

    @property
    def tip(self) -> Number:
        """From the origin along +z to the fingers' tips, where the pads end: m."""
        return self.reach + self.pad[0] / 2


class Workspace(eqx.Module):
    """What is around the object, in the camera's frame; what is None is not known and hinders nothing.

    The hand stays above the table. Where the hand lies behind a measured surface that is not the object's own, by less
    than ``GraspConfig.behind`` it collides; what is farther behind was not seen and may be free or not: such a grasp
    is allowed and its score is lower.
    """

    # A plane n · x = d: the unit normal n, which points away from the table to where the hand is, and d, m.
    table: Float[Array, "*b 4"] | None = None
    depth: Float[Array, "*b h w"] | None = None  # measured, along z, m; 0 = unknown
    camera: Camera | None = None  # of that depth


class Grasps(eqx.Module):
    """Planned grasps, best first; those that are not valid come last."""

    object_from_gripper: Similarity  # leading axes *b n; scale 1: rigid, metres
    width: Float[Array, "*b n"]  # between the pads once they touch, m: the opening that the object needs
    score: Float[Array, "*b n"]  # [0, 1], higher is better; 0 where not valid
    valid: Bool[Array, "*b n"]  # False: the place is empty, there were fewer grasps
    contacts: Float[Array, "*b n 2 3"]  # where the pads touch: first at the negative end of the closing axis; m, object
    spare: Float[Array, "*b n"]  # between an opened finger and the object, m, each finger
    safe: Float[Array, "*b n"]  # share of the poses within the estimate's uncertainty at which it still holds, [0, 1]

    def take(self, index) -> "Grasps":
        """Those that ``index`` picks along the leading axis: a number, a slice, numbers, or a mask."""
        parts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        poses = parts.pop("object_from_gripper").take(index)
        return Grasps(object_from_gripper=poses, **{name: part[index] for name, part in parts.items()})


def rigid(camera_from_object: Similarity[A]) -> Similarity[A]:
    """The pose of the metric object: the same rotation and origin, the scale divided out.

    What ``camera_from_object`` maps from model units ``x``, this maps from metres, ``scale * x``.
    """
    return _without_scale(camera_from_object)


def place_grasps(
    object_from_gripper: Similarity[A],
    camera_from_object: Similarity[A] | PoseEstimate,
    base_from_camera: Similarity[A] | None = None,
) -> Similarity[A]:
    """``base_from_gripper = base_from_camera @ camera_from_object @ object_from_gripper``, rigid and metric.

    Args:
      object_from_gripper: of :class:`Grasps`, leading axis n; scale 1.
      camera_from_object: an estimate, or its pose; its scale, metres per model unit, is divided out (:func:`rigid`).
      base_from_camera: from hand-eye calibration, scale 1; None gives ``camera_from_gripper``.

    Returns:
      Leading axis n, scale 1: where the hand goes.

    Raises:
      ValueError: ``base_from_camera`` is a NumPy pose with a scale that is not 1.
    """
    pose: Any = camera_from_object
    if isinstance(camera_from_object, PoseEstimate):
        pose = camera_from_object.camera_from_object
    base_from_object: Similarity[A] = rigid(pose)
    if base_from_camera is not None:
        if isinstance(base_from_camera.scale, np.ndarray) and np.abs(base_from_camera.scale - 1).max() > 1e-6:
            raise ValueError(f"base_from_camera is rigid: its scale is 1, not {base_from_camera.scale}")
        base_from_object = base_from_camera @ base_from_object
    parts = (base_from_object.rotation, base_from_object.translation, base_from_object.scale)
    return _without_scale(Similarity(*(x[None] for x in parts)) @ object_from_gripper)


def table_in_camera(height: Number, base_from_camera: Similarity) -> Float[Array, "4"]:
    """The table ``z = height`` of the robot's base frame (m, z up), as :class:`Workspace` has it."""
    normal = base_from_camera.rotation[2]
    offset = height - base_from_camera.translation[2]
    return jnp.concatenate([jnp.asarray(normal), jnp.asarray(offset, normal.dtype)[None]])


def _without_scale(pose: Similarity[A]) -> Similarity[A]:
    return Similarity(pose.rotation, pose.translation, pose.scale / pose.scale)  # ones, NumPy's or JAX's
