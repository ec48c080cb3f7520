"""What is scored: the targets of a data set, each with the annotated instances and the estimates that count.

Protocol: BOP 2019-2023 for 6D localisation and BOP 2024 for 6D detection; https://github.com/thodan/bop_toolkit
(pose_matching.py, eval_bop19_pose.py, eval_bop24_pose.py).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ipjax.bop.records import DatasetError, TargetRow, Truth, check_rotation
from ipjax.bop.results import ResultRow, read_results, sized_path
from ipjax.bop.scoring.conventions import suspect_conventions
from ipjax.bop.scoring.errors import Model, average_distances, farthest_distances, least_turns, stack, surface_errors
from ipjax.transforms import Similarity

YCBV_SYMMETRIC = frozenset({1, 13, 14, 16, 18, 19, 20, 21})  # ADD(-S) uses ADD-S for these (dataset_params.py)


@dataclass
class ScoredTarget:
    """One target: the instances of one object in one image, and the estimates that count."""

    row: TargetRow
    camera: np.ndarray
    width: int
    truths: list[Truth]
    valid: np.ndarray  # which truths count
    estimates: list[ResultRow]
    mssd: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # [e, g], and so on
    mspd: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    rotation: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    translation: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    least_turn: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    shift: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    add: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    add_s: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    sized_mssd: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    sized_add: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    vsd: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))  # [e, g, t]

    def pairs(self) -> Iterator[tuple[int, int]]:
        """The indices of every estimate with every ground truth."""
        return ((e, g) for e in range(len(self.estimates)) for g in range(len(self.truths)))


class Protocol:
    """One scoring of a result file: its targets, the data it has read, notes and problems."""

    def __init__(self, dataset, metrics, objects, delta, on_error, symmetric, progress, without=()):
        self.dataset, self.metrics, self.delta, self.on_error = dataset, metrics, delta, on_error
        self.problems: list[str] = []
        self.sized = False  # whether the size of every estimate is known
        self.source = "results"
        self._annotations: dict[tuple[int, int], tuple[np.ndarray, int, list[Truth]]] = {}
        self.notes: list[str] = []
        self.progress = progress
        chosen = None if objects is None else set(objects)
        self.targets = [t for t in dataset.targets if chosen is None or t.obj_id in chosen]
        if not self.targets:
            raise DatasetError(f"{dataset.targets_file}: there are no targets to score")
        self.without = sorted({(int(s), int(i)) for s, i in without})
        there = {(t.scene_id, t.im_id) for t in dataset.targets}
        for scene, image in self.without:
            if (scene, image) not in there:
                raise DatasetError(f"{dataset.targets_file}: scene {scene}, image {image} is no target image")
        self.infos = dataset.models()
        if symmetric is not None:
            self.symmetric = frozenset(symmetric)
        elif "ycbv" in dataset.name.lower():
            self.symmetric = YCBV_SYMMETRIC
        else:
            self.symmetric = frozenset(o for o, info in self.infos.items() if len(info.symmetries.scale) > 1)
        if "vsd" in metrics:
            bare = sorted({t.scene_id for t in self.targets if not dataset.has_depth(t.scene_id)})
            if bare:
                self.metrics = tuple(m for m in metrics if m != "vsd")
                self.notes.append(f"scored without VSD: no depth images in scene {bare[0]}")
        self.model = lru_cache(maxsize=64)(lambda obj_id: Model.load(dataset, obj_id))

    def annotations(self, scene_id: int, im_id: int) -> tuple[np.ndarray, int, list[Truth]]:
        """K, image width and instances of an image; the last few hundred are kept."""
        key = (scene_id, im_id)
        if key not in self._annotations:
            if len(self._annotations) > 2000:
                self._annotations.clear()
            width = self.dataset.image_size(*key)[0]
            self._annotations[key] = (self.dataset.camera(*key)[0], width, self.dataset.truths(*key))
        return self._annotations[key]

    def rows(self, results: str | Path | Sequence[ResultRow], scales: Sequence[float] | None = None) -> list[ResultRow]:
        """The rows, each a rotation, of an object and an image that exist; with the scales, where they are given."""
        skip = self.on_error == "skip"
        if isinstance(results, str | Path):
            source = self.source = str(results)
            rows = read_results(results, problems=self.problems if skip else None)
        else:
            source, rows = "results", list(results)
        if scales is not None:
            if len(scales) != len(rows):
                raise ValueError(f"{len(rows)} rows need as many scales, got {len(scales)}")
            rows = [replace(row, scale=float(scale)) for row, scale in zip(rows, scales, strict=True)]
        targeted = {(t.scene_id, t.im_id) for t in self.dataset.targets}
        there: dict[int, set[int]] = {}
        kept = []
        for number, row in enumerate(rows):
            where = f"{source}, line {row.line if row.line is not None else number + 2}"
            message = None
            if row.obj_id not in self.infos:
                message = f"{where}: the data set has no object {row.obj_id}"
            elif (row.scene_id, row.im_id) not in targeted:
                if row.scene_id not in there:
                    try:
                        there[row.scene_id] = set(self.dataset.images(row.scene_id))
                    except DatasetError:
                        there[row.scene_id] = set()
                if row.im_id not in there[row.scene_id]:
                    message = f"{where}: the data set has no image {row.im_id} in scene {row.scene_id}"
            if message is None:
                try:
                    check_rotation(row.rotation)
                except ValueError as error:
                    message = f"{where}: {error}"
            if message is None:
                kept.append(row)
            elif skip:
                self.problems.append(message)
            else:
                raise DatasetError(message)
        return kept

    def with_sizes(self, rows: list[ResultRow], results: Path, sizes: str | Path | bool) -> list[ResultRow]:
        """The rows with the scales that stand in a file of ours; each must be there. One that was merely found beside
        the results and belongs to others is left out, and the table says so."""
        looked_up = isinstance(sizes, bool)
        path = sized_path(results) if looked_up else Path(sizes)
        if looked_up and (not path.is_file() or all(row.scale is not None for row in rows)):
            return rows
        try:
            kept = {_identity(row): row.scale for row in read_results(path)}
        except DatasetError as error:
            if not looked_up:
                raise
            self.notes.append(f"{error}, so that sizes are left out")
            return rows
        for row in rows:
            if kept.get(_identity(row)) is None:
                message = f"{path}: it holds no size for line {row.line} of {results.name}"
                if not looked_up:
                    raise DatasetError(message)
                self.notes.append(f"{message}, so that sizes are left out")
                return rows
        return [replace(row, scale=kept[_identity(row)]) for row in rows]

    def check_conventions(self, targets: Sequence[ScoredTarget], rows: Sequence[ResultRow]) -> None:
        """Whole files that are in another unit, in other axes, or of other targets would score 0 without a hint."""
        asked = {(t.scene_id, t.im_id, t.obj_id) for t in self.dataset.targets}
        strays = sum((row.scene_id, row.im_id, row.obj_id) not in asked for row in rows)
        message = suspect_conventions(
            [
                (
                    row.camera_from_object,
                    [truth.camera_from_object for truth in target.truths],
                    self.infos[target.row.obj_id].symmetries.rotation,
                )
                for target in targets
                for row in target.estimates
            ]
        )
        if not rows:
            self.notes.append("there are no estimates, so that every target is a miss")
        if strays and strays == len(rows) and "ap" not in self.metrics:
            message = f"none of the {strays} estimates is of a target of {self.dataset.targets_file}"
        elif strays and "ap" not in self.metrics:
            self.notes.append(f"{strays} of {len(rows)} estimates are of no target and count for nothing")
        if message is None:
            return
        if self.on_error == "raise":
            raise DatasetError(f"{self.source}: {message}")
        self.problems.insert(0, f"{self.source}: {message}")
        self.notes.append(message)

    def collect(self, rows: list[ResultRow]) -> list[ScoredTarget]:
        """Each target of the data set with its ground truths and with the estimates that these rows give for it."""
        estimates: dict[tuple[int, int, int], list[ResultRow]] = {}
        for row in rows:
            estimates.setdefault((row.scene_id, row.im_id, row.obj_id), []).append(row)
        found = []
        for asked in self.targets:
            try:
                camera, width, truths = self.annotations(asked.scene_id, asked.im_id)
                truths = [t for t in truths if t.obj_id == asked.obj_id]
                if asked.obj_id not in self.infos:
                    raise DatasetError(f"{self.dataset.targets_file}: the models have no object {asked.obj_id}")
                if len(truths) < asked.count:
                    raise DatasetError(
                        f"{self.dataset.targets_file}: {asked.count} instances of object {asked.obj_id} in scene "
                        f"{asked.scene_id}, image {asked.im_id}, but {len(truths)} are annotated"
                    )
            except DatasetError as error:
                if self.on_error == "raise":
                    raise
                self.problems.append(str(error))
                continue
            best = np.argsort([-t.visible for t in truths], kind="stable")[: asked.count]
            valid = np.zeros(len(truths), bool)
            valid[best] = True
            mine = estimates.get((asked.scene_id, asked.im_id, asked.obj_id), [])
            mine = sorted(mine, key=lambda row: -row.score)[: asked.count]
            found.append(ScoredTarget(asked, camera, width, truths, valid, mine))
        return found

    def measure(self, obj_id: int, targets: list[ScoredTarget], metrics: Sequence[str]) -> None:
        """Fill in the errors of all estimates of one object."""
        pairs = [(target, e, g) for target in targets for e, g in target.pairs()]
        truths = stack([target.truths[g].camera_from_object for target, _, g in pairs])
        found = stack([target.estimates[e].camera_from_object for target, e, _ in pairs])
        model = self.model(obj_id)
        measured: dict[str, np.ndarray] = {}
        cameras = np.stack([s.camera for s, _, _ in pairs]) if pairs else np.zeros((0, 3, 3))
        surface = surface_errors(model, cameras, truths, found)
        width = np.array([s.width for s, _, _ in pairs], np.float64)
        measured["mssd"], measured["mspd"] = surface.mssd, surface.mspd * 640 / np.maximum(width, 1)
        measured["rotation"], measured["translation"] = surface.rotation, surface.translation
        measured["least_turn"], measured["shift"] = least_turns(model, truths, found)
        if {"add", "add_s"} & set(metrics):
            measured["add"] = average_distances(model, truths, found, nearest=False)
            measured["add_s"] = average_distances(model, truths, found, nearest=True)
        if self.sized:
            scales = np.array([target.estimates[e].scale for target, e, _ in pairs], np.float64)
            sized = Similarity(found.rotation, found.translation, scales)
            measured["sized_mssd"] = farthest_distances(model, truths, sized)
            nearest = obj_id in self.symmetric
            measured["sized_add"] = average_distances(model, truths, sized, nearest=nearest)
        place = {(id(target), e, g): row for row, (target, e, g) in enumerate(pairs)}
        for target in targets:
            shape = (len(target.estimates), len(target.truths))
            rows = [place[id(target), e, g] for e, g in target.pairs()]
            for name, values in measured.items():
                setattr(target, name, values[rows].reshape(*shape, *values.shape[1:]))


def _identity(row: ResultRow) -> tuple:
    """What distinguishes an estimate from others."""
    return row.scene_id, row.im_id, row.obj_id, row.score, row.rotation, row.translation
