"""``python -m benchmarks.grasps DATA``: picks of scanned objects in the simulated robot cell.

Objects of a data set in BOP layout (YCB-V's, with their real masses) are let go on the table at random; grasps are
planned from the true pose, and the first that the arm can do is done. Studies:

* ``true``: every object, 20 placements, both planners: planned, possible for the arm, succeeded.
* ``physics``: the same few placements with other physics: what holds and what does not.
* ``knowledge``: poses by ipjax from the cell's camera, the object known from a scan, poorer meshes, or a photo
  (`benchmarks.grasp_knowledge`); needs the encoder's weights. `python -m benchmarks.grasp_rule` learns from others
  when to grasp; the page has both.

Each pick is a line of a journal in ``--output``: killed and called again, it goes on. ``--page`` writes the page of
what is there.
"""

import argparse
import collections
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import commit, describe_device
from ipjax.bop.dataset import Dataset
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.storage.parsing import parse
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.progress import bar
from ipjax.records import Surface
from ipjax.robot.cell.cell import make_cell
from ipjax.robot.cell.physics import PhysicsConfig
from ipjax.robot.cell.picking import PickConfig, pick
from ipjax.robot.grasps.planning import box_grasps, plan_grasps
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Workspace, place_grasps

# Name and mass, kg, of objects of YCB-V: Calli et al., "The YCB object and model set", 2015, Table 1.
OBJECTS = {
    3: ("sugar box", 0.514),
    4: ("soup can", 0.349),
    5: ("mustard bottle", 0.603),
    9: ("potted meat can", 0.370),
    10: ("banana", 0.066),
    14: ("mug", 0.118),
    15: ("power drill", 0.895),
    21: ("foam brick", 0.028),
}
PLANNERS = {"antipodal": plan_grasps, "box": box_grasps}
PHYSICS = {
    "as it is: elliptic cone, impratio 10, no creep, 70 N, µ 0.7": PhysicsConfig(),
    "20 N": PhysicsConfig(force=20.0),
    "µ 0.4": PhysicsConfig(friction=0.4),
    "creep left (no noslip iterations)": PhysicsConfig(noslip=0),
    "MuJoCo's default: pyramidal cone, impratio 1": PhysicsConfig(elliptic=False, impratio=1.0, noslip=0),
    "Menagerie's gripper as shipped: 4 N on the tendon": PhysicsConfig(force=2.0),
}
STUDIES = ("true", "physics")
TRIALS = 6  # placements of each object in the study with poses by ipjax
PLACEMENTS = 8  # of the study of physics
HEAVY = (5, 15)  # its objects


class Bench:
    """Meshes, surfaces and compiled planners."""

    def __init__(self, dataset: Dataset):
        self.dataset = dataset
        self.known: dict[int, tuple[Mesh, Surface]] = {}
        self.planners = {name: jax.jit(planner) for name, planner in PLANNERS.items()}

    def mesh(self, obj_id: int) -> tuple[Mesh, Surface]:
        """Metres."""
        if obj_id not in self.known:
            mesh = self.dataset.mesh(obj_id, "models")
            surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(mesh, 2048, seed=0)))
            self.known[obj_id] = mesh, surface
        return self.known[obj_id]

    def run(self, obj_id: int, seed: int, planner: str, arm: str, config: PhysicsConfig) -> dict[str, Any]:
        """One pick as a line."""
        name, mass = OBJECTS[obj_id]
        mesh, surface = self.mesh(obj_id)
        cell = make_cell([mesh], seed, names=[name], masses=[mass], arm=arm, config=config)
        pose = cell.base_from_object[0].to_jax()
        table = Workspace(table=jnp.array([0.0, 0, 1, 0]))  # the base stands for the camera: z = 0
        start = time.perf_counter()
        found = jax.device_get(self.planners[planner](FRANKA_HAND, surface, pose, table, jax.random.key(seed)))
        planning = time.perf_counter() - start
        valid = np.flatnonzero(found.valid)
        line: dict[str, Any] = {"planned": len(valid), "planning_s": planning, "arm": cell.arm.name}
        if not len(valid):
            return line | {"possible": False, "success": False, "why": "nothing planned"}
        base_from_gripper = place_grasps(found.object_from_gripper.take(valid), pose.to_numpy())
        start = time.perf_counter()
        done = pick(cell, base_from_gripper, config=PickConfig(frames=0))
        more = {}
        if done.grasp is not None:
            chosen = valid[done.grasp]
            more = {name: float(getattr(found, name)[chosen]) for name in ("score", "width", "spare")}
        return line | {"possible": done.possible, "picking_s": time.perf_counter() - start} | done.as_json() | more


