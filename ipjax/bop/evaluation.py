"""Scoring result files as the BOP challenges do, and running an estimator over a data set so that it can be resumed.

Protocol: BOP 2019-2023 for 6D localisation (average recall) and BOP 2024 for 6D detection (average precision);
https://github.com/thodan/bop_toolkit (pose_matching.py, score.py, eval_bop19_pose.py, eval_bop24_pose.py). A missing
estimate is a miss, and a recall is a share of all instances of the data set, not a mean over its objects.

The errors are found in float32 (`ipjax.metrics`, exact branch and bound over symmetries and vertices), then measured
again in float64 at the symmetry that was found, so that thresholds fall as they do in the toolkit.
"""

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ipjax import metrics as errors
from ipjax.bop.dataset import (
    MM,
    VISIBLE,
    Dataset,
    DatasetError,
    Detection,
    Estimate,
    Frame,
    ResultRow,
    Target,
    TargetRow,
    Truth,
    as_row,
    check_rotation,
    detected_targets,
    read_results,
    sized_path,
    write_results,
)
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.storage.locks import locked
from ipjax.files.storage.parsing import parse_json, read_json
from ipjax.files.storage.writing import write_text
from ipjax.progress import bar
from ipjax.records import Camera, Similarity

METRICS = ("mssd", "mspd", "vsd", "add", "add_s", "ap")
YCBV_SYMMETRIC = frozenset({1, 13, 14, 16, 18, 19, 20, 21})  # ADD(-S) uses ADD-S for these (dataset_params.py)
DELTA = 0.015  # metres: VSD's visibility tolerance
# Targets below which no AUC is told: the toolbox's curve takes its higher value, so one target under 10 cm is 1.
FEW = 10
LISTED = 20  # images that failed and are told with their reason
DETECTIONS = 100  # estimates per image that count for average precision (BOP 2024)
SIZED = {"mssd": "MSSD", "add_or_s": "ADD(-S)"} | {
    f"size_{round(100 * x)}": f"size to {100 * x:g} %" for x in errors.SIZE_TOLERANCES.tolist()
}  # recalls of poses with their size
BATCH = 64  # pairs of poses per call
DRAWN = 48_000_000  # pixels drawn by one process for VSD; seven bytes each
Estimator = Callable[[Frame, list[Target]], list[Estimate]]


# Alignment of reconstructed meshes


@dataclass(frozen=True)
class Alignment:
    """``model_from_mesh``: from a reconstructed mesh's frame to the annotated model's.

    For evaluation only: it is fitted to the model, which the method has not seen.
    """

    scale: float  # metres per unit of the mesh
    rotation: np.ndarray  # 3 × 3
    translation: np.ndarray  # 3, metres
    source: str = ""

    def apply(self, estimate: Estimate) -> Estimate:
        """The estimate of a mesh's pose (scale in metres per unit of the mesh) as one of the model's pose; its scale
        becomes a ratio, 1 where the estimated size is that of the alignment."""
        ratio = estimate.scale / self.scale
        rotation = np.asarray(estimate.rotation, np.float64) @ self.rotation.T
        translation = np.asarray(estimate.translation_m, np.float64) - ratio * rotation @ self.translation
        return Estimate(estimate.obj_id, estimate.score, rotation, translation, ratio)


def read_alignment(path: str | Path) -> Alignment:
    """An alignment file: JSON with ``scale``, ``R`` (3 × 3), ``t``; x_model [mm] = scale · R x_mesh + t."""
    path = Path(path)
    try:
        entry = read_json(path)
        scale, R, t = float(entry["scale"]), np.asarray(entry["R"], np.float64), np.asarray(entry["t"], np.float64)
        R, t = R.reshape(3, 3), t.reshape(3)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: an alignment is JSON with scale, R (3 × 3) and t (3) ({error})") from None
    if not (0 < scale < math.inf and np.isfinite(R).all() and np.isfinite(t).all()):
        raise DatasetError(f"{path}: the scale must be positive, R and t finite")
    try:
        check_rotation(R)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from None
    return Alignment(scale * MM, R, t * MM, path.name)


# Protocol


def match_poses(
    pose_errors: Float[np.ndarray, "e g"],
    scores: Float[np.ndarray, "e"],
    threshold: float,
    valid: np.ndarray | None = None,
) -> np.ndarray:
    """Which ground truth [e] each estimate gets at a threshold, −1 = none: greedily by falling score, one to one, the
    smallest error below the threshold (strictly) among valid truths that are still free (pose_matching.py:9-92)."""
    count, truths = pose_errors.shape
    matched = np.full(count, -1)
    free = np.ones(truths, bool) if valid is None else np.asarray(valid, bool).copy()
    for index in np.argsort(-np.asarray(scores), kind="stable"):
        candidates = np.where(free & (pose_errors[index] < threshold), pose_errors[index], np.inf)
        if truths and np.isfinite(candidates.min()):
            best = int(np.argmin(candidates))
            matched[index] = best
            free[best] = False
    return matched


def average_precision(scores: np.ndarray, correct: np.ndarray, count: int) -> float:
    """Precision interpolated at 101 recalls, averaged (COCO's form; score.py:12-53). ``count`` = all true instances."""
    if count == 0 or len(scores) == 0:
        return 0.0
    hits = np.cumsum(np.asarray(correct, bool)[np.argsort(-np.asarray(scores), kind="stable")])
    recall = hits / count
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    at = np.searchsorted(recall, np.linspace(0, 1, 101), side="left")
    return float(np.where(at < len(precision), precision[np.minimum(at, len(precision) - 1)], 0.0).mean())


def area_under_accuracy(values: np.ndarray, limit: float = errors.ADD_LIMIT) -> float:
    """`metrics.area_under_accuracy` for NumPy arrays."""
    return float(errors.area_under_accuracy(jnp.asarray(np.asarray(values, np.float32)), limit))


# Errors of many poses of one object


