"""``python -m benchmarks.detection DATA --objects FOLDER``: objects found without a mask, and masks that are wrong.

For each image of a data set in BOP layout, every object for which the folder has a file (obj_000001.ipjax …) is sought:

* alone, where it is known to be there, with its size unknown and known: the mask's IoU, and ADD-S of the pose;
* all of them together, in every image: what is found of those that are there, and what is found of those that are not;
* the annotated masks made wrong (widened, eroded, half of it missing, a fifth of a neighbour added), with and without
  ``--mask-is-rough``.

A line for each image is kept in --output: killed and called again it goes on, unless the code, the object files or the
settings are others. ``--page`` writes the page from these lines. Seconds are of the processor, of all threads; what is
compiled before the first image does not count.
"""

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from benchmarks.measure import commit, describe_device
from ipjax import metrics
from ipjax.bop.dataset import Dataset
from ipjax.config import Config, DetectConfig
from ipjax.detection.assignment import overlap
from ipjax.detection.detector import Detector
from ipjax.detection.rough import mend_mask
from ipjax.files.objects.loading import load
from ipjax.files.provenance import hash_executed
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.progress import bar

RIGHT = 0.1  # diameters: ADD-S of a right pose
IOU = 0.5  # of a right mask
LEAST = Config().confidence.least
WRONG_MASKS = ("as annotated", "widened by 6 px", "eroded by 4 px", "half missing", "a fifth of a neighbour")


def load_objects(folder: Path, objects: list[int]) -> Iterator[tuple[Any, Any]]:
    """Templates and what is known of them, one after another; their size is not known, and pictures are not kept."""
    for obj_id in objects:
        templates, info = load(folder / f"obj_{obj_id:06d}.ipjax")
        yield templates, dataclasses.replace(info, metres_per_unit=None, pictures=None)


