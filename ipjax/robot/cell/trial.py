"""One trial in a cell: a frame, a pose from it, grasps from the pose, a pick; and how far each was from the truth."""

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from ipjax.config import GraspConfig
from ipjax.files.objects.record import ObjectInfo
from ipjax.records import PoseEstimate, Surface, Templates
from ipjax.robot.cell.camera import Sight
from ipjax.robot.cell.cell import Cell
from ipjax.robot.cell.picking import Pick, PickConfig, pick
from ipjax.robot.grasps.planning import box_grasps, plan_grasps
from ipjax.robot.records import Grasps, Workspace, place_grasps, table_in_camera
from ipjax.transforms import Similarity, vector_from_rotation

_PLANNERS = {False: jax.jit(plan_grasps), True: jax.jit(box_grasps)}


@dataclasses.dataclass(frozen=True)
class Trial:
    """What came of one trial."""

    camera_from_object: Similarity[np.ndarray]  # as it was estimated: metres from model units
    grasps: Grasps  # valid ones, best first
    pick: Pick
    seconds: dict[str, float]  # plan, pick

    @property
    def planned(self) -> int:
        """How many grasps there were."""
        return len(self.grasps.score)


@dataclasses.dataclass(frozen=True)
class PoseError:
    """How far an estimated pose is from the true one."""

    rotation: float  # rad
    centre: float  # metres: of the object's centre
    size: float  # ratio to the true size, less 1

    def as_json(self) -> dict[str, float]:
        """With names that end in their unit."""
        return {
            "rotation_deg": float(np.degrees(self.rotation)),
            "centre_mm": 1e3 * self.centre,
            "size_error": self.size,
        }


def try_pick(
    cell: Cell,
    known: Templates | Surface,
    sight: Sight,
    estimate: PoseEstimate | Similarity,
    *,
    seed: int = 0,
    by_box: bool = False,
    grasp_config: GraspConfig = GraspConfig(),
    config: PickConfig = PickConfig(),
) -> Trial:
    """Plan on what is known of the object at its estimated pose, and pick the cell's first thing.

    Args:
      cell: the truth; the planner is told the table's height and the gripper.
      known: of the object: its templates, or its surface alone, in the units of the pose.
      sight: the frame that the pose is from, with the camera's place in the robot's base.
      estimate: with its uncertainty; a pose alone is taken as exact.
      seed: of the planner.
      by_box: by the object's box, as the paper, not its surface.
    """
    base_from_camera = sight.base_from_camera.to_jax()
    depth = jax.numpy.asarray(sight.depth)
    workspace = Workspace(table=table_in_camera(0.0, base_from_camera), depth=depth, camera=sight.camera)
    start = time.perf_counter()
    key = jax.random.key(seed)
    found = _PLANNERS[by_box](cell.gripper, known, estimate, workspace, key, grasp_config)
    grasps = found.take(np.flatnonzero(np.asarray(found.valid)))
    planned = time.perf_counter()
    pose = estimate.camera_from_object if isinstance(estimate, PoseEstimate) else estimate
    pose = pose.to_numpy()
    if len(grasps.score):
        poses = place_grasps(grasps.object_from_gripper.to_numpy(), pose, sight.base_from_camera)
        done = pick(cell, poses, config=config)
    else:
        done = Pick(False, "no grasp was planned", None, (), None)
    seconds = {"plan": planned - start, "pick": time.perf_counter() - planned}
    return Trial(pose, grasps, done, seconds)


def true_pose(sight: Sight, info: ObjectInfo, metres_per_unit: float | None) -> Similarity[np.ndarray]:
    """``camera_from_object`` of an object file, true: the cell's first thing is the mesh that the file was made from.

    Args:
      metres_per_unit: of the mesh file; None: the thing is the file's own mesh, whose unit is the diameter.
    """
    camera_from_thing = sight.camera_from_object[0]
    if metres_per_unit is None:
        return camera_from_thing
    scale = Similarity(np.eye(3), np.zeros(3), np.asarray(metres_per_unit, np.float64))
    return camera_from_thing @ scale @ info.object_from_mesh.to_numpy().inverse()


def compare_poses(found: Similarity[Any], true: Similarity[np.ndarray]) -> PoseError:
    """The error of an estimated pose of an object whose box is centred at its origin."""
    pose = found.to_numpy()
    return PoseError(
        rotation=float(np.linalg.norm(vector_from_rotation(true.rotation.T @ pose.rotation))),
        centre=float(np.linalg.norm(pose.translation - true.translation)),
        size=float(pose.scale / true.scale - 1),
    )