def list_jobs(study: str, only: list[int] | None, placements: int) -> list[tuple[int, int, str, str]]:
    """Object, seed, planner and physics of each pick."""
    objects = [obj_id for obj_id in OBJECTS if only is None or obj_id in only]
    if study == "true":
        usual = next(iter(PHYSICS))
        return [(o, 1000 * o + n, p, usual) for o in objects for n in range(placements) for p in PLANNERS]
    return [
        (o, 1000 * o + 500 + n, "antipodal", physics)
        for o in HEAVY
        if o in objects
        for physics in PHYSICS
        for n in range(PLACEMENTS)
    ]


def read_journal(path: Path) -> list[dict[str, Any]]:
    """The lines that are there."""
    return [parse(text) for text in read_lines(path, repair=True)] if path.is_file() else []


def write_page(path: Path, lines: dict[str, list[dict[str, Any]]]) -> None:
    """Tables of both studies."""
    every = [line for study in STUDIES for line in lines.get(study, [])]
    commits = ", ".join(sorted({line["commit"] for line in every}))
    device = describe_device()
    arms = ", ".join(sorted({line["arm"] for line in every}))
    text = [
        "# Picks in the simulated robot cell",
        "",
        f"Made by `python -m benchmarks.grasps`; do not edit by hand. Commit {commits}; arm: {arms}; "
        f"{device['device']}, {device['cores']} cores.",
        "",
        "YCB-V's scans with their real masses are let go on the table at random. Grasps are planned from the true",
        "pose and surface; the first that the arm can do is done: 10 cm straight to the object, close, lift by 20 cm,",
        "hold for 1 s. A success has risen by 10 cm and slipped by less than 2 cm in the hand. *Planned*: the planner",
        "found a grasp at all (an object may show no side under 8 cm); *possible*: the arm reaches one of them.",
        "",
    ]
    text += _table_true(lines.get("true", [])) + _table_physics(lines.get("physics", []))
    if lines.get("knowledge"):
        from benchmarks.grasp_knowledge import write_section
        from benchmarks.grasp_rule import report

        text += write_section(lines["knowledge"]) + report(lines["knowledge"], lines["drawn"])
    failed = [line for line in lines.get("true", []) if line["possible"] and not line["success"]]
    if failed:
        text += ["## Every failure of a possible grasp with the true pose", ""]
        text += [f"* {line['name']}, seed {line['seed']}, {line['planner']}: {line['why']}" for line in failed] + [""]
    write_text(path, "\n".join(text))


def _share(part: int, of: int) -> str:
    return f"{part}/{of}"


def _table_true(lines: list[dict[str, Any]]) -> list[str]:
    if not lines:
        return []
    groups: dict[tuple[str, str], list[dict[str, Any]]] = collections.defaultdict(list)
    for line in lines:
        groups[line["name"], line["planner"]].append(line)
        groups["all", line["planner"]].append(line)
    heads = [f"{p}: {what}" for p in PLANNERS for what in ("planned", "possible", "succeeded / possible")]
    text = ["## With the true pose", "", f"| object | placements | {' | '.join(heads)} |", "| --- |" + " ---: |" * 7]
    names = [name for name, _ in OBJECTS.values() if (name, "antipodal") in groups]
    for name in [*names, "all"]:
        cells = []
        for planner in PLANNERS:
            mine = groups[name, planner]
            possible = sum(line["possible"] for line in mine)
            cells += [str(sum(line["planned"] > 0 for line in mine)), str(possible)]
            cells.append(_share(sum(line["success"] for line in mine), possible))
        bold = "**" if name == "all" else ""
        text.append(f"| {bold}{name}{bold} | {len(groups[name, 'antipodal'])} | {' | '.join(cells)} |")
    done = [line for line in lines if line["possible"] and line["planner"] == "antipodal"]
    planning = np.median([line["planning_s"] for line in lines])
    picking = np.median([line["picking_s"] for line in done or [{"picking_s": 0.0}]])
    good = [line for line in done if line["success"]]
    if good:
        slip, turn = (np.array([line[key] for line in good]) for key in ("slip_mm", "turned_deg"))
        touched = sum(line["touched"] for line in done)
        text += [
            "",
            f"Antipodal successes slip by {np.median(slip):.1f} mm (median; the most {slip.max():.1f} mm) and turn by "
            f"{np.median(turn):.1f}° in the hand (the most {turn.max():.1f}°); the hand or a finger touched the object "
            f"before closing in {touched} of {len(done)}.",
            f"Planning takes {1e3 * planning:.0f} ms, a pick {picking:.1f} s (medians, as busy as the machine was).",
        ]
    return [*text, ""]