class Bench:
    """A data set and a detector of its objects."""

    def __init__(self, dataset: Dataset, folder: Path, encoder: Any, detection: DetectConfig, config: Config):
        self.dataset, self.models = dataset, dataset.models()
        there = sorted(dataset.models())
        self.objects = [obj_id for obj_id in there if (folder / f"obj_{obj_id:06d}.ipjax").is_file()]
        self.missing = [obj_id for obj_id in there if obj_id not in self.objects]
        self.detector = Detector(load_objects(folder, self.objects), encoder, config, detection=detection)
        self.points = {obj_id: self._sample(obj_id) for obj_id in self.objects}

    def _sample(self, obj_id: int) -> np.ndarray:
        """Vertices of the model in metres."""
        vertices = np.asarray(self.dataset.mesh(obj_id).vertices, np.float64)
        return vertices[:: max(len(vertices) // 2000, 1)]

    def error(self, index: int, pose: Any, truth: Any) -> float:
        """ADD-S of an estimate in diameters; the size that was found counts, too."""
        obj_id = self.objects[index]
        info = self.detector.estimator.objects[index][1]
        points = self.points[obj_id]
        placed = (pose.to_numpy() @ info.object_from_mesh.to_numpy()) @ (points / 1e-3)
        return float(cKDTree(placed).query(truth.camera_from_object @ points)[0].mean()) / self.models[obj_id].diameter

    def run(self, image: tuple[int, int]) -> dict[str, Any]:
        """All that is measured in one image."""
        frame = self.dataset.frame(*image)
        rows = self.dataset.targets_by_image()[image]
        truths = {row.obj_id: self._truth(image, row.obj_id) for row in rows if row.obj_id in self.objects}
        start = time.process_time()
        sight = self.detector.look(frame.rgb, frame.depth, frame.camera)
        seconds = {"frame": time.process_time() - start}
        claims, alone, per_object = [], [], []
        for index, obj_id in enumerate(self.objects):
            start = time.process_time()
            mine, rejected = self.detector.seek(sight, index)
            per_object.append(time.process_time() - start)
            claims += mine
            if obj_id in truths:
                found = self.detector.choose(sight, mine, rejected)
                best = max((overlap(mask, truths[obj_id][1]) for mask in sight.proposals.masks), default=0.0)
                alone.append({"obj_id": obj_id, "proposed": best, **self._judge(found, obj_id, truths[obj_id])})
        seconds["objects"] = per_object
        stages = dict(sight.watch.spent)
        start = time.process_time()
        together = self.detector.choose(sight, claims)
        seconds["assign"] = time.process_time() - start
        every = []
        for one in together:
            obj_id = self.objects[one.index]
            every.append({"obj_id": obj_id, **self._judge([one], obj_id, truths.get(obj_id))})
        known = []
        for obj_id, truth in truths.items():
            index = self.objects.index(obj_id)
            size = self.models[obj_id].diameter
            alone_sight = self.detector.look(frame.rgb, frame.depth, frame.camera, diameter=size)
            mine, rejected = self.detector.seek(alone_sight, index, diameter=size)
            found = self.detector.choose(alone_sight, mine, rejected)
            known.append({"obj_id": obj_id, **self._judge(found, obj_id, truth)})
        wrong = [self._wrong_masks(sight, obj_id, truths) for obj_id in truths]
        return {
            "image": list(image),
            "proposals": len(sight.proposals.masks),
            "cpu": seconds,
            "stages": {name: round(value, 3) for name, value in stages.items()},
            "alone": alone,
            "known": known,
            "together": every,
            "masks": wrong,
            "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def _truth(self, image: tuple[int, int], obj_id: int) -> tuple[Any, np.ndarray]:
        truth = next(one for one in self.dataset.truths(*image) if one.obj_id == obj_id)
        return truth, self.dataset.mask(*image, truth.index)

    def _judge(self, found: Any, obj_id: int, truth: Any) -> dict[str, Any]:
        """The best detection of an object; without a truth it is a false one."""
        if not len(found):
            return {"iou": 0.0, "error": None, "confidence": 0.0, "score": 0.0, "there": truth is not None}
        one = found[0]
        told = {"confidence": one.confidence, "score": one.score, "there": truth is not None, "iou": 0.0, "error": None}
        if truth is not None:
            told["iou"] = overlap(one.mask, truth[1])
            told["error"] = self.error(self.objects.index(obj_id), one.result.estimate.camera_from_object, truth[0])
        return told

    def _wrong_masks(self, sight: Any, obj_id: int, truths: dict[int, Any]) -> dict[str, Any]:
        """Errors of the pose in the annotated mask made wrong, as it is and mended."""
        index = self.objects.index(obj_id)
        truth, mask = truths[obj_id]
        told: dict[str, Any] = {}
        for name, changed in spoil(mask, [other for key, (_, other) in truths.items() if key != obj_id]).items():
            mended = mend_mask(self.detector, index, sight, changed)
            if mended is None:
                told[name] = {"before": None, "after": None}
                continue
            estimates = mended.first.estimate, mended.result.estimate
            errors = [
                self.error(index, one.camera_from_object, truth) if bool(one.success) else None for one in estimates
            ]
            told[name] = {
                "before": errors[0],
                "after": errors[1],
                "iou_before": overlap(changed, mask),
                "iou_after": overlap(mended.mask, mask),
                "confidence_before": float(estimates[0].confidence),
                "confidence_after": float(estimates[1].confidence),
            }
        return {"obj_id": obj_id, **told}


def spoil(mask: np.ndarray, neighbours: list[np.ndarray], eroded: int = 4) -> dict[str, np.ndarray]:
    """The mask as it is and made wrong in each of the ways of `WRONG_MASKS`, eroded by so many pixels; none that would
    be empty."""
    disc = lambda radius: cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    grown = cv2.dilate(mask.astype(np.uint8), disc(6)) > 0
    worn = cv2.erode(mask.astype(np.uint8), disc(eroded)) > 0
    half = mask.copy()
    columns = np.flatnonzero(mask.any(0))
    half[:, : int(np.median(np.nonzero(mask)[1]))] = False
    names = [*WRONG_MASKS[:2], f"eroded by {eroded} px", WRONG_MASKS[3]]
    found = dict(zip(names, (mask, grown, worn, half), strict=True))
    if neighbours:
        # The part of the nearest other object that is nearest, a fifth of this one's area.
        distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
        other = min(neighbours, key=lambda one: distance[one].min() if one.any() else np.inf) & ~mask
        reach = np.sort(distance[other])[: max(int(0.2 * mask.sum()), 1)]
        if reach.size:
            found[WRONG_MASKS[4]] = mask | (other & (distance <= reach[-1]))
    return {name: one for name, one in found.items() if one.any() and columns.size}


def summarise(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of the page."""
    is_right = lambda one: one["error"] is not None and one["error"] < RIGHT

    def of_known(rows):
        ious = np.array([one["iou"] for one in rows])
        right = np.array([is_right(one) for one in rows])
        sure = np.array([one["confidence"] >= LEAST for one in rows])
        return {
            "targets": len(rows),
            "recall": float((ious >= IOU).mean()),
            "iou": float(ious.mean()),
            "poses": float(right.mean()),
            "present": float((right & sure).mean()),
        }

    alone = [one for line in lines for one in line["alone"]]
    every = [one for line in lines for one in line["together"]]
    table = {}
    for least in (LEAST, LEAST / 2):
        sure = [one for one in every if one["confidence"] >= least]
        table[least] = {
            "right": sum(is_right(one) for one in sure),
            "misplaced": sum(one["there"] and not is_right(one) for one in sure),
            "false": sum(not one["there"] for one in sure),
        }
    scores = np.array([one["score"] for one in every])
    right = np.array([is_right(one) for one in every], bool)
    stages: dict[str, float] = {}
    for line in lines:
        for name, value in line["stages"].items():
            stages[name] = stages.get(name, 0.0) + value / len(lines)
    return {
        "unknown": of_known(alone) | {"proposed": float(np.mean([one["proposed"] >= IOU for one in alone]))},
        "known": of_known([one for line in lines for one in line["known"]]),
        "there": len(alone),
        "together": table,
        "ap": metrics.average_precision(scores, right, len(alone)) if len(every) else 0.0,
        "frame": float(np.median([line["cpu"]["frame"] for line in lines])),
        "object": float(np.median([s for line in lines for s in line["cpu"]["objects"]])),
        "all": float(np.median([_all_seconds(line["cpu"]) for line in lines])),
        "stages": stages,
        "memory": max(line["memory_mb"] for line in lines),
    }


def _all_seconds(cpu: dict[str, Any]) -> float:
    return cpu["frame"] + sum(cpu["objects"]) + cpu["assign"]


def summarise_masks(lines: list[dict[str, Any]]) -> list[tuple[str, int, float, float, float, float]]:
    """Of each kind of mask: how many, share of right poses as it is and mended, mean IoU as it is and mended."""
    rows = []
    for name in WRONG_MASKS:
        told = [one[name] for line in lines for one in line["masks"] if name in one and "iou_before" in one[name]]
        if not told:
            continue
        right = [np.mean([one[key] is not None and one[key] < RIGHT for one in told]) for key in ("before", "after")]
        ious = [np.mean([one[key] for one in told]) for key in ("iou_before", "iou_after")]
        rows.append((name, len(told), *map(float, (*right, *ious))))
    return rows


def write_page(path: Path, studies: list[tuple[dict[str, Any], list[dict[str, Any]]]]) -> None:
    """The page, in Markdown."""
    text = ["# Objects found without a mask", "", "Made by `python -m benchmarks.detection`; do not edit by hand.", ""]
    head = studies[0][0]
    text += [
        f"* Device: {head['device']}, {head['cores']} cores; jax {head['jax']}.",
        f"* Commit {head['commit']}, {head['date']}.",
        f"* Encoder: {head['encoder']}.",
        f"* Poses with `Config.fast()`; {head['views']} templates of each object.",
        f"* A pose is right where ADD-S is less than {RIGHT:.0%} of the diameter; its size is found, too.",
        "* Mini sets: not to be compared with published figures of the full data sets.",
        "",
        "## Known to be there, sought alone",
        "",
        "| data | size | targets | proposed | recall at IoU ≥ .5 | mean IoU | ADD-S < 10 % | and present |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    results = [(head, summarise(lines), lines) for head, lines in studies]
    for head, found, _ in results:
        for size in ("unknown", "known"):
            one = found[size]
            cells = [one["recall"], one["iou"], one["poses"], one["present"]]
            proposed = f"{one['proposed']:.2f}" if "proposed" in one else ""
            row = f"| {head['data']} | {size} | {one['targets']} | {proposed} | " + " | ".join(
                f"{x:.2f}" for x in cells
            )
            text.append(row + " |")
    text += [
        "",
        "Proposed: the share of targets of which a proposal has an IoU of .5 with the annotated mask, at least.",
        "",
        "## All objects sought in every image",
        "",
        "| data | objects | there | confidence from | right | misplaced | false, of absent ones | AP |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for head, found, _ in results:
        for least, counts in found["together"].items():
            text.append(
                f"| {head['data']} | {head['objects']} | {found['there']} | {least:g} | {counts['right']} | "
                f"{counts['misplaced']} | {counts['false']} | {found['ap']:.2f} |"
            )
    text += [
        "",
        "Size unknown. AP: average precision of poses, by score, over all objects and images of the data.",
        "",
        "## Cost",
        "",
        "| data | frame | each object | all objects | peak memory |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for head, found, _ in results:
        text.append(
            f"| {head['data']} | {found['frame']:.1f} s | {found['object']:.1f} s | {found['all']:.1f} s "
            f"({head['objects']}) | {found['memory']:.0f} MB |"
        )
    text += [
        "",
        "Processor seconds of all threads, warm, median of images; the first object costs frame + object.",
        "",
        "| stage, wall seconds in the mean image |" + "".join(f" {head['data']} |" for head, _, _ in results),
        "| --- |" + " ---: |" * len(results),
    ]
    for stage in dict.fromkeys(name for _, found, _ in results for name in found["stages"] if name != "compile"):
        text.append(f"| {stage} |" + "".join(f" {found['stages'].get(stage, 0):.2f} |" for _, found, _ in results))
    text += [
        "",
        "## Given masks made wrong",
        "",
        "| data | mask | targets | right | right, mended | IoU | IoU, mended |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for head, _, lines in results:
        for name, count, *cells in summarise_masks(lines):
            text.append(f"| {head['data']} | {name} | {count} | " + " | ".join(f"{x:.2f}" for x in cells) + " |")
    text += ["", "Mended: `ipjax estimate --mask-is-rough`. IoU is with the annotated mask.", ""]
    commands = " ".join(head["path"] for head, _, _ in results)
    text += [f"Command: `python -m benchmarks.detection {commands} --objects FOLDER --page PAGE`."]
    write_text(path, "\n".join(text) + "\n")


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing, write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detection", description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, nargs="+", metavar="DATA", help="in BOP layout")
    parser.add_argument("--objects", type=Path, required=True, metavar="FOLDER", help="object files, by number")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from where DATA has none")
    parser.add_argument("--weights", help="of the encoder")
    parser.add_argument("--output", type=Path, default=Path("out/detection"), help="folder of what was measured")
    parser.add_argument("--page", type=Path, help="the page, in Markdown")
    parser.add_argument("--views", type=int, help="templates of each object")
    options = parser.parse_args(arguments)
    use_compilation_cache()
    encoder = load_encoder(options.weights)
    detection = DetectConfig() if options.views is None else DetectConfig(views=options.views)
    studies = []
    for path in options.data:
        models = options.models if options.models is not None and not (path / "models").is_dir() else None
        dataset = Dataset(path, "test", models=models)
        bench = Bench(dataset, options.objects, encoder, detection, Config.fast())
        head = {
            "data": dataset.name,
            "path": path.name,
            "objects": len(bench.objects),
            "files": [info.content_sha256[:16] for _, info in bench.detector.estimator.objects],
            "views": detection.views,
            "encoder": encoder.identity,
            "code": hash_executed("ipjax.detection.detector", also=("ipjax.detection.rough",)),
            **describe_device(),
            "commit": commit(),
            "date": time.strftime("%Y-%m-%d"),
        }
        studies.append((head, measure(bench, head, options.output / f"{dataset.name}.jsonl")))
        if bench.missing:
            print(f"{dataset.name}: objects without a file were not sought: {bench.missing}")
    for head, lines in studies:
        print(json.dumps({head["data"]: summarise(lines)}, indent=1))
        for row in summarise_masks(lines):
            print(*row)
    if options.page is not None:
        write_page(options.page, studies)


def measure(bench: Bench, head: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """A line for each image; those that were made by the same code and settings are read, the others made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    same = lambda one: all(one.get(key) == head[key] for key in ("code", "views", "encoder", "files"))
    kept = [parse_json(line) for line in read_lines(path, repair=True)] if path.is_file() else []
    if not kept or not same(kept[0]):
        write_text(path, json.dumps(head) + "\n")
        kept = [head]
    lines = kept[1:]
    head.update(kept[0])
    done = {tuple(line["image"]) for line in lines}
    images = [image for image in bench.dataset.target_images if tuple(image) not in done]
    if images:
        frame = bench.dataset.frame(*images[0])
        sight = bench.detector.look(frame.rgb, frame.depth, frame.camera)  # compiles
        bench.detector.seek(sight, 0)
    for image in bar(images, desc=bench.dataset.name, unit=" images"):
        lines.append(bench.run(image))
        append_json(path, lines[-1])
    return lines


if __name__ == "__main__":
    main()
