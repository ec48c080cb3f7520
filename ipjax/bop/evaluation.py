"""Running an estimator over a data set, resumably, and scoring its estimates."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ipjax.bop.alignments import align, describe_alignments
from ipjax.bop.dataset import Dataset
from ipjax.bop.detections import Detection, detected_targets, every_target
from ipjax.bop.journal import Journal, locked_folder
from ipjax.bop.records import DatasetError, Estimate, Frame, Target, TargetRow, check_rotation
from ipjax.bop.results import ResultRow, as_row, sized_path, write_results
from ipjax.bop.scoring.scores import Score, score
from ipjax.bop.scoring.tables import format_score
from ipjax.files.storage.writing import write_text
from ipjax.progress import bar
from ipjax.transforms import Similarity

LISTED = 20  # failed images that are listed with their reasons
Estimator = Callable[[Frame, list[Target]], list[Estimate]]


def evaluate(
    dataset: Dataset,
    objects: Iterable[int] | None,
    estimator: Estimator,
    results_dir: str | Path,
    *,
    method: str = "ipjax",
    settings: Mapping[str, Any] | None = None,
    detections: Sequence[Detection] | None = None,
    alignments: Mapping[int, Similarity[np.ndarray]] | None = None,
    aligned_by: Mapping[int, str] | None = None,
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
            under the table. Where ``seeks`` is True, no masks are read: its targets say which objects, and how often.
        results_dir: gets ``results.jsonl`` (a line per finished image: the record that resuming trusts),
            ``METHOD_DATASET-SPLIT.csv`` in BOP's form, the same with a column for the size (``.sized``),
            ``score.json`` and ``score.txt``.
        settings: what the results depend on (configuration, weights, meshes), as plain JSON; a folder with results of
            other settings is refused.
        detections: masks to use; default: the annotated visible masks. Of each object that the targets name the best,
            as many as there are instances; where the targets name none (BOP 2024), every detection of these objects.
        alignments, aligned_by: for objects whose estimates are of a reconstructed mesh; see `score`.
        on_error: "raise" stops at a damaged file or a failing estimator; "skip" records the failure, which counts as a
            miss, and goes on; the next call tries it again.
        metrics, against, symmetric, without: see `score`.
        restart: begin anew, forgetting what is in the folder: always, or where it was made with other settings.

    Raises DatasetError for damaged data, for a folder that another run is writing to, or that holds other results.
    """
    folder = Path(results_dir)
    folder.mkdir(parents=True, exist_ok=True)
    chosen = None if objects is None else sorted(set(objects))
    images = targets_of(dataset, chosen)
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
            str(o): [float(a.scale), *np.ravel(a.rotation).tolist(), *np.ravel(a.translation).tolist()]
            for o, a in sorted(alignments.items())
        },
    }
    by_image: dict[tuple[int, int], list[Detection]] = {}
    for detection in detections or ():
        by_image.setdefault((detection.scene_id, detection.im_id), []).append(detection)
    seeks = getattr(estimator, "seeks", False)
    results = folder / f"{method.replace('_', '-')}_{dataset.name}-{dataset.split}.csv"
    with locked_folder(folder):
        journal = Journal(folder / "results.jsonl", head, restart)
        # What failed may have failed for a passing reason.
        missing = [image for image in images if image not in journal.done or journal.done[image].error]
        for image in _bar(missing, progress, "images", done=len(images) - len(missing), total=len(images)):
            try:
                frame = dataset.frame(*image)
                found = by_image.get(image, [])
                if seeks:
                    told = images[image] if dataset.names_objects else []
                    given, before = [Target(t.obj_id) for t in told for _ in range(t.count)], 0.0
                elif detections is None:
                    given = [t for t in dataset.given_targets(*image) if chosen is None or t.obj_id in chosen]
                    before = 0.0
                else:
                    is_told = dataset.names_objects
                    given = detected_targets(found, images[image]) if is_told else every_target(found, chosen)
                    before = max([d.time for d in found if d.time > 0], default=0.0)
                start, uncounted = time.perf_counter(), _uncounted(estimator)
                estimates = list(estimator(frame, given)) if given or seeks else []
                uncounted = _uncounted(estimator) - uncounted
                seconds = max(time.perf_counter() - start - uncounted, 0.0) + before
                estimates = [align(e, alignments[e.obj_id]) if e.obj_id in alignments else e for e in estimates]
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
        notes = [*getattr(estimator, "notes", ()), *describe_alignments(alignments, aligned_by or {})]
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
        write_text(folder / "score.txt", format_score(found_score) + "\n")
    return found_score


def targets_of(dataset: Dataset, objects: Sequence[int] | None) -> dict[tuple[int, int], list[TargetRow]]:
    """The targets of each image that has any of these objects (None = all).

    Where nobody says what is in an image, every image, without targets.
    """
    images = {
        image: [t for t in rows if objects is None or t.obj_id in objects]
        for image, rows in dataset.targets_by_image().items()
    }
    if not dataset.names_objects:
        images = {image: images.get(image, []) for image in dataset.target_images}
    return {image: rows for image, rows in images.items() if rows or not dataset.names_objects}


def _uncounted(estimator: Any) -> float:
    """Seconds of an estimator that are not part of the time per image, less those to be added to it."""
    return getattr(estimator, "compile_seconds", 0.0) - getattr(estimator, "shared_seconds", 0.0)


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