@dataclass(frozen=True)
class Model:
    """What scoring needs of an object, in metres."""

    points: np.ndarray  # [n, 3] float64
    diameter: float
    rotations: np.ndarray  # symmetries [s, 3, 3]
    translations: np.ndarray  # [s, 3]

    @property
    def symmetries(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations and translations."""
        return self.rotations, self.translations

    @staticmethod
    def load(dataset: Dataset, obj_id: int) -> "Model":
        """From the data set's ``models_eval``."""
        info = dataset.models()[obj_id]
        points = np.asarray(dataset.mesh(obj_id).vertices, np.float64)
        return Model(points, info.diameter, info.symmetry_rotations, info.symmetry_translations)


@dataclass(frozen=True)
class Pose:
    """A rigid ``camera_from_object``, metres, float64."""

    rotation: np.ndarray
    translation: np.ndarray


@dataclass(frozen=True)
class SurfaceErrors:
    """Errors of v pairs of poses; infinite where the benchmark's pre-checks say so."""

    mssd: np.ndarray  # metres
    mspd: np.ndarray  # pixels
    rotation: np.ndarray  # radians, to the symmetry that attains MSSD
    translation: np.ndarray  # metres, likewise


def sized_distances(
    model: Model, truths: Sequence[Pose], estimates: Sequence[Pose], scales: np.ndarray, *, nearest: bool
) -> tuple[np.ndarray, np.ndarray]:
    """`metrics.sized_errors` in float64 for pairs of poses: MSSD, and ADD (with ``nearest`` ADD-S), in metres, of the
    model at its estimated size (``scales``, estimated over true)."""
    from scipy.spatial import KDTree

    hull = _hull(model.points)
    mssd, mean = np.zeros(len(truths)), np.zeros(len(truths))
    tree = KDTree(model.points) if nearest and len(truths) else None
    constant = [jnp.asarray(x, jnp.float32) for x in (_padded(hull), *_padded_symmetries(*model.symmetries))]
    for row, (truth, estimate, scale) in enumerate(zip(truths, estimates, scales, strict=True)):
        R_e, shift = scale * estimate.rotation, truth.translation - estimate.translation
        pose = [truth.rotation, truth.translation, estimate.rotation, estimate.translation, scale]
        best = 0 if len(model.rotations) == 1 else int(_choose_sized(*constant, *(np.float32(x) for x in pose)))
        R_s, t_s = _symmetric(model, truth.rotation, truth.translation, best)
        mssd[row] = np.linalg.norm(hull @ (R_e - R_s).T + (estimate.translation - t_s), axis=-1).max()
        moved = model.points @ (truth.rotation - R_e).T + shift
        if tree is None:
            mean[row] = np.linalg.norm(moved, axis=-1).mean()
        else:  # in the estimate's frame, where the model is what the tree holds; equal poses give exactly x
            mean[row] = scale * tree.query(model.points + moved @ estimate.rotation / scale, workers=-1)[0].mean()
    return mssd, mean


@jax.jit
def _choose_sized(hull, rotations, translations, R_g, t_g, R_e, t_e, scale):
    """The symmetry that attains MSSD of the model at its estimated size."""
    one = jnp.ones((), hull.dtype)
    symmetries = Similarity(rotations, translations, jnp.ones(len(rotations), hull.dtype))
    return errors.closest_symmetry(hull, symmetries, Similarity(R_g, t_g, one), Similarity(R_e, t_e, scale))[1]


def surface_errors(
    model: Model, cameras: np.ndarray, truths: Sequence[Pose], estimates: Sequence[Pose]
) -> SurfaceErrors:
    """MSSD, MSPD and the symmetry-aware rotation and translation errors of pairs of poses; ``cameras`` [v, 3, 3] are K.

    Memory is bounded whatever the number of pairs, symmetries and vertices.
    """
    count = len(truths)
    found = SurfaceErrors(*(np.zeros(count) for _ in range(4)))
    if count == 0:
        return found
    hull = _hull(model.points)
    R_g, t_g = np.stack([p.rotation for p in truths]), np.stack([p.translation for p in truths])
    R_e, t_e = np.stack([p.rotation for p in estimates]), np.stack([p.translation for p in estimates])
    focal = np.stack([cameras[:, 0, 0], cameras[:, 1, 1]], axis=-1)
    shape = (_padded(hull), _padded(model.points), *_padded_symmetries(model.rotations, model.translations))
    constant = [jnp.asarray(x, jnp.float32) for x in shape]
    for start in range(0, count, BATCH):
        rows = np.minimum(np.arange(start, start + BATCH), count - 1)
        poses = [jnp.asarray(x[rows], jnp.float32) for x in (R_g, t_g, R_e, t_e, focal)]
        chosen = [np.asarray(x) for x in _choose_symmetries(*constant, *poses, min(count - start, BATCH))]
        for slot, row in enumerate(rows[: count - start]):
            moved = [_symmetric(model, R_g[row], t_g[row], int(chosen[k][slot])) for k in (0, 1)]
            (R_s, t_s), (R_p, t_p) = moved
            found.mssd[row] = np.sqrt((((hull @ (R_e[row] - R_s).T) + (t_e[row] - t_s)) ** 2).sum(-1).max())
            seen, drawn = (_project(model.points @ R.T + t, focal[row]) for R, t in ((R_p, t_p), (R_e[row], t_e[row])))
            found.mspd[row] = np.sqrt(((seen - drawn) ** 2).sum(-1).max())
            found.rotation[row] = _angle(R_s, R_e[row])
            found.translation[row] = np.linalg.norm(t_s - t_e[row])
    found.mssd[np.linalg.norm(t_g - t_e, axis=-1) >= model.diameter] = np.inf
    return found


@jax.jit
def _choose_symmetries(hull, points, rotations, translations, R_g, t_g, R_e, t_e, focal, count):
    """The symmetry that attains MSSD, and the one that attains MSPD, for a batch of pairs, one after the other."""
    one = jnp.ones((), hull.dtype)
    symmetries = Similarity(rotations, translations, jnp.ones(len(rotations), hull.dtype))

    def choose(row, chosen):
        truth, estimate = Similarity(R_g[row], t_g[row], one), Similarity(R_e[row], t_e[row], one)
        camera = Camera(focal[row], jnp.zeros_like(focal[row]))
        _, surface = errors.closest_symmetry(hull, symmetries, truth, estimate)
        _, image = errors.closest_symmetry(points, symmetries, truth, estimate, camera=camera)
        return chosen[0].at[row].set(surface), chosen[1].at[row].set(image)

    nothing = jnp.zeros(len(R_g), jnp.int32)
    return jax.lax.fori_loop(0, count, choose, (nothing, nothing))


def average_distances(
    model: Model, truths: Sequence[Pose], estimates: Sequence[Pose], *, nearest: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """ADD and ADD-S in metres of pairs of poses, float64; infinite where the origins are a diameter apart, as in BOP.

    ADD-S asks one k-d tree of the model, with the true vertices moved to the estimate's frame. Without ``nearest`` it
    is left out (NaN).
    """
    from scipy.spatial import KDTree

    tree = KDTree(model.points) if nearest and len(truths) else None
    add, add_s = np.full(len(truths), np.inf), np.full(len(truths), np.inf if nearest else np.nan)
    for row, (truth, estimate) in enumerate(zip(truths, estimates, strict=True)):
        shift = truth.translation - estimate.translation
        if np.linalg.norm(shift) >= model.diameter:
            continue
        moved = model.points @ (truth.rotation - estimate.rotation).T + shift
        add[row] = np.linalg.norm(moved, axis=-1).mean()
        if tree is not None:
            # Rᵀ(R_g x + t_g − t_e), written so that equal poses give exactly x.
            inside = model.points + (moved @ estimate.rotation)
            add_s[row] = tree.query(inside, workers=-1)[0].mean()
    return add, add_s


def render_depths(
    mesh: Mesh | Sequence[Mesh],
    poses: Sequence[Pose],
    cameras: np.ndarray,
    height: int,
    width: int,
    *,
    which: Sequence[int] | None = None,
    corner: float = 0.5,
) -> Float[np.ndarray, "v h w"]:
    """Depth images, metres along z, of a mesh alone at each pose, with K [v, 3, 3]; of several meshes, ``which`` says
    for each image the one that it shows.

    ``corner`` is where the centre of the first pixel lies in K's coordinates: ½ is what the renderers of BOP's toolkit
    do (OpenGL), and the default, because the benchmark's VSD is defined by them; 0 is what K means. VSD's distances
    use integer pixel coordinates in either case, as the toolkit's do.
    """
    from ipjax.rendering.render import render_each

    meshes = [mesh] if isinstance(mesh, Mesh) else list(mesh)
    which = [0] * len(poses) if which is None else which
    rotation = jnp.asarray(np.stack([p.rotation for p in poses]), jnp.float32)
    translation = jnp.asarray(np.stack([p.translation for p in poses]), jnp.float32)
    focal = jnp.asarray(np.stack([cameras[:, 0, 0], cameras[:, 1, 1]], -1), jnp.float32)
    centre = jnp.asarray(cameras[:, :2, 2] - corner, jnp.float32)
    pose = Similarity(rotation, translation, jnp.ones(len(poses), jnp.float32))
    # Colours are of no use here, and textures take time to load.
    plain = [replace(m, texture=None, uv=None) for m in meshes]
    return np.asarray(render_each(plain, which, pose, Camera(focal, centre), height, width).depth, np.float32)


@jax.jit
def _vsd(depth_seen, depth_truth, focal, centre, depth_estimate, diameter, delta):
    camera = Camera(focal, centre)
    return errors.vsd(depth_seen, depth_truth, camera, depth_estimate, diameter=diameter, delta=delta)


# Scores


@dataclass(frozen=True)
class Instance:
    """How well one annotated instance was found; errors are infinite where nothing was."""

    scene_id: int
    im_id: int
    obj_id: int
    index: int  # of the annotation in its image
    found: bool
    score: float
    mssd: float  # metres
    mspd: float  # pixels, for an image 640 wide
    vsd: float  # mean over tolerances; NaN where it was not asked for
    add: float
    add_s: float
    rotation: float  # radians, symmetry-aware
    translation: float  # metres
    scale: float  # |estimated / true − 1|; NaN where the scale is unknown
    sized_mssd: float = math.nan  # metres, with the model at its estimated size; NaN likewise
    sized_add: float = math.nan  # likewise; ADD-S for objects with symmetries


@dataclass(frozen=True)
class Summary:
    """Recalls over a set of images."""

    images: int
    targets: int
    recalls: dict[
        str, float
    ]  # average recall by metric; "ar" is the mean of MSSD's, MSPD's and VSD's, if all are there
    intervals: dict[str, tuple[float, float]]  # 95 % bootstrap over images
    # Where the estimates' sizes are known: average recalls "mssd" and "add_or_s" of the model at its estimated size, in
    # true diameters, and the shares of targets whose size is right to 2, 5 and 10 %; their intervals. Else empty.
    sized: dict[str, float] = field(default_factory=dict)
    sized_intervals: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Score:
    """What a result file is worth on a data set."""

    dataset: str
    method: str
    metrics: tuple[str, ...]
    all_frames: Summary
    one_frame_per_scene: Summary  # the first target image of each scene
    without: dict[str, Summary]  # the same two, by title, without the images that the caller doubts; or empty
    curves: dict[str, list[float]]  # recall at each threshold
    objects: dict[int, dict[str, float]]  # average recalls (and others) by object
    medians: dict[str, float]  # rotation_deg, translation_mm, scale_percent over the instances that got an estimate
    missing: int  # instances without an estimate
    add: dict[str, float]  # add_auc, add_s_auc, add_or_s_auc, recall_01d, add_s_01d; empty unless asked for
    precision: dict[str, float]  # ap_mssd, ap_mspd, map; empty unless asked for
    seconds_per_image: float | None
    notes: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    against: dict[str, Any] | None = None  # the second result file: method, objects, wins, ties, losses
    instances: tuple[Instance, ...] = field(default=(), repr=False)

    def to_dict(self, *, instances: bool = True) -> dict[str, Any]:
        """Plain numbers and text; what is not finite becomes None (JSON has no infinity)."""
        from dataclasses import asdict

        record = asdict(self)
        if not instances:
            del record["instances"]
        return _finite(record)

    def write_json(self, path: str | Path) -> Path:
        """The whole score, with every instance, as JSON."""
        return write_text(path, json.dumps(self.to_dict(), indent=1), parents=True)

    def parts(self) -> dict[str, Summary]:
        """Recalls by title, the headline first."""
        return {"one frame per scene": self.one_frame_per_scene, "all frames": self.all_frames, **self.without}

    def table(self) -> str:
        """What a person wants to see, as text."""
        return _table(self)


def score(
    results: str | Path | Sequence[ResultRow],
    dataset: Dataset,
    metrics: Sequence[str] = ("mssd", "mspd", "vsd"),
    *,
    objects: Iterable[int] | None = None,
    against: "str | Path | Sequence[ResultRow] | Score | None" = None,
    alignments: Mapping[int, Alignment] | None = None,
    scales: Sequence[float] | None = None,
    sizes: str | Path | bool = True,
    symmetric: Iterable[int] | None = None,
    delta: float = DELTA,
    on_error: Literal["raise", "skip"] = "raise",
    samples: int = 2000,
    seed: int = 0,
    method: str | None = None,
    notes: Sequence[str] = (),
    progress: bool = False,
    without: Iterable[tuple[int, int]] = (),
) -> Score:
    """Score estimates on the targets of a data set.

    Args:
        results: a BOP result file, or its rows.
        metrics: of "mssd", "mspd", "vsd", "add", "add_s", "ap". VSD renders; without depth images it is left out, and
            the table says so.
        objects: only the targets of these objects.
        against: a second result file, for wins by object.
        alignments: for objects whose rows give the pose of a reconstructed mesh, scaled to its true size, in the mesh's
            own frame: the evaluation-only similarity to the annotated model. The table says that it was used.
        scales: the estimated scale (estimated over true size) of each row; a BOP file cannot hold it. With sizes, the
            score has `Summary.sized`, which BOP's figures cannot see.
        sizes: the file with the sizes of a result file, as `evaluate` writes it; True: the one beside it, if there is
            one (``.sized``); False: none.
        symmetric: objects for which ADD(-S) is ADD-S; default: YCB-V's list, or those with symmetries.
        delta: VSD's visibility tolerance, metres (ITODD: 0.005).
        on_error: "raise" stops at the first damaged file or row; "skip" goes on and lists them in ``problems``.
        samples, seed: of the bootstrap.
        without: images (scene, image) of doubtful annotation; the table has the recalls with and without them.

    Raises DatasetError, one sentence with file and line, for damaged results or data; ValueError for unknown metrics.
    """
    unknown = set(metrics) - set(METRICS)
    if unknown:
        raise ValueError(f"unknown metric {sorted(unknown)[0]!r}; choose from {', '.join(METRICS)}")
    job = _Job(dataset, tuple(metrics), objects, delta, on_error, symmetric, progress, without)
    job.notes += notes
    method = method or (Path(results).stem if isinstance(results, str | Path) else "results")
    rows = job.rows(results, scales)
    if isinstance(results, str | Path) and scales is None and sizes is not False:
        rows = job.with_sizes(rows, Path(results), sizes)
    if alignments:
        rows = [_aligned(row, alignments.get(row.obj_id)) for row in rows]
        job.notes += _alignment_notes(alignments)
    found = job.score(rows, method, samples, seed)
    if against is None:
        return found
    if not isinstance(against, Score):
        name = Path(against).stem if isinstance(against, str | Path) else "the other"
        against = score(
            against,
            dataset,
            [m for m in found.metrics if m in ("mssd", "mspd", "vsd")],
            objects=objects,
            delta=delta,
            on_error=on_error,
            samples=0,
            sizes=False,
            method=name,
            progress=progress,
        )
    return _compare(found, against)


def _alignment_notes(alignments: Mapping[int, Alignment]) -> list[str]:
    by_source: dict[str, list[int]] = {}
    for obj_id, alignment in sorted(alignments.items()):
        by_source.setdefault(alignment.source or "an alignment", []).append(obj_id)
    return [
        f"object{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}: another mesh than the model, moved "
        f"to the model's frame by {source} (for evaluation only; the method does not see it)"
        for source, numbers in by_source.items()
    ]


def _compare(found: Score, other: Score) -> Score:
    shared = sorted(set(found.objects) & set(other.objects))
    key = "ar" if all("ar" in s.objects[o] for s in (found, other) for o in shared) else found.metrics[0]
    gains = [found.objects[o][key] - other.objects[o][key] for o in shared]
    comparison = {
        "method": other.method,
        "metric": key,
        "recalls": other.all_frames.recalls,
        "objects": {o: other.objects[o] for o in shared},
        "wins": sum(g > 0 for g in gains),
        "ties": sum(g == 0 for g in gains),
        "losses": sum(g < 0 for g in gains),
    }
    return replace(found, against=comparison)


@dataclass
class _Slot:
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
    add: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    add_s: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    sized_mssd: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    sized_add: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    vsd: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))  # [e, g, t]

    def pairs(self) -> Iterator[tuple[int, int]]:
        return ((e, g) for e in range(len(self.estimates)) for g in range(len(self.truths)))


