"""What a grasp is worth by what is known of the object: a scan, poorer meshes, a photo; with poses that ipjax finds.

A trial is a placement in the simulated cell, seen by its fixed camera; the pose is estimated in the simulator's mask by
the fast preset, grasps are planned on what is known, and the first that the arm can do is done. The truth is compared
only afterwards: the pose, and every planned grasp by the planner's own test at the true pose, which needs no physics.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from benchmarks.pairs import rigid
from benchmarks.photo_pairs import camera_from_true_mesh
from ipjax import metrics
from ipjax.bop.dataset import Dataset
from ipjax.config import Config, OnboardConfig
from ipjax.files.meshes.mesh import Mesh, move, normalise
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.objects.loading import load
from ipjax.inference.estimator import Estimator
from ipjax.inference.reports import relative_pose
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.mesh import onboard
from ipjax.onboarding.photo import onboard_photo
from ipjax.records import PoseEstimate, Surface
from ipjax.robot.cell.camera import Sight, look
from ipjax.robot.cell.cell import Cell, make_cell
from ipjax.robot.cell.picking import PickConfig
from ipjax.robot.cell.trial import Trial, try_pick
from ipjax.robot.grasps.decision import grasp_deviation
from ipjax.robot.grasps.judging import check_grasps
from ipjax.robot.grasps.solid import make_solid
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Grasps, place_grasps
from ipjax.synthetic.degradation import degrade
from ipjax.synthetic.objects import make_object
from ipjax.transforms import Similarity, vector_from_rotation

KNOWLEDGE = ("scan", "level2", "level3", "level4", "rgbd", "rgb")
WORDS = {
    "scan": "scan",
    "level2": "mesh, level 2",
    "level3": "mesh, level 3",
    "level4": "mesh, level 4",
    "rgbd": "RGB-D photo",
    "rgb": "RGB photo",
}
SCANNED = {15: ("power drill", 0.895), 3: ("sugar box", 0.514), 5: ("mustard bottle", 0.603), 14: ("mug", 0.118)}
FEWER = OnboardConfig(directions=16, rolls=6)  # 96 templates, for all but scans whose files are there
PHOTO_SEED = 90_000  # plus the object's number: the cell in which its photo is taken
MADE = ("tee", "bottle", "wedge", "mug", "carton")  # kinds of made objects
_check = jax.jit(check_grasps)
_deviation = jax.jit(grasp_deviation)


@dataclasses.dataclass
class Subject:
    """An object, and what may be known of it."""

    number: int
    name: str
    mesh: Mesh  # metres
    mass: float | None  # kg
    arm: str = "auto"
    file: Path | None = None  # of the scan, onboarded already
    photo: tuple[Sight, Similarity[np.ndarray]] | None = None  # the frame, and camera_from_thing in it

    def take_photo(self) -> tuple[Sight, Similarity[np.ndarray]]:
        """A frame of another scene in which enough of it is seen."""
        for more in range(20):
            if self.photo is None:
                sight = look(self.make_cell(PHOTO_SEED + 1000 * more + self.number))
                if sight.masks[0].sum() > 1500:
                    self.photo = sight, sight.camera_from_object[0]
        if self.photo is None:
            raise ValueError(f"no photo shows enough of {self.name}")
        return self.photo

    def make_cell(self, seed: int) -> Cell:
        """With it alone."""
        return make_cell([self.mesh], seed, names=[self.name], masses=[self.mass], arm=self.arm)


class Onboarded:
    """One way to know a subject; ``found`` maps an estimate to the pose of the true mesh, metres."""

    def __init__(self, subject: Subject, knowledge: str, encoder: Any, folder: Path):
        self.knowledge, self.subject = knowledge, subject
        self.back: Similarity[np.ndarray] | None = None
        path = folder / f"{subject.name.replace(' ', '_')}_{knowledge}.ipjax"
        level = int(knowledge[-1]) if knowledge.startswith("level") else 0
        worse = None
        if level:
            worse, self.back = degrade(dataclasses.replace(subject.mesh, scale=1.0, centre=(0.0, 0.0, 0.0)), level)
        if knowledge == "scan" and subject.file is not None and subject.file.is_file():
            path = subject.file
        if path.is_file():
            self.templates, self.info = load(path, encoder)
        elif knowledge in ("rgb", "rgbd"):
            sight, _ = subject.take_photo()
            made = onboard_photo(
                Photo(sight.rgb),
                encoder,
                FEWER,
                mask=sight.masks[0],
                depth=sight.depth if knowledge == "rgbd" else None,
                camera=sight.camera,
                lrm="inflate",
                out=path,
                name=subject.name,
                progress=False,
            )
            self.templates, self.info = made.templates, made.info
        else:
            mesh = subject.mesh if worse is None else worse
            unit = None if level else 1.0
            plain = dataclasses.replace(mesh, scale=1.0, centre=(0.0, 0.0, 0.0))
            self.templates, self.info = onboard(
                plain, encoder, FEWER, name=subject.name, metres_per_unit=unit, out=path, progress=False
            )

    @property
    def diameter(self) -> float | None:
        """Metres, where it is known."""
        if self.knowledge == "scan" and self.info.metres_per_unit is not None:
            return self.info.metres_per_unit / self.info.mesh_scale
        return self.info.measured_diameter

    def found(self, camera_from_object: Similarity) -> Similarity[np.ndarray]:
        """``camera_from_thing`` as it was estimated, with the ratio of its size to the true one as its scale."""
        if self.knowledge in ("rgb", "rgbd"):
            there = self.subject.take_photo()[1]
            if self.info.measured_diameter is None:
                unit = 1 / there.translation[2]
                there = Similarity(there.rotation, unit * there.translation, np.asarray(unit))
            return relative_pose(camera_from_object, self.info) @ there
        pose = camera_from_true_mesh(camera_from_object, self.info, self.back)
        unit = self.info.metres_per_unit or 1.0
        return Similarity(pose.rotation, pose.translation, np.asarray(pose.scale / unit))


def compare(found: Similarity[np.ndarray], true: Similarity[np.ndarray], mesh: Mesh) -> dict[str, float]:
    """Of one pose of the true mesh: rotation, where its middle is, size, and ADD-S (at the true size), mm."""
    points = mesh.vertices[:: max(len(mesh.vertices) // 2000, 1)].astype(np.float64)
    middle = (points.min(0, keepdims=True) + points.max(0, keepdims=True)) / 2
    moved = (found @ middle - true @ middle)[0]
    # A wrong size about the camera's centre moves the mesh: it is taken out about the mesh's middle.
    plain = rigid(found.rotation, (found @ middle)[0] - found.rotation @ middle[0])
    tree = KDTree(points)
    turn = np.linalg.norm(vector_from_rotation(true.rotation.T @ found.rotation))
    return {
        "rotation_deg": float(np.degrees(turn)),
        "centre_mm": float(1e3 * np.linalg.norm(moved)),
        "size": float(found.scale) - 1,
        "add_s_mm": float(1e3 * metrics.add_s(points, true, plain, nearest=lambda x: tree.query(x)[0])),
    }


def describe_estimate(estimate: PoseEstimate) -> dict[str, Any]:
    """What an estimate tells of itself."""
    agreement = {
        field.name: float(getattr(estimate.agreement, field.name)) for field in dataclasses.fields(estimate.agreement)
    }
    covariance = np.asarray(estimate.covariance, np.float64)
    return {
        "confidence": float(estimate.confidence),
        "present": bool(estimate.present),
        "agreement": agreement,
        "pose_score": float(estimate.hypotheses.score[0]),
        "ambiguity_deg": float(np.degrees(np.linalg.norm(np.asarray(estimate.ambiguity)))),
        "turn_std_deg": float(np.degrees(np.sqrt(np.trace(covariance[:3, :3])))),
        "shift_std_mm": float(1e3 * np.sqrt(np.trace(covariance[3:, 3:]))),
        "size_std": float(estimate.scale_std / estimate.diameter),
    }


def describe_grasps(grasps: Grasps, estimate: PoseEstimate, holds: np.ndarray) -> dict[str, Any]:
    """Of every valid grasp what the planner tells, and whether it holds at the true pose."""
    off = _deviation(FRANKA_HAND, grasps, estimate)
    columns = {"score": grasps.score, "safe": grasps.safe, "spare": grasps.spare, "width": grasps.width, "off": off}
    return {key: [round(float(x), 5) for x in value] for key, value in columns.items()} | {
        "holds": [bool(x) for x in holds]
    }


def list_scanned(dataset: Dataset, objects: Path | None, only: list[int] | None) -> list[Subject]:
    """The scanned subjects; ``objects`` holds those onboarded already."""
    subjects = []
    for number, (name, mass) in SCANNED.items():
        if only is None or number in only:
            file = None if objects is None else objects / f"obj_{number:06d}.ipjax"
            subjects.append(Subject(number, name, dataset.mesh(number, "models"), mass, file=file))
    return subjects


def list_made() -> list[Subject]:
    """Made subjects, on which the rule is learned."""
    subjects = []
    for number, kind in enumerate(MADE):
        mesh = move(make_object(kind, 7000 + number), np.eye(3), scale=0.11 + 0.01 * (number % 5))
        subjects.append(Subject(100 + number, f"made {kind}", mesh, None))
    return subjects


class Study:
    """Trials of subjects, each in the ways in which it is known."""

    def __init__(self, encoder: Any, folder: Path, config: Config | None = None):
        self.encoder, self.folder = encoder, folder
        self.config = Config.fast() if config is None else config
        self.known: dict[tuple[int, str], Onboarded] = {}
        self.estimator = Estimator([], encoder, self.config, quick=True)  # compiles once for each shape of templates
        folder.mkdir(parents=True, exist_ok=True)

    def know(self, subject: Subject, knowledge: str) -> Onboarded:
        """Onboarded, or read again."""
        key = subject.number, knowledge
        if key not in self.known:
            self.known[key] = Onboarded(subject, knowledge, self.encoder, self.folder)
        return self.known[key]

    def run(self, subject: Subject, seed: int, wanted: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        """A line for each way of knowing it, in one placement."""
        cell = subject.make_cell(seed)
        sight = look(cell)
        unit = normalise(dataclasses.replace(subject.mesh, scale=1.0, centre=(0.0, 0.0, 0.0)))
        size = Similarity(np.eye(3), np.asarray(unit.centre, np.float64), np.asarray(1 / unit.scale))
        true_surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(unit, 2048, seed=0)))
        truth = sight.camera_from_object[0]
        for knowledge in wanted:
            line: dict[str, Any] = {"number": subject.number, "name": subject.name, "seed": seed}
            line |= {"knowledge": knowledge, "arm": cell.arm.name, "seen": int(sight.masks[0].sum())}
            known = self.know(subject, knowledge)
            estimate = self.estimate(known, sight, seed)
            if estimate is None or not bool(estimate.success):
                yield line | {"found": False, "planned": 0, "possible": False, "success": False}
                continue
            error = compare(known.found(estimate.camera_from_object), truth, subject.mesh)
            config = PickConfig(frames=0)
            trial = try_pick(cell, plain_surface(known, estimate), sight, estimate, seed=seed, config=config)
            line |= {"found": True, **describe_estimate(estimate), **error, "planned": trial.planned}
            line |= {"possible": trial.pick.possible, **trial.pick.as_json()}
            line["seconds"] = {name: round(value, 2) for name, value in trial.seconds.items()}
            if trial.planned:
                holds = hold_at(trial, true_surface, truth @ size)
                line["grasps"] = describe_grasps(trial.grasps, estimate, holds)
            yield line

    def estimate(self, known: Onboarded, sight: Sight, seed: int) -> PoseEstimate | None:
        """In the simulator's mask; None where the frame is refused."""
        estimator = self.estimator
        estimator.objects, estimator._compacted = [(known.templates, known.info)], {}
        try:
            crop = estimator.frame(0, sight.rgb, sight.depth, sight.masks[0], sight.matrix)
        except ValueError:
            return None
        return estimator.run(0, *crop, seed=seed, diameter=known.diameter).estimate