def _table_physics(lines: list[dict[str, Any]]) -> list[str]:
    if not lines:
        return []
    names = list(dict.fromkeys(line["name"] for line in lines))
    text = [
        "## What the physics is worth",
        "",
        f"{PLACEMENTS} placements of each, antipodal grasps: succeeded / possible.",
        "",
        f"| physics | {' | '.join(names)} |",
        "| --- |" + " ---: |" * len(names),
    ]
    for physics in PHYSICS:
        cells = []
        for name in names:
            mine = [line for line in lines if line["physics"] == physics and line["name"] == name]
            cells.append(_share(sum(x["success"] for x in mine), sum(x["possible"] for x in mine)))
        text.append(f"| {physics} | {' | '.join(cells)} |")
    return [*text, ""]


def run_by_pose(arguments: argparse.Namespace, dataset: Dataset, here: str) -> None:
    """The study with poses by ipjax, as far as it is not done."""
    from benchmarks.grasp_knowledge import KNOWLEDGE, Study, list_scanned
    from ipjax.files.weights.encoder import load_encoder

    study = Study(load_encoder(arguments.weights), arguments.output / "objects")
    path = arguments.output / "knowledge.jsonl"
    done = {(x["number"], x["seed"], x["knowledge"]) for x in read_journal(path)}
    subjects = list_scanned(dataset, arguments.objects, arguments.only)
    jobs = [(one, 70_000 + 100 * one.number + n) for n in range(TRIALS) for one in subjects]
    for subject, seed in bar(jobs, desc="knowledge", unit=" placements"):
        left = tuple(w for w in arguments.ways or KNOWLEDGE if (subject.number, seed, w) not in done)
        for line in study.run(subject, seed, left) if left else ():
            append_json(path, line | {"commit": here})


def main() -> None:
    """Do what is not done yet, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, metavar="FOLDER", help="YCB-V in BOP layout")
    parser.add_argument("--studies", nargs="+", choices=(*STUDIES, "knowledge"), default=list(STUDIES))
    parser.add_argument("--objects", type=Path, metavar="FOLDER", help="of scans onboarded already, obj_000001.ipjax")
    parser.add_argument("--ways", nargs="+", metavar="WAY", help="in which objects are known: scan, level3, rgbd, …")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="of the encoder, for poses by ipjax")
    parser.add_argument("--only", type=int, nargs="+", metavar="ID", help="objects")
    parser.add_argument("--placements", type=int, default=20, metavar="N", help="of the study with the true pose")
    parser.add_argument("--arm", default="auto", help="auto, panda or gantry")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/grasps"), metavar="FOLDER", help="of journals")
    parser.add_argument("--page", type=Path, metavar="MD", help="where the page goes")
    arguments = parser.parse_args()
    use_compilation_cache()
    arguments.output.mkdir(parents=True, exist_ok=True)
    bench, here = Bench(Dataset(arguments.dataset)), commit()
    if "knowledge" in arguments.studies:
        run_by_pose(arguments, bench.dataset, here)
    for study in (name for name in STUDIES if name in arguments.studies):
        path = arguments.output / f"{study}.jsonl"
        done = {(x["obj_id"], x["seed"], x["planner"], x["physics"]) for x in read_journal(path)}
        jobs = [job for job in list_jobs(study, arguments.only, arguments.placements) if job not in done]
        for obj_id, seed, planner, physics in bar(jobs, desc=study, unit=" picks"):
            about = {"obj_id": obj_id, "name": OBJECTS[obj_id][0], "seed": seed, "planner": planner, "physics": physics}
            line = bench.run(obj_id, seed, planner, arguments.arm, PHYSICS[physics])
            append_json(path, about | line | {"commit": here})
    if arguments.page is not None:
        names = (*STUDIES, "knowledge", "drawn")
        write_page(arguments.page, {s: read_journal(arguments.output / f"{s}.jsonl") for s in names})


if __name__ == "__main__":
    main()
