"""``python -m benchmarks.grasp_planning [-o FILE.md]``: grasps of made objects: how many, how true, and how long.

Every kind of made object at two sizes, standing on a table below a camera, with the uncertainty of a good estimate.
The width that a grasp tells is compared with that of the mesh itself, cut by the volume between the fingers. Times are
of the compiled program, warm, on this machine: of the plan and of the paper's grasps by the box, for one object.
"""

import argparse
import dataclasses
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import commit, describe_device, time_in_turns
from ipjax.config import GraspConfig
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.storage.writing import write_text
from ipjax.records import Agreement, Camera, Hypotheses, PoseEstimate, Surface
from ipjax.robot.grasps.planning import box_grasps, plan_grasps
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Grasps, Workspace
from ipjax.synthetic.objects import KINDS, make_object
from ipjax.transforms import Similarity

DIAMETERS = (0.09, 0.14)  # m
HEIGHT = 0.8  # m: of the camera above the middle of the object
TURN, PLACE, SIZE = 0.02, 0.002, 0.01  # standard deviations: rad, m, share of the diameter
DENSE = 200_000  # points of the surface that stand for the mesh itself


@dataclasses.dataclass(frozen=True)
class Problem:
    """An object on a table."""

    name: str
    surface: Surface
    estimate: PoseEstimate
    workspace: Workspace
    dense: np.ndarray  # points of the mesh, metric object frame


def make_problem(kind: str, diameter: float, seed: int = 0) -> Problem:
    """An object of a kind that stands on its bottom, seen from straight above."""
    mesh = make_object(kind, seed)
    surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(mesh, 2048)))
    turn = np.diag([1.0, -1.0, -1.0])
    pose = Similarity(*(jnp.asarray(x, jnp.float32) for x in (turn, [0, 0, HEIGHT], diameter)))
    extents = jnp.asarray(np.ptp(mesh.vertices, axis=0), jnp.float32)
    zero = jnp.zeros((), jnp.float32)
    estimate = PoseEstimate(
        camera_from_object=pose,
        confidence=zero + 1,
        present=jnp.asarray(True),
        covariance=jnp.diag(jnp.asarray([TURN**2] * 3 + [PLACE**2] * 3, jnp.float32)),
        diameter=pose.scale,
        box=jnp.stack([-extents / 2, extents / 2]),
        scale_std=SIZE * pose.scale,
        ambiguity=jnp.asarray([0, 0, TURN], jnp.float32),
        agreement=Agreement(zero, zero, zero, zero, zero, zero),
        hypotheses=Hypotheses(pose.take(None), jnp.ones(1)),
        view=jnp.zeros((), jnp.int32),
        view_score=jnp.zeros(1),
        inliers=jnp.zeros((), jnp.int32),
        rmse=zero,
        success=jnp.asarray(True),
    )
    bottom = HEIGHT - diameter * float(mesh.vertices[:, 2].min())
    depth = jnp.full((480, 640), bottom, jnp.float32)  # of the table alone: the object's own would be taken out
    camera = Camera(jnp.asarray([600.0, 600.0]), jnp.asarray([319.5, 239.5]))
    workspace = Workspace(table=jnp.asarray([0, 0, -1, -bottom], jnp.float32), depth=depth, camera=camera)
    dense = diameter * sample_surface_plainly(mesh)
    return Problem(f"{kind}, {1e3 * diameter:.0f} mm", surface, estimate, workspace, dense)


def sample_surface_plainly(mesh: Any) -> np.ndarray:
    """Many points by area, and the vertices, where the extremes are."""
    from ipjax.files.meshes.sampling import sample_appearance

    return np.concatenate([sample_appearance(mesh, DENSE)[0], mesh.vertices])


def true_widths(problem: Problem, grasps: Grasps) -> np.ndarray:
    """How far apart the surface is between the fingers of each grasp, by the dense points: m."""
    poses = grasps.object_from_gripper.to_numpy()
    widths = []
    for i in range(len(np.asarray(grasps.score))):
        x, y, z = (poses.take(i).inverse() @ problem.dense).T
        fingers = (np.abs(x) < FRANKA_HAND.pad[1] / 2) & (np.abs(y) < FRANKA_HAND.opening / 2)
        fingers &= (z > FRANKA_HAND.tip - FRANKA_HAND.finger[0]) & (z < FRANKA_HAND.tip)
        widths.append(np.ptp(y[fingers]))
    return np.asarray(widths)


def rows(quick: bool = False) -> Iterator[dict[str, Any]]:
    """A row for each object: grasps, their best score, errors of the width, and times."""
    plan, by_box = jax.jit(plan_grasps), jax.jit(box_grasps)
    for kind in KINDS[:2] if quick else KINDS:
        for diameter in DIAMETERS[:1] if quick else DIAMETERS:
            problem = make_problem(kind, diameter)
            key, config = jax.random.key(0), GraspConfig()
            given = FRANKA_HAND, problem.surface, problem.estimate, problem.workspace, key, config
            valid = lambda found: found.take(np.flatnonzero(np.asarray(found.valid)))
            found, boxed = valid(plan(*given)), valid(by_box(*given))
            error = 1e3 * (np.asarray(found.width) - true_widths(problem, found))
            times = time_in_turns(
                {"plan": lambda given=given: plan(*given), "box": lambda given=given: by_box(*given)},
                5 if quick else 15,
            )
            yield {
                "name": problem.name,
                "grasps": len(error),
                "best": float(found.score[0]) if len(error) else None,
                "safe": float(np.mean(np.asarray(found.safe))) if len(error) else None,
                "box_grasps": len(np.asarray(boxed.score)),
                "bias_mm": float(error.mean()) if len(error) else None,
                "worst_mm": float(np.abs(error).max()) if len(error) else None,
                "plan_ms": 1e3 * statistics.median(times["plan"]),
                "plan_fastest_ms": 1e3 * min(times["plan"]),
                "box_ms": 1e3 * statistics.median(times["box"]),
            }


def render(found: list[dict[str, Any]]) -> str:
    """The page."""
    device = describe_device()
    number = lambda x, digits: "" if x is None else f"{x:.{digits}f}"
    head = (
        "| object | grasps | best score | holds within uncertainty | by box | width: bias, mm | worst, mm | "
        "plan, ms (fastest) | box, ms |"
    )
    lines = ["# Grasps of made objects", "", (__doc__ or "").split("\n\n", 1)[1].strip(), ""]
    lines += [head, "|---" + "|---:" * 8 + "|"]
    for row in found:
        lines.append(
            f"| {row['name']} | {row['grasps']} | {number(row['best'], 2)} | {number(row['safe'], 2)} | "
            f"{row['box_grasps']} | {number(row['bias_mm'], 2)} | {number(row['worst_mm'], 2)} | "
            f"{row['plan_ms']:.0f} ({row['plan_fastest_ms']:.0f}) | {row['box_ms']:.0f} |"
        )
    lines += ["", f"Made by `python -m benchmarks.grasp_planning`, commit {commit()}, {device['device']}, "]
    lines[-1] += f"{device['cores']} cores, jax {device['jax']}."
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and print the page."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.grasp_planning", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="also write the page there")
    parser.add_argument("--quick", action="store_true", help="two objects: does it work?")
    arguments = parser.parse_args()
    page = render(list(rows(arguments.quick)))
    print(page)
    if arguments.output is not None:
        write_text(arguments.output, page)


if __name__ == "__main__":
    main()