def plain_surface(known: Onboarded, estimate: PoseEstimate) -> Surface:
    """What the planner would make of the templates, without them: one compiled planner serves all."""
    solid = make_solid(known.templates, estimate)
    points = solid.points / estimate.camera_from_object.scale
    return dataclasses.replace(known.templates.surface, points=points, normals=solid.normals)


def hold_at(trial: Trial, surface: Surface, camera_from_object: Similarity[np.ndarray]) -> np.ndarray:
    """Whether each planned grasp holds at the true pose, by the planner's own test."""
    camera_from_gripper = place_grasps(trial.grasps.object_from_gripper.to_numpy(), trial.camera_from_object)
    count = len(trial.grasps.score)
    rows = np.arange(32) % count  # of one size: one program
    filled = camera_from_gripper.take(rows).to_jax()
    return np.asarray(_check(FRANKA_HAND, surface, camera_from_object.to_jax(), filled))[:count]


def write_section(lines: list[dict[str, Any]]) -> list[str]:
    """Tables of the study: by what is known, by the error of the pose, and by confidence."""
    if not lines:
        return []
    templates = FEWER.directions * FEWER.rolls
    placements = len({(line["number"], line["seed"]) for line in lines})
    commits = ", ".join(sorted({line["commit"] for line in lines}))
    text = [
        "## With poses by ipjax",
        "",
        f"Made by `python -m benchmarks.grasps --studies knowledge`, commit {commits}.",
        f"{placements} placements; the pose is estimated from the fixed camera's RGB-D frame with a real one's noise,",
        "in the simulator's mask, by the fast preset; grasps are planned on what is known, with the estimate's",
        "uncertainty. Scans have 400 templates and their true size. Degraded meshes (`ipjax degrade`) and objects",
        f"from a photo have {templates} templates, and no size but the RGB-D photo's; the photo, a frame of another",
        "scene in the same cell, is made a mesh by inflation. Scans are flattered: the camera draws the very texture.",
        "Errors are medians: of the rotation, of the middle, and ADD-S, which a mirrored half does not show.",
        "",
        "| known from | object | placements | planned | possible | picked | rotation | middle, mm | ADD-S, mm | "
        "confidence |",
        "| --- | --- |" + " ---: |" * 8,
    ]
    for knowledge in KNOWLEDGE:
        mine = [line for line in lines if line["knowledge"] == knowledge]
        names = list(dict.fromkeys(line["name"] for line in mine))
        for name in [*names, *(["all"] if len(names) > 1 else [])]:
            text.append(_row(WORDS[knowledge], name, [x for x in mine if name in ("all", x["name"])]))
    text += ["", "Success against the pose's error and against its confidence, of picks that were possible:", ""]
    text += _bins(lines, "ADD-S", "add_s_mm", (0, 2, 4, 8, 16, np.inf), " mm")
    text += _bins(lines, "confidence", "confidence", (0, 0.5, 0.9, 0.98, 1.001), "")
    failed = [line for line in lines if line.get("possible") and not line["success"]]
    if failed:
        text += ["Every failure of a possible grasp:", ""]
        for line in failed:
            known, off = WORDS[line["knowledge"]], f"{line['rotation_deg']:.0f}° and {line['centre_mm']:.0f} mm off"
            text.append(f"* {line['name']}, {known}, seed {line['seed']}, {off}: {line['why']}")
        text.append("")
    return text


