"""The score of a result file on a data set, as the BOP challenges and the YCB-V papers define it.

Protocol: BOP 2019-2023 for 6D localisation (average recall) and BOP 2024 for 6D detection (average precision);
https://github.com/thodan/bop_toolkit. A missing estimate is a miss, and a recall is a share of all instances of the
data set, not a mean over its objects.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from ipjax.bop.alignments import align, describe_alignments
from ipjax.bop.dataset import Dataset
from ipjax.bop.records import Estimate
from ipjax.bop.results import ResultRow, as_row
from ipjax.bop.scoring.discrepancy import measure_discrepancies
from ipjax.bop.scoring.precision import measure_precision
from ipjax.bop.scoring.protocol import Protocol, ScoredTarget
from ipjax.bop.scoring.recalls import (
    average_recalls,
    bootstrap_recalls,
    count_hits,
    count_right_sizes,
    find_instances,
    find_medians,
    summarise_distances,
)
from ipjax.bop.scoring.summaries import Score, Summary
from ipjax.progress import bar
from ipjax.transforms import Similarity

METRICS = ("mssd", "mspd", "vsd", "add", "add_s", "ap")
DELTA = 0.015  # metres: VSD's visibility tolerance


def score(
    results: str | Path | Sequence[ResultRow],
    dataset: Dataset,
    metrics: Sequence[str] = ("mssd", "mspd", "vsd"),
    *,
    objects: Iterable[int] | None = None,
    against: str | Path | Sequence[ResultRow] | Score | None = None,
    alignments: Mapping[int, Similarity[np.ndarray]] | None = None,
    aligned_by: Mapping[int, str] | None = None,
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
            own frame: the evaluation-only ``model_from_mesh`` (`read_alignment`). The table says that it was used.
        aligned_by: where each comes from, for the table.
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
    protocol = Protocol(dataset, tuple(metrics), objects, delta, on_error, symmetric, progress, without)
    protocol.notes += notes
    method = method or (Path(results).stem if isinstance(results, str | Path) else "results")
    rows = protocol.rows(results, scales)
    if isinstance(results, str | Path) and scales is None and sizes is not False:
        rows = protocol.with_sizes(rows, Path(results), sizes)
    if alignments:
        rows = [_align(row, alignments[row.obj_id]) if row.obj_id in alignments else row for row in rows]
        protocol.notes += describe_alignments(alignments, aligned_by or {})
    found = _score_rows(protocol, rows, method, samples, seed)
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


def _score_rows(protocol: Protocol, rows: list[ResultRow], method: str, samples: int, seed: int) -> Score:
    targets = protocol.collect(rows)
    protocol.check_conventions(targets, rows)
    estimates = [row for target in targets for row in target.estimates]
    protocol.sized = bool(estimates) and all(row.scale is not None for row in estimates)
    if not protocol.sized and any(row.scale is not None for row in estimates):
        protocol.notes.append("some estimates have no size, so that sizes are left out")
    by_object: dict[int, list[ScoredTarget]] = {}
    for target in targets:
        by_object.setdefault(target.row.obj_id, []).append(target)
    chosen = sorted(by_object.items())
    for obj_id, mine in bar(chosen, desc="evaluating", unit=" objects", smoothing=0.1) if protocol.progress else chosen:
        protocol.measure(obj_id, mine, protocol.metrics)
    if "vsd" in protocol.metrics:
        measure_discrepancies(protocol, targets)
    precision = measure_precision(protocol, rows) if "ap" in protocol.metrics else {}
    return _summarise(protocol, targets, rows, precision, method, samples, seed)


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


def _align(row: ResultRow, model_from_mesh: Similarity[np.ndarray]) -> ResultRow:
    """The row of a mesh, scaled to its true size, as one of the model."""
    pose, scale = row.camera_from_object, float(model_from_mesh.scale)
    moved = align(Estimate(row.obj_id, row.score, pose.rotation, pose.translation, scale), model_from_mesh)
    return replace(as_row(row.scene_id, row.im_id, moved, row.time), line=row.line, scale=row.scale)


def _summarise(
    protocol: Protocol,
    targets: list[ScoredTarget],
    rows: list[ResultRow],
    precision: dict[str, float],
    method: str,
    samples: int,
    seed: int,
) -> Score:
    names = [m for m in ("mssd", "mspd", "vsd") if m in protocol.metrics]
    hits = {
        n: np.stack([count_hits(s, n, protocol.infos[s.row.obj_id].diameter).reshape(-1) for s in targets])
        for n in names
    }
    instances = find_instances(targets)
    sized: dict[str, np.ndarray] = {}
    if protocol.sized:
        for name, attribute in (("mssd", "sized_mssd"), ("add_or_s", "sized_add")):
            sized[name] = np.stack([count_hits(s, attribute, protocol.infos[s.row.obj_id].diameter) for s in targets])
        sized |= count_right_sizes(targets, instances)
    counts = np.array([s.row.count for s in targets])
    images = {image: i for i, image in enumerate(dict.fromkeys((s.row.scene_id, s.row.im_id) for s in targets))}
    of_image = np.array([images[s.row.scene_id, s.row.im_id] for s in targets])
    place = [(s.row.scene_id, s.row.im_id) for s in targets]

    def one_per_scene(kept: Iterable[tuple[int, int]]) -> np.ndarray:
        first: dict[int, int] = {}
        for scene, image in kept:
            first[scene] = min(image, first.get(scene, image))
        return np.array([first.get(scene) == image for scene, image in place], bool)

    def summary(chosen: np.ndarray) -> Summary:
        recalls = average_recalls(hits, counts, chosen)
        used = np.unique(of_image[chosen])
        return Summary(
            len(used),
            int(counts[chosen].sum()),
            recalls,
            bootstrap_recalls(hits, counts, of_image, chosen, samples, seed),
            average_recalls(sized, counts, chosen),
            bootstrap_recalls(sized, counts, of_image, chosen, samples, seed),
        )

    everything = np.ones(len(targets), bool)
    trusted = np.array([p not in protocol.without for p in place], bool)
    without: dict[str, Summary] = {}
    if trusted.any() and not trusted.all():
        left_out = ", ".join(f"{s}/{i}" for s, i in protocol.without if (s, i) in images)
        kept = [image for image in images if image not in protocol.without]
        without = {
            f"one frame per scene, without {left_out}": summary(one_per_scene(kept)),
            f"all frames, without {left_out}": summary(trusted),
        }
    seconds = {(r.scene_id, r.im_id): r.time for r in rows if r.time >= 0}
    of_object = np.array([s.row.obj_id for s in targets])
    found = [i for i in instances if i.found]
    per_object: dict[int, dict[str, float]] = {}
    for obj in sorted(set(of_object.tolist())):
        mine = [i for i in found if i.obj_id == obj]
        entry: dict[str, float] = {"targets": float(counts[of_object == obj].sum())}
        entry |= average_recalls(hits, counts, of_object == obj)
        entry |= {f"sized_{k}": v for k, v in average_recalls(sized, counts, of_object == obj).items()}
        entry |= find_medians(mine)
        known = [seconds[p] for p, o in zip(place, of_object, strict=True) if o == obj and p in seconds]
        entry |= {"seconds": float(np.mean(known))} if known else {}
        per_object[obj] = entry
    return Score(
        dataset=f"{protocol.dataset.name}-{protocol.dataset.split}",
        method=method,
        metrics=protocol.metrics,
        all_frames=summary(everything),
        one_frame_per_scene=summary(one_per_scene(images)),
        without=without,
        curves={n: (hits[n].sum(0) / counts.sum()).reshape(-1, 10).mean(0).tolist() for n in names},
        objects=per_object,
        medians=find_medians(found),
        missing=len(instances) - len(found),
        add=summarise_distances(instances, protocol) if {"add", "add_s"} & set(protocol.metrics) else {},
        precision=precision,
        seconds_per_image=float(np.mean(list(seconds.values()))) if seconds else None,
        notes=tuple(protocol.notes),
        problems=tuple(protocol.problems),
        instances=tuple(instances),
    )