class _Job:
    """One run of `score`: what is asked for, what has been read, what went wrong."""

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
            self.symmetric = frozenset(o for o, info in self.infos.items() if len(info.symmetry_rotations) > 1)
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
        beside = isinstance(sizes, bool)
        path = sized_path(results) if beside else Path(sizes)
        if beside and (not path.is_file() or all(row.scale is not None for row in rows)):
            return rows
        try:
            kept = {_identity(row): row.scale for row in read_results(path)}
        except DatasetError as error:
            if not beside:
                raise
            self.notes.append(f"{error}, so that sizes are left out")
            return rows
        for row in rows:
            if kept.get(_identity(row)) is None:
                message = f"{path}: it holds no size for line {row.line} of {results.name}"
                if not beside:
                    raise DatasetError(message)
                self.notes.append(f"{message}, so that sizes are left out")
                return rows
        return [replace(row, scale=kept[_identity(row)]) for row in rows]

    def check_conventions(self, slots: list[_Slot], rows: list[ResultRow]) -> None:
        """Whole files that are in another unit, in other axes, or of other targets would score 0 without a hint."""
        targets = {(t.scene_id, t.im_id, t.obj_id) for t in self.dataset.targets}
        strays = sum((row.scene_id, row.im_id, row.obj_id) not in targets for row in rows)
        message = _suspect_conventions(
            [
                (
                    _pose(row),
                    [Pose(t.rotation, t.translation) for t in slot.truths],
                    self.infos[slot.row.obj_id].symmetry_rotations,
                )
                for slot in slots
                for row in slot.estimates
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

    def score(self, rows, method, samples, seed) -> Score:
        slots = self.slots(rows)
        self.check_conventions(slots, rows)
        estimates = [row for slot in slots for row in slot.estimates]
        self.sized = bool(estimates) and all(row.scale is not None for row in estimates)
        if not self.sized and any(row.scale is not None for row in estimates):
            self.notes.append("some estimates have no size, so that sizes are left out")
        by_object: dict[int, list[_Slot]] = {}
        for slot in slots:
            by_object.setdefault(slot.row.obj_id, []).append(slot)
        for obj_id, mine in _bar(sorted(by_object.items()), self.progress, "objects"):
            self.measure(obj_id, mine, self.metrics)
        if "vsd" in self.metrics:
            self.discrepancies(slots)
        precision = self.precision(rows) if "ap" in self.metrics else {}
        return _summarise(self, slots, rows, precision, method, samples, seed)

    def slots(self, rows: list[ResultRow]) -> list[_Slot]:
        estimates: dict[tuple[int, int, int], list[ResultRow]] = {}
        for row in rows:
            estimates.setdefault((row.scene_id, row.im_id, row.obj_id), []).append(row)
        found = []
        for target in self.targets:
            try:
                camera, width, truths = self.annotations(target.scene_id, target.im_id)
                truths = [t for t in truths if t.obj_id == target.obj_id]
                if target.obj_id not in self.infos:
                    raise DatasetError(f"{self.dataset.targets_file}: the models have no object {target.obj_id}")
                if len(truths) < target.count:
                    raise DatasetError(
                        f"{self.dataset.targets_file}: {target.count} instances of object {target.obj_id} in scene "
                        f"{target.scene_id}, image {target.im_id}, but {len(truths)} are annotated"
                    )
            except DatasetError as error:
                if self.on_error == "raise":
                    raise
                self.problems.append(str(error))
                continue
            best = np.argsort([-t.visible for t in truths], kind="stable")[: target.count]
            valid = np.zeros(len(truths), bool)
            valid[best] = True
            mine = estimates.get((target.scene_id, target.im_id, target.obj_id), [])
            mine = sorted(mine, key=lambda row: -row.score)[: target.count]
            found.append(_Slot(target, camera, width, truths, valid, mine))
        return found

    def measure(self, obj_id: int, slots: list[_Slot], metrics: Sequence[str]) -> None:
        """Fill in the errors of all estimates of one object."""
        pairs = [(slot, e, g) for slot in slots for e, g in slot.pairs()]
        truths = [Pose(s.truths[g].rotation, s.truths[g].translation) for s, _, g in pairs]
        found = [_pose(s.estimates[e]) for s, e, _ in pairs]
        model = self.model(obj_id)
        measured: dict[str, np.ndarray] = {}
        cameras = np.stack([s.camera for s, _, _ in pairs]) if pairs else np.zeros((0, 3, 3))
        surface = surface_errors(model, cameras, truths, found)
        width = np.array([s.width for s, _, _ in pairs], np.float64)
        measured["mssd"], measured["mspd"] = surface.mssd, surface.mspd * 640 / np.maximum(width, 1)
        measured["rotation"], measured["translation"] = surface.rotation, surface.translation
        if {"add", "add_s"} & set(metrics):
            measured["add"], measured["add_s"] = average_distances(model, truths, found)
        if self.sized:
            scales = np.array([s.estimates[e].scale for s, e, _ in pairs], np.float64)
            measured["sized_mssd"], measured["sized_add"] = sized_distances(
                model, truths, found, scales, nearest=obj_id in self.symmetric
            )
        place = {(id(slot), e, g): row for row, (slot, e, g) in enumerate(pairs)}
        for slot in slots:
            shape = (len(slot.estimates), len(slot.truths))
            rows = [place[id(slot), e, g] for e, g in slot.pairs()]
            for name, values in measured.items():
                setattr(slot, name, values[rows].reshape(*shape, *values.shape[1:]))

    def discrepancies(self, slots: list[_Slot]) -> None:
        """Fill in VSD of all estimates. Every pose is drawn once, several objects in one child process."""
        by_size: dict[tuple[int, int], list[tuple[_Slot, int, int]]] = {}
        for slot in slots:
            slot.vsd = np.ones((len(slot.estimates), len(slot.truths), len(errors.THRESHOLDS)))
            for e, g in slot.pairs():
                truth, found = Pose(slot.truths[g].rotation, slot.truths[g].translation), _pose(slot.estimates[e])
                if _projections_overlap(self.infos[slot.row.obj_id].diameter, truth, found):
                    size = self.dataset.image_size(slot.row.scene_id, slot.row.im_id)
                    by_size.setdefault(size, []).append((slot, e, g))
        for size, pairs in sorted(by_size.items()):
            pairs.sort(key=lambda pair: (pair[0].row.obj_id, pair[0].row.scene_id, pair[0].row.im_id))
            most = max(1, DRAWN // (size[0] * size[1] * 2))
            parts = [pairs[start : start + most] for start in range(0, len(pairs), most)]
            for part in _bar(parts, self.progress, "batches"):
                self._discrepancies_of(part, size)

    def _discrepancies_of(self, pairs: list[tuple[_Slot, int, int]], size: tuple[int, int]) -> None:
        # A truth that is compared with several estimates is drawn once.
        numbers = sorted({slot.row.obj_id for slot, _, _ in pairs})
        keys: dict[tuple, int] = {}
        which, poses, cameras, places = [], [], [], []
        for slot, e, g in pairs:
            both = []
            truth, found = Pose(slot.truths[g].rotation, slot.truths[g].translation), _pose(slot.estimates[e])
            for key, pose in (((id(slot), "g", g), truth), ((id(slot), "e", e), found)):
                if key not in keys:
                    keys[key] = len(poses)
                    which.append(numbers.index(slot.row.obj_id))
                    poses.append(pose)
                    cameras.append(slot.camera)
                both.append(keys[key])
            places.append(both)
        meshes = [self.dataset.mesh(obj_id) for obj_id in numbers]
        depths = render_depths(meshes, poses, np.stack(cameras), size[1], size[0], which=which)
        seen_of: tuple[tuple[int, int], np.ndarray] | None = None
        for (slot, e, g), (at_truth, at_estimate) in zip(pairs, places, strict=True):
            image = (slot.row.scene_id, slot.row.im_id)
            if seen_of is None or seen_of[0] != image:
                seen = self.depth(*image, size)
                if seen is None:
                    continue
                seen_of = (image, seen)
            K = slot.camera
            slot.vsd[e, g] = _vsd(
                seen_of[1],
                depths[at_truth],
                np.array([K[0, 0], K[1, 1]], np.float32),
                np.array([K[0, 2], K[1, 2]], np.float32),
                depths[at_estimate],
                np.float32(self.infos[slot.row.obj_id].diameter),
                np.float32(self.delta),
            )

    def depth(self, scene_id: int, im_id: int, size: tuple[int, int]) -> np.ndarray | None:
        """The sensor's depth; None, and a problem, where it is damaged."""
        try:
            depth = self.dataset.depth(scene_id, im_id)
            if depth is None or depth.shape != (size[1], size[0]):
                got = "none" if depth is None else f"{depth.shape[1]} × {depth.shape[0]}"
                where = f"{self.dataset.root}, scene {scene_id}, image {im_id}"
                raise DatasetError(f"{where}: the image has {size[0]} × {size[1]} pixels, its depth {got}")
            return depth
        except DatasetError as error:
            if self.on_error == "raise":
                raise
            self.problems.append(f"{error}; its VSD counts as a miss")
            return None

    def precision(self, rows: list[ResultRow]) -> dict[str, float]:
        """BOP 2024's average precision over the images of the targets (MSSD and MSPD)."""
        images = sorted({(t.scene_id, t.im_id) for t in self.targets})
        objects = {t.obj_id for t in self.targets}
        grouped: dict[tuple[int, int], list[ResultRow]] = {}
        for row in rows:
            grouped.setdefault((row.scene_id, row.im_id), []).append(row)
        slots: dict[int, list[_Slot]] = {obj: [] for obj in objects}
        counts = dict.fromkeys(objects, 0)
        for scene, image in images:
            camera, width, truths = self.annotations(scene, image)
            best = sorted(grouped.get((scene, image), []), key=lambda row: -row.score)[:DETECTIONS]
            for obj in objects:
                mine = [row for row in best if row.obj_id == obj]
                there = [t for t in truths if t.obj_id == obj]
                valid = np.array([t.visible < 0 or t.visible >= VISIBLE for t in there], bool)
                counts[obj] += int(valid.sum())
                if mine and there:  # the toolkit drops estimates of objects that are not in the image at all
                    row = TargetRow(scene, image, obj, len(there))
                    slots[obj].append(_Slot(row, camera, width, there, valid, mine))
        table = {"mssd": [], "mspd": []}
        for obj in sorted(objects):
            if counts[obj] == 0:
                continue
            self.measure(obj, slots[obj], ())
            diameter = self.infos[obj].diameter
            for name, unit, thresholds in (
                ("mssd", diameter, errors.THRESHOLDS),
                ("mspd", 1.0, errors.PIXEL_THRESHOLDS),
            ):
                detected = [
                    (getattr(s, name) / unit, np.array([e.score for e in s.estimates]), s.valid) for s in slots[obj]
                ]
                table[name].append([detection_precision(detected, counts[obj], t) for t in thresholds])
        mssd, mspd = (float(np.mean(table[name])) if table[name] else 0.0 for name in ("mssd", "mspd"))
        return {"ap_mssd": mssd, "ap_mspd": mspd, "map": (mssd + mspd) / 2}


def detection_precision(
    images: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], count: int, threshold: float
) -> float:
    """Average precision of one object: for each image errors [e, g], scores [e], and which truths are valid [g].

    Every truth can match; estimates matched to one that is hardly visible are neither right nor wrong.
    """
    scores, correct = [np.zeros(0)], [np.zeros(0, bool)]
    for pose_errors, image_scores, valid in images:
        matched = match_poses(pose_errors, image_scores, threshold)
        ignored = np.array([m >= 0 and not valid[m] for m in matched], bool)
        scores.append(np.asarray(image_scores)[~ignored])
        correct.append((matched >= 0)[~ignored])
    return average_precision(np.concatenate(scores), np.concatenate(correct), count)


def _hits(slot: _Slot, name: str, diameter: float) -> np.ndarray:
    """True positives of a target at every threshold: [10], or [10, 10] for VSD (tolerance, threshold)."""
    thresholds = errors.PIXEL_THRESHOLDS if name == "mspd" else errors.THRESHOLDS
    table = getattr(slot, name) / (1.0 if name in ("mspd", "vsd") else diameter)
    if table.ndim == 2:
        table = table[..., None]
    scores = np.array([e.score for e in slot.estimates])
    found = np.zeros((table.shape[-1] if len(scores) else (10 if name == "vsd" else 1), len(thresholds)), np.int64)
    if len(scores):
        if slot.mssd.shape == (1, 1):
            found[:] = slot.valid[0] & (table[0, 0][:, None] < thresholds)
        else:
            for k in range(table.shape[-1]):
                found[k] = [(match_poses(table[..., k], scores, t, slot.valid) >= 0).sum() for t in thresholds]
    return found if name == "vsd" else found[0]


def _summarise(job: _Job, slots: list[_Slot], rows, precision, method, samples, seed) -> Score:
    names = [m for m in ("mssd", "mspd", "vsd") if m in job.metrics]
    hits = {n: np.stack([_hits(s, n, job.infos[s.row.obj_id].diameter).reshape(-1) for s in slots]) for n in names}
    instances = _instances(slots)
    sized: dict[str, np.ndarray] = {}
    if job.sized:
        for name, attribute in (("mssd", "sized_mssd"), ("add_or_s", "sized_add")):
            sized[name] = np.stack([_hits(s, attribute, job.infos[s.row.obj_id].diameter) for s in slots])
        sized |= _size_hits(slots, instances)
    counts = np.array([s.row.count for s in slots])
    images = {image: i for i, image in enumerate(dict.fromkeys((s.row.scene_id, s.row.im_id) for s in slots))}
    of_image = np.array([images[s.row.scene_id, s.row.im_id] for s in slots])
    place = [(s.row.scene_id, s.row.im_id) for s in slots]

    def one_per_scene(kept: Iterable[tuple[int, int]]) -> np.ndarray:
        first: dict[int, int] = {}
        for scene, image in kept:
            first[scene] = min(image, first.get(scene, image))
        return np.array([first.get(scene) == image for scene, image in place], bool)

    def summary(chosen: np.ndarray) -> Summary:
        recalls = _recalls(hits, counts, chosen, job.metrics)
        used = np.unique(of_image[chosen])
        return Summary(
            len(used),
            int(counts[chosen].sum()),
            recalls,
            _bootstrap(hits, counts, of_image, chosen, samples, seed, job.metrics),
            _recalls(sized, counts, chosen, job.metrics),
            _bootstrap(sized, counts, of_image, chosen, samples, seed, job.metrics),
        )

    everything = np.ones(len(slots), bool)
    trusted = np.array([p not in job.without for p in place], bool)
    without: dict[str, Summary] = {}
    if trusted.any() and not trusted.all():
        told = ", ".join(f"{s}/{i}" for s, i in job.without if (s, i) in images)
        kept = [image for image in images if image not in job.without]
        without = {
            f"one frame per scene, without {told}": summary(one_per_scene(kept)),
            f"all frames, without {told}": summary(trusted),
        }
    of_object = np.array([s.row.obj_id for s in slots])
    found = [i for i in instances if i.found]
    per_object: dict[int, dict[str, float]] = {}
    for obj in sorted(set(of_object.tolist())):
        mine = [i for i in found if i.obj_id == obj]
        entry: dict[str, float] = {"targets": float(counts[of_object == obj].sum())}
        entry |= _recalls(hits, counts, of_object == obj, job.metrics)
        entry |= {f"sized_{k}": v for k, v in _recalls(sized, counts, of_object == obj, job.metrics).items()}
        entry |= _medians(mine)
        per_object[obj] = entry
    seconds = {(r.scene_id, r.im_id): r.time for r in rows if r.time >= 0}
    return Score(
        dataset=f"{job.dataset.name}-{job.dataset.split}",
        method=method,
        metrics=job.metrics,
        all_frames=summary(everything),
        one_frame_per_scene=summary(one_per_scene(images)),
        without=without,
        curves={n: (hits[n].sum(0) / counts.sum()).reshape(-1, 10).mean(0).tolist() for n in names},
        objects=per_object,
        medians=_medians(found),
        missing=len(instances) - len(found),
        add=_add_figures(instances, job) if {"add", "add_s"} & set(job.metrics) else {},
        precision=precision,
        seconds_per_image=float(np.mean(list(seconds.values()))) if seconds else None,
        notes=tuple(job.notes),
        problems=tuple(job.problems),
        instances=tuple(instances),
    )


def _recalls(hits, counts, chosen, metrics) -> dict[str, float]:
    total = max(int(counts[chosen].sum()), 1)
    recalls = {name: float(table[chosen].sum(0).mean() / total) for name, table in hits.items()}
    return recalls | _mean_recall(recalls)


def _mean_recall(recalls: dict[str, Any]) -> dict[str, Any]:
    """BOP's AR, where all three of its metrics are there."""
    names = ("mssd", "mspd", "vsd")
    return {"ar": sum(recalls[n] for n in names) / 3} if set(names) <= set(recalls) else {}


def _bootstrap(hits, counts, of_image, chosen, samples, seed, metrics) -> dict[str, tuple[float, float]]:
    """95 % intervals of the average recalls when images are drawn with replacement."""
    used, place = np.unique(of_image[chosen], return_inverse=True)
    if samples < 1 or len(used) < 2:
        return {}
    weights = np.random.default_rng(seed).multinomial(len(used), np.full(len(used), 1 / len(used)), size=samples)
    totals = np.maximum(weights @ np.bincount(place, counts[chosen], len(used)), 1)
    recalls = {n: weights @ np.bincount(place, t[chosen].mean(-1), len(used)) / totals for n, t in hits.items()}
    recalls |= _mean_recall(recalls)
    return {n: tuple(np.percentile(values, [2.5, 97.5]).tolist()) for n, values in recalls.items()}


def _instances(slots: list[_Slot]) -> list[Instance]:
    """Every instance that counts, with the estimate that falls to it: by falling score, the smallest MSSD."""
    found = []
    for slot in slots:
        scores = np.array([e.score for e in slot.estimates])
        table = np.where(np.isfinite(slot.mssd), slot.mssd, 1e9)  # far is bad, but it is an estimate
        matched = match_poses(table, scores, np.inf, slot.valid) if len(scores) else np.zeros(0, int)
        owner = {int(g): e for e, g in enumerate(matched) if g >= 0}
        for g, truth in enumerate(slot.truths):
            if not slot.valid[g]:
                continue
            e = owner.get(g)
            place = (slot.row.scene_id, slot.row.im_id, slot.row.obj_id, truth.index)
            if e is None:
                nothing = math.inf
                vsd = 1.0 if slot.vsd.size else math.nan
                found.append(
                    Instance(*place, False, 0.0, nothing, nothing, vsd, nothing, nothing, nothing, nothing, math.nan)
                )
                continue
            found.append(
                Instance(
                    *place,
                    True,
                    float(scores[e]),
                    float(slot.mssd[e, g]),
                    float(slot.mspd[e, g]),
                    float(slot.vsd[e, g].mean()) if slot.vsd.size else math.nan,
                    float(slot.add[e, g]) if slot.add.size else math.nan,
                    float(slot.add_s[e, g]) if slot.add_s.size else math.nan,
                    float(slot.rotation[e, g]),
                    float(slot.translation[e, g]),
                    math.nan if (scale := slot.estimates[e].scale) is None else abs(scale - 1),
                    float(slot.sized_mssd[e, g]) if slot.sized_mssd.size else math.nan,
                    float(slot.sized_add[e, g]) if slot.sized_add.size else math.nan,
                )
            )
    return found


def _size_hits(slots: list[_Slot], instances: list[Instance]) -> dict[str, np.ndarray]:
    """For each target the instances whose size is right, one table [slots, 1] for each tolerance."""
    places = {(s.row.scene_id, s.row.im_id, s.row.obj_id): i for i, s in enumerate(slots)}
    tables = {f"size_{round(100 * x)}": np.zeros((len(slots), 1), np.int64) for x in errors.SIZE_TOLERANCES.tolist()}
    for one in instances:
        for table, tolerance in zip(tables.values(), errors.SIZE_TOLERANCES.tolist(), strict=True):
            table[places[one.scene_id, one.im_id, one.obj_id], 0] += one.scale < tolerance
    return tables


def _medians(instances: list[Instance]) -> dict[str, float]:
    if not instances:
        return {}
    medians = {
        "rotation_deg": float(np.degrees(np.median([i.rotation for i in instances]))),
        "translation_mm": float(np.median([i.translation for i in instances]) / MM),
    }
    scales = [i.scale for i in instances if not math.isnan(i.scale)]
    if scales:
        medians["scale_percent"] = float(100 * np.median(scales))
    return medians


def _add_figures(instances: list[Instance], job: _Job) -> dict[str, float]:
    add, add_s = np.array([i.add for i in instances]), np.array([i.add_s for i in instances])
    either = np.array([i.add_s if i.obj_id in job.symmetric else i.add for i in instances])
    diameters = np.array([job.infos[i.obj_id].diameter for i in instances])
    return {
        "add_auc": area_under_accuracy(add),
        "add_s_auc": area_under_accuracy(add_s),
        "add_or_s_auc": area_under_accuracy(either),
        "recall_01d": float(np.mean(either < 0.1 * diameters)),
        "add_s_01d": float(np.mean(add_s < 0.1 * diameters)),
    }


# The table


def _table(found: Score) -> str:
    names = [n for n in ("vsd", "mssd", "mspd", "ar") if n in found.all_frames.recalls]
    heads = {"vsd": "AR_VSD", "mssd": "AR_MSSD", "mspd": "AR_MSPD", "ar": "AR"}
    lines = [f"{found.method} on {found.dataset}", ""]
    rows = [["", "images", "targets", *(heads[n] for n in names)]]
    for title, part in found.parts().items():
        cells = [_percent(part.recalls[n], part.intervals.get(n)) for n in names]
        rows.append([title, str(part.images), str(part.targets), *cells])
    if found.against:
        cells = [_percent(found.against["recalls"][n]) if n in found.against["recalls"] else "–" for n in names]
        rows.append([f"{found.against['method']}, all frames", "", "", *cells])
    lines += [
        *_columns(rows),
        "",
        "Recalls in %; brackets: 95 % bootstrap over images. One frame per scene: the first."
        + (" Without SCENE/IMAGE: its annotation is in doubt." if found.without else ""),
    ]
    if found.all_frames.sized:
        rows = [["", *SIZED.values()]]
        for title, part in found.parts().items():
            rows.append([title, *(_percent(part.sized[n], part.sized_intervals.get(n)) for n in SIZED)])
        lines += [
            "",
            "With the model at its estimated size, which the recalls above do not see (%; in true diameters):",
            *_columns(rows),
            "",
        ]
    if found.medians:
        parts = [
            f"rotation {found.medians['rotation_deg']:.1f}°",
            f"translation {found.medians['translation_mm']:.1f} mm",
        ]
        if "scale_percent" in found.medians:
            parts.append(f"scale {found.medians['scale_percent']:.1f} %")
        lines.append(
            f"Median errors of what was found: {', '.join(parts)}; {found.missing} targets without an estimate."
        )
    if found.add:
        a = found.add
        area = (
            f"AUC to 10 cm: ADD {100 * a['add_auc']:.1f}, ADD-S {100 * a['add_s_auc']:.1f}, ADD(-S) "
            f"{100 * a['add_or_s_auc']:.1f}; below"
        )
        lines.append(
            f"{area if found.all_frames.targets >= FEW else 'Below'} 0.1 d: ADD(-S) {100 * a['recall_01d']:.1f} %, "
            f"ADD-S {100 * a['add_s_01d']:.1f} %."
        )
    if found.precision:
        p = found.precision
        lines.append(
            f"BOP 2024 detection: AP_MSSD {100 * p['ap_mssd']:.1f}, AP_MSPD {100 * p['ap_mspd']:.1f}, "
            f"mAP {100 * p['map']:.1f}."
        )
    if found.seconds_per_image is not None:
        lines.append(f"Time per image: {found.seconds_per_image:.2f} s.")
    rows = [["object", "targets", *(heads[n] for n in names), "rotation °", "translation mm"]]
    if found.against:
        rows[0] += [found.against["method"], "better"]
    for obj, entry in found.objects.items():
        cells = [str(obj), f"{entry['targets']:.0f}", *(_percent(entry[n]) for n in names)]
        cells += [f"{entry[k]:.1f}" if k in entry else "–" for k in ("rotation_deg", "translation_mm")]
        if found.against:
            key = found.against["metric"]
            other = found.against["objects"].get(obj, {}).get(key)
            cells += ["–", ""] if other is None else [_percent(other), _sign(entry[key] - other)]
        rows.append(cells)
    lines += ["", *_columns(rows)]
    if found.against:
        a = found.against
        lines.append(
            f"Objects won against {a['method']} ({heads[a['metric']]}): {a['wins']}, tied {a['ties']}, "
            f"lost {a['losses']}."
        )
    lines += [f"Note: {note}." for note in found.notes]
    if found.problems:
        lines.append(f"{len(found.problems)} problems, the first: {found.problems[0]}")
    return "\n".join(lines)


def _percent(value: float, interval: Sequence[float] | None = None) -> str:
    text = f"{100 * value:.1f}"
    return text if not interval else f"{text} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def _sign(gain: float) -> str:
    return "+" if gain > 0 else "−" if gain < 0 else "="


def _columns(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


# Running an estimator


def evaluate(
    dataset: Dataset,
    objects: Iterable[int] | None,
    estimator: Estimator,
    results_dir: str | Path,
    *,
    method: str = "ipjax",
    settings: Mapping[str, Any] | None = None,
    detections: Sequence[Detection] | None = None,
    alignments: Mapping[int, Alignment] | None = None,
    on_error: Literal["raise", "skip"] = "raise",
    progress: bool = True,
    metrics: Sequence[str] = ("mssd", "mspd", "vsd"),
    against: "str | Path | Score | None" = None,
    symmetric: Iterable[int] | None = None,
    without: Iterable[tuple[int, int]] = (),
    restart: Literal["never", "changed", "always"] = "never",
) -> Score:
    """Estimate every target of a data set, write the BOP result file, and score it. Kill it at any moment and call it
    again: finished images are not done twice, and the result file is the same.

    Args:
        objects: only these objects; None = all that are targets.
        estimator: ``(frame, targets) -> estimates`` for the targets of one image; an object may be left out. Seconds
            that it counts in an attribute ``compile_seconds`` are not part of the time per image; those in
            ``shared_seconds`` (work that another estimator has done for it) are added to it; sentences in ``notes`` go
            under the table.
        results_dir: gets ``results.jsonl`` (a line per finished image: the record that resuming trusts),
            ``METHOD_DATASET-SPLIT.csv`` in BOP's form, the same with a column for the size (``.sized``),
            ``score.json`` and ``score.txt``.
        settings: what the results depend on (configuration, weights, meshes), as plain JSON; a folder with results of
            other settings is refused.
        detections: masks to use; default: the annotated visible masks.
        alignments: for objects whose estimates are of a reconstructed mesh (see `Alignment`).
        on_error: "raise" stops at a damaged file or a failing estimator; "skip" records the failure, which counts as a
            miss, and goes on; the next call tries it again.
        metrics, against, symmetric, without: see `score`.
        restart: begin anew, forgetting what is in the folder: always, or where it was made with other settings.

    Raises DatasetError for damaged data, for a folder that another run is writing to, or that holds other results.
    """
    folder = Path(results_dir)
    folder.mkdir(parents=True, exist_ok=True)
    chosen = None if objects is None else sorted(set(objects))
    images = {
        image: [t for t in rows if chosen is None or t.obj_id in chosen]
        for image, rows in dataset.targets_by_image().items()
    }
    images = {image: rows for image, rows in images.items() if rows}
    if not images:
        raise DatasetError(f"{dataset.targets_file}: there are no targets of the objects asked for")
    alignments = dict(alignments or {})
    head = {
        "format": 1,
        "dataset": f"{dataset.name}-{dataset.split}",
        "objects": chosen,
        "method": method,
        "settings": dict(settings or {}),
        "alignments": {
            str(o): [a.scale, *np.ravel(a.rotation).tolist(), *np.ravel(a.translation).tolist()]
            for o, a in sorted(alignments.items())
        },
    }
    by_image: dict[tuple[int, int], list[Detection]] = {}
    for detection in detections or ():
        by_image.setdefault((detection.scene_id, detection.im_id), []).append(detection)
    results = folder / f"{method.replace('_', '-')}_{dataset.name}-{dataset.split}.csv"
    with _locked(folder):
        journal = Journal(folder / "results.jsonl", head, restart)
        # What failed may have failed for a passing reason.
        missing = [image for image in images if image not in journal.done or journal.done[image].error]
        for image in _bar(missing, progress, "images", done=len(images) - len(missing), total=len(images)):
            try:
                frame = dataset.frame(*image)
                found = by_image.get(image, [])
                if detections is None:
                    given = [t for t in dataset.given_targets(*image) if chosen is None or t.obj_id in chosen]
                    before = 0.0
                else:
                    given = detected_targets(found, images[image])
                    before = max([d.time for d in found if d.time > 0], default=0.0)
                start, uncounted = time.perf_counter(), _uncounted(estimator)
                estimates = list(estimator(frame, given)) if given else []
                uncounted = _uncounted(estimator) - uncounted
                seconds = max(time.perf_counter() - start - uncounted, 0.0) + before
                estimates = [alignments[e.obj_id].apply(e) if e.obj_id in alignments else e for e in estimates]
                rows = [(as_row(image[0], image[1], e, seconds), float(e.scale)) for e in estimates]
                _check_rows(rows)
            except Exception as error:
                if on_error == "raise":
                    raise
                journal.append(image, [], -1.0, f"{type(error).__name__}: {error}")
            else:
                journal.append(image, rows, seconds, None)
        ordered = [pair for image in images for pair in journal.done[image].rows]
        write_results(results, [row for row, _ in ordered])
        write_results(sized_path(results), [row for row, _ in ordered], scales=[scale for _, scale in ordered])
        failed = [f"scene {s}, image {i}: {error}" for s, i in images if (error := journal.done[s, i].error)]
        notes = [*getattr(estimator, "notes", ()), *_alignment_notes(alignments)]
        if failed:
            notes.append(f"{len(failed)} images failed, count as misses, and will be tried again at the next call")
            notes += failed[:LISTED]
            if len(failed) > LISTED:
                notes.append(f"{len(failed) - LISTED} more failed; results.jsonl has their reasons")
        found_score = score(
            [row for row, _ in ordered],
            dataset,
            metrics,
            objects=chosen,
            against=against,
            scales=[scale for _, scale in ordered],
            symmetric=symmetric,
            on_error=on_error,
            method=method,
            notes=notes,
            without=without,
        )
        found_score.write_json(folder / "score.json")
        write_text(folder / "score.txt", found_score.table() + "\n")
    return found_score


def _uncounted(estimator: Any) -> float:
    return getattr(estimator, "compile_seconds", 0.0) - getattr(estimator, "shared_seconds", 0.0)


def _differences(old: Any, new: Any, where: str = "") -> list[str]:
    """The names of what differs in two dictionaries of plain JSON."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return [] if old == new else [where]
    names = [name for name in {**new, **old} if where or name in new]
    return [d for n in names for d in _differences(old.get(n), new.get(n), f"{where}.{n}" if where else n)]


@dataclass(frozen=True)
class Done:
    """A finished image: its rows with their scales, and what went wrong, if anything."""

    rows: list[tuple[ResultRow, float]]
    seconds: float
    error: str | None


class Journal:
    """What has been done, a line of JSON per image, appended and flushed to disc as a whole.

    A line that a crash cut short is dropped. Raises DatasetError where the file belongs to other settings and
    ``restart`` is "never".
    """

    def __init__(self, path: Path, head: Mapping[str, Any], restart: str = "never"):
        self.path = path
        self.restart = restart
        if restart == "always":
            path.unlink(missing_ok=True)
        self.done: dict[tuple[int, int], Done] = {}
        head = json.loads(json.dumps(head))
        if path.is_file():
            data = path.read_bytes()
            whole = data[: data.rfind(b"\n") + 1]
            if len(whole) < len(data):
                with open(path, "r+b") as file:
                    file.truncate(len(whole))
            lines = whole.decode("utf-8").splitlines()
            if lines and self._read(lines, head):
                return
            path.unlink()
        self._write(head)

    def append(
        self, image: tuple[int, int], rows: list[tuple[ResultRow, float]], seconds: float, error: str | None
    ) -> None:
        """Record an image; when this returns it is on disc."""
        estimates = [[r.obj_id, r.score, list(r.rotation), list(r.translation), s] for r, s in rows]
        self._write({"image": list(image), "seconds": seconds, "error": error, "estimates": estimates})
        self.done[image] = Done(rows, seconds, error)

    def _read(self, lines: list[str], head: Mapping[str, Any]) -> bool:
        """Take over what was done; False where it was made otherwise and is to be forgotten."""
        differs: list[str] = []
        for number, line in enumerate(lines, start=1):
            try:
                entry = parse_json(line)
                if number == 1:
                    differs = _differences(entry, head)
                else:
                    scene, image = entry["image"]
                    rows = [
                        (ResultRow(scene, image, obj, s, tuple(R), tuple(t), entry["seconds"]), scale)
                        for obj, s, R, t, scale in entry["estimates"]
                    ]
                    self.done[scene, image] = Done(rows, entry["seconds"], entry["error"])
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise DatasetError(
                    f"{self.path}, line {number}: damaged ({error}); delete the line to redo it"
                ) from None
            if number == 1 and differs:
                if self.restart == "changed":
                    return False
                what = ", ".join(differs[:3]) + (" …" if len(differs) > 3 else "")
                raise DatasetError(
                    f"{self.path}: these results were made with other settings ({what}); choose another folder, or "
                    "restart"
                )
        return True

    def _write(self, entry: Mapping[str, Any]) -> None:
        import os

        line = (json.dumps(entry, allow_nan=False) + "\n").encode()
        with open(self.path, "ab") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One run at a time in a folder; the lock goes with the process, however it ends."""
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(folder / ".lock", wait=False))
        except BlockingIOError:
            raise DatasetError(f"{folder}: another run is writing here") from None
        yield


def _check_rows(rows: list[tuple[ResultRow, float]]) -> None:
    for row, scale in rows:
        if not np.isfinite([row.score, *row.rotation, *row.translation, scale]).all():
            raise ValueError(f"the estimate of object {row.obj_id} is not finite")
        if not scale > 0:
            raise ValueError(f"the size of the estimate of object {row.obj_id} is not positive: {scale:g}")
        try:
            check_rotation(row.rotation)
        except ValueError as error:
            raise ValueError(f"the estimate of object {row.obj_id}: {error}") from None


def _bar(items: Any, show: bool, unit: str, *, done: int = 0, total: int | None = None) -> Any:
    if not show:
        return items
    items = list(items)
    return bar(items, desc="evaluating", unit=f" {unit}", initial=done, total=total or len(items), smoothing=0.1)


# Small geometry in float64


def _pose(row: ResultRow) -> Pose:
    return Pose(np.asarray(row.rotation, np.float64).reshape(3, 3), np.asarray(row.translation, np.float64) * MM)


def _aligned(row: ResultRow, alignment: Alignment | None) -> ResultRow:
    if alignment is None:
        return row
    pose = _pose(row)
    moved = alignment.apply(Estimate(row.obj_id, row.score, pose.rotation, pose.translation, alignment.scale))
    return replace(as_row(row.scene_id, row.im_id, moved, row.time), line=row.line, scale=row.scale)


def _identity(row: ResultRow) -> tuple:
    """What tells an estimate from others."""
    return row.scene_id, row.im_id, row.obj_id, row.score, row.rotation, row.translation


# What a file's translations are multiplied by when they are in another unit; other powers of ten have no name here.
_UNITS = {10.0**k: "" for k in range(-9, 10)} | {1e-3: "metres", 1e-1: "centimetres", 1 / 25.4: "inches"}
_MOST_TURNS = 60  # rotations that leave an icosahedron as it is; no other solid with finitely many has more
_ALIKE = 1 + 2 * math.cos(math.radians(15))  # the trace of a turn by 15°


def _suspect_conventions(pairs: Sequence[tuple[Pose, Sequence[Pose], np.ndarray]]) -> str | None:
    """What is wrong with all of a file's poses, given each with those of the annotation and with the rotations of the
    object's symmetries: in words, or None. Only what no method that merely fails can do: three quarters of the lengths
    off by the factor of another unit; half of the rotations right when transposed, and hardly any as they are; three
    quarters of the objects behind the camera, at the right distance."""
    if not pairs:
        return None
    estimates = np.stack([estimate.translation for estimate, _, _ in pairs])
    truths = np.stack([np.median([truth.translation for truth in told], axis=0) for _, told, _ in pairs])
    lengths = np.linalg.norm(estimates, axis=-1), np.linalg.norm(truths, axis=-1)
    ratio = np.maximum(lengths[0] / np.maximum(lengths[1], 1e-9), 1e-12)
    factor = min(_UNITS, key=lambda factor: abs(math.log(np.median(ratio) / factor)))
    alike = np.mean(np.abs(np.log(ratio / factor)) < math.log(1.25)) > 0.75
    few = len(pairs) < 3
    if alike and factor != 1 and not (few and 0.01 < factor < 100):
        off = f"{1 / factor:g} times too small" if factor < 1 else f"{factor:g} times too large"
        unit = f"; it seems to be in {_UNITS[factor]}" if _UNITS[factor] else ""
        middle = [f"{np.median(length) / MM:.4g}" for length in lengths]
        return (
            f"the translations are some {off} (median length {middle[0]}, annotated {middle[1]} mm): t must be in "
            f"millimetres{unit}"
        )
    if few:
        return None
    # The axis of a body of revolution may be right either way.
    turned = [pair for pair in pairs if len(pair[2]) <= _MOST_TURNS]
    right = [_is_turned_like(estimate.rotation, told, same) for estimate, told, same in turned]
    other = [_is_turned_like(estimate.rotation.T, told, same) for estimate, told, same in turned]
    if len(turned) >= 3 and np.mean(right) < 0.25 and np.mean(other) >= 0.5:
        return "the rotations are right when R is transposed: R and t must map the model into the camera's frame"
    if factor == 1 and alike and np.mean((estimates[:, 2] < 0) & (truths[:, 2] > 0)) > 0.75:
        return "the objects are behind the camera (z below 0): poses must be in OpenCV axes, x right, y down, z ahead"
    return None


def _is_turned_like(rotation: np.ndarray, truths: Sequence[Pose], symmetries: np.ndarray) -> bool:
    """Whether a rotation is within 15° of one of the true ones, up to the object's symmetries."""
    return any((rotation * (truth.rotation @ symmetries)).sum((-2, -1)).max() > _ALIKE for truth in truths)


def _symmetric(
    model: Model, rotation: np.ndarray, translation: np.ndarray, index: int
) -> tuple[np.ndarray, np.ndarray]:
    """The true pose after a symmetry of the object; padding repeats the first one."""
    index = index if index < len(model.rotations) else 0
    return rotation @ model.rotations[index], rotation @ model.translations[index] + translation


def _projections_overlap(diameter: float, truth: Pose, estimate: Pose) -> bool:
    """`metrics.projections_overlap` in float64."""
    p, q = truth.translation, estimate.translation
    if p[2] == 0 or q[2] == 0:
        return False
    return bool(np.linalg.norm(p[:2] / p[2] - q[:2] / q[2]) < diameter / 2 * (1 / p[2] + 1 / q[2]))


def _project(points: np.ndarray, focal: np.ndarray) -> np.ndarray:
    depth = points[:, 2:]
    return focal * points[:, :2] / np.where(np.abs(depth) < 1e-9, 1e-9, depth)


def _angle(truth: np.ndarray, estimate: np.ndarray) -> float:
    turn = estimate @ truth.T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(np.arctan2(np.linalg.norm(axis), np.trace(turn) - 1))


def _hull(points: np.ndarray) -> np.ndarray:
    """Vertices of the convex hull: all that MSSD needs, since it is the maximum of a convex function."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # flat, or too few
        return points


def _padded(points: np.ndarray) -> np.ndarray:
    """The points, the first one repeated, to one of a few sizes: objects share a compiled program, maxima do not
    change."""
    count = len(points)
    step = max(64, 2 ** max(math.ceil(math.log2(count)) - 2, 0))
    return np.concatenate([points, np.repeat(points[:1], -count % step, axis=0)])


def _padded_symmetries(rotations: np.ndarray, translations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count = len(rotations)
    extra = 0 if count == 1 else 8 - count if count <= 8 else -count % 64
    return (
        np.concatenate([rotations, np.repeat(rotations[:1], extra, axis=0)]),
        np.concatenate([translations, np.repeat(translations[:1], extra, axis=0)]),
    )


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