def _row(known: str, name: str, mine: list[dict[str, Any]]) -> str:
    found = [line for line in mine if line["found"]]
    median = lambda key, digits: f"{np.median([line[key] for line in found]):.{digits}f}" if found else ""
    possible = sum(line["possible"] for line in mine)
    counts = f"{len(mine)} | {sum(line['planned'] > 0 for line in mine)} | {possible}"
    picked = f"{sum(line['success'] for line in mine)}/{possible}"
    bold = f"**{name}**" if name == "all" else name
    errors = f"{median('rotation_deg', 1)}° | {median('centre_mm', 1)} | {median('add_s_mm', 1)}"
    return f"| {known} | {bold} | {counts} | {picked} | {errors} | {median('confidence', 2)} |"


def _bins(lines: list[dict[str, Any]], what: str, key: str, edges: tuple[float, ...], unit: str) -> list[str]:
    done = [line for line in lines if line.get("possible")]
    heads, cells = [], []
    for low, high in itertools.pairwise(edges):
        mine = [line for line in done if low <= line[key] < high]
        heads.append(f"above {low:g}{unit}" if high == edges[-1] else f"{low:g} to {high:g}{unit}")
        cells.append(f"{sum(line['success'] for line in mine)}/{len(mine)}")
    return [
        f"| {what} | {' | '.join(heads)} |",
        "| --- |" + " ---: |" * len(heads),
        f"| picked | {' | '.join(cells)} |",
        "",
    ]
