"""Grasps as files have them: poses of a gripper in the frame of the object's mesh, in metres."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.robot.grasps.hands import closing_from_gripper
from ipjax.robot.records import Grasps, Gripper
from ipjax.transforms import Similarity


@dataclasses.dataclass(frozen=True)
class GraspList:
    """Grasps of one object by one gripper, best first.

    The frame ``mesh`` has the axes and the origin of the user's mesh file, and metres: what a simulator has that loads
    the file with ``object_scale``.

    Args:
        mesh_from_gripper: leading axis n, scale 1, metres; in the gripper's own axes (`Gripper.closing`).
        score: of each, [0, 1].
        width: between the pads once they touch, m; NaN = not told.
        names: of each.
        object_file: the mesh file, without folders.
        object_scale: metres per unit of the mesh file.
        gripper: its name.
    """

    mesh_from_gripper: Similarity[np.ndarray]
    score: Float[np.ndarray, " n"]
    width: Float[np.ndarray, " n"]
    names: tuple[str, ...]
    object_file: str = ""
    object_scale: float = 1.0
    gripper: str = ""


def list_grasps(
    grasps: Grasps,
    gripper: Gripper,
    *,
    scale: float,
    mesh_scale: float = 1.0,
    mesh_centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    object_file: str = "",
) -> GraspList:
    """The valid grasps in the frame of the mesh.

    Args:
        grasps: of one object, metric object frame.
        gripper: that they are for.
        scale: of the estimate, metres per model unit.
        mesh_scale, mesh_centre, object_file: of the object's `ObjectInfo`.
    """
    valid = np.asarray(grasps.valid)
    poses = grasps.object_from_gripper.to_numpy().take(valid)
    object_scale = float(scale) * mesh_scale  # metres per unit of the mesh
    centre = object_scale * np.asarray(mesh_centre, np.float64)
    moved = Similarity(poses.rotation, poses.translation + centre, poses.scale)
    return GraspList(
        mesh_from_gripper=moved,
        score=np.asarray(grasps.score, np.float64)[valid],
        width=np.asarray(grasps.width, np.float64)[valid],
        names=tuple(f"grasp_{i}" for i in range(int(valid.sum()))),
        object_file=object_file,
        object_scale=object_scale,
        gripper=gripper.name,
    )


def turn_closing(mesh_from_gripper: Similarity[np.ndarray], before: str, after: str) -> Similarity[np.ndarray]:
    """The same hands in axes whose fingers close along another axis, x or y; the approach stays z.

    Raises:
        ValueError: an axis is neither x nor y.
    """
    for axis in (before, after):
        if axis not in ("x", "y"):
            raise ValueError(f"fingers close along x or y, not {axis!r}")
    if before == after:
        return mesh_from_gripper
    closing_from_y = closing_from_gripper("y")
    turn = closing_from_y if before == "x" else closing_from_y.T
    return Similarity(mesh_from_gripper.rotation @ turn, mesh_from_gripper.translation, mesh_from_gripper.scale)


def read_scores(values: Any, count: int, what: str) -> np.ndarray:
    """A number from 0 to 1 for each grasp. Raises ValueError for anything else; ``what`` names it."""
    try:
        scores = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        scores = np.zeros(0)
    if scores.shape != (count,) or not ((scores >= 0) & (scores <= 1)).all():
        raise ValueError(f"{what}: a number from 0 to 1 is expected for each of the {count} grasps")
    return scores
