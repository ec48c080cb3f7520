"""``python -m benchmarks.searches STUDY DATA --objects FOLDER``: what hints are worth where no mask is given.

Three studies, each a small one:

* ``hints``: in the frames of a data set in BOP layout, every target for which the folder has a file (obj_000001.ipjax)
  is sought with no hint, with a click, in the box of its annotated mask, and in that mask.
* ``instances``: two and three of one object in made scenes, apart and touching, sought with ``--instances``.
* ``masks``: the annotated masks made wrong, estimated as they are and with ``--mask-is-rough``.

What was measured is written to --output, a file for each study and data set; ``--page`` writes the page of all of them.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from benchmarks.detection import spoil
from benchmarks.measure import commit, describe_device
from ipjax import metrics
from ipjax.bop.alignments import read_alignment
from ipjax.bop.dataset import Dataset
from ipjax.config import Config
from ipjax.detection.assignment import overlap, shared_share
from ipjax.detection.crops import cut_crop
from ipjax.detection.detector import Detector
from ipjax.detection.rough import mend_mask
from ipjax.files.meshes.mesh import normalise
from ipjax.files.objects.loading import load
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.progress import bar
from ipjax.synthetic.scenes import make_scene
from ipjax.transforms import Similarity

RIGHT = 0.1  # diameters: ADD-S of a right pose
THRESHOLDS = np.arange(0.05, 0.51, 0.05)  # diameters: MSSD of BOP's recall
HINTS = ("nothing", "click", "box", "annotated mask")
SPOILT = ("as annotated", "widened by 6 px", "eroded by 6 px", "half missing", "a fifth of a neighbour")
STUDIES = ("hints", "instances", "masks")


class Bench:
    """A data set and a detector of some of its objects, sizes unknown."""

    def __init__(self, dataset: Dataset, files: dict[int, Path], alignments: dict[int, Path], encoder: Any):
        self.dataset, self.objects = dataset, sorted(files)
        loaded = [load(files[obj_id]) for obj_id in self.objects]
        known = [(templates, dataclasses.replace(info, metres_per_unit=None)) for templates, info in loaded]
        self.detector = Detector(known, encoder, Config.fast())
        self.alignments = {obj_id: read_alignment(path) for obj_id, path in alignments.items()}
        self.points = {obj_id: self._sample(obj_id) for obj_id in self.objects}

    def _sample(self, obj_id: int) -> np.ndarray:
        """Vertices of the model, metres."""
        vertices = np.asarray(self.dataset.mesh(obj_id).vertices, np.float64)
        return vertices[:: max(len(vertices) // 2000, 1)]

    def pose(self, obj_id: int, estimate: Any) -> Similarity:
        """``camera_from_model`` of an estimate: metres of the camera from metres of the annotated model; its scale is 1
        where the size is right."""
        info = self.detector.estimator.objects[self.objects.index(obj_id)][1]
        camera_from_mesh = estimate.camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
        if obj_id in self.alignments:
            return camera_from_mesh @ self.alignments[obj_id].inverse()
        return camera_from_mesh @ Similarity(np.eye(3), np.zeros(3), np.asarray(1e3))  # its files are in millimetres

    def judge(self, obj_id: int, estimate: Any, truth: Any) -> dict[str, Any]:
        """ADD-S and MSSD of an estimate in diameters; None where there is none."""
        if estimate is None or not bool(estimate.success):
            return {"add_s": None, "mssd": None, "confidence": 0.0}
        model, points = self.dataset.models()[obj_id], self.points[obj_id]
        pose, true = self.pose(obj_id, estimate), truth.camera_from_object
        add_s = cKDTree(pose @ points).query(true @ points)[0].mean() / model.diameter
        given = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (points, model.symmetries, true, pose))
        mssd = float(metrics.mssd(*given)) / model.diameter
        return {"add_s": float(add_s), "mssd": mssd, "confidence": float(estimate.confidence)}

    def targets(self, images: slice, apart: bool = False) -> Iterator[tuple[Any, int, Any, dict[int, np.ndarray]]]:
        """Frame, object and truth of every target, and all masks of its image; ``apart``: one image of each scene."""
        chosen = self.dataset.target_images
        if apart:
            chosen = list({scene: (scene, image) for scene, image in reversed(chosen)}.values())[::-1]
        for image in bar(chosen[images], desc=self.dataset.name, unit=" images"):
            frame = self.dataset.frame(*image)
            truths = {one.obj_id: one for one in self.dataset.truths(*image)}
            masks = {obj_id: self.dataset.mask(*image, one.index) for obj_id, one in truths.items()}
            for row in self.dataset.targets_by_image()[image]:
                if row.obj_id in self.objects:
                    yield frame, row.obj_id, truths[row.obj_id], masks


def try_hints(bench: Bench, images: slice) -> list[dict[str, Any]]:
    """A line for each target."""
    detector, lines, sights = bench.detector, [], {}
    for frame, obj_id, truth, masks in bench.targets(images):
        index, mask = bench.objects.index(obj_id), masks[obj_id]
        about = frame.rgb, frame.depth, frame.camera
        key = id(frame)
        if key not in sights:
            sights = {key: detector.look(*about)}  # of this frame, for all of its objects
        line: dict[str, Any] = {"obj_id": obj_id}
        for hint in HINTS:
            if hint in ("nothing", "click"):
                click = find_middle(mask) if hint == "click" else None
                sight = sights[key] if click is None else detector.look(*about, at=[click])
                claims, rejected = detector.seek(sight, index, click=click)
                found = detector.choose(sight, claims, rejected)
                estimate = found[0].result.estimate if len(found) else None
                told = {"iou": overlap(found[0].mask, mask) if len(found) else 0.0}
            else:
                given = mask if hint != "box" else np.zeros_like(mask)
                x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
                given[y : y + height, x : x + width] |= hint == "box"
                crop = cut_crop(sights[key].scene, given, **detector.options)
                run = detector.estimator.run
                estimate = None if crop is None else run(index, crop.view, crop.camera_from_crop).estimate
                told = {"iou": overlap(given, mask)}
            line[hint] = told | bench.judge(obj_id, estimate, truth)
        lines.append(line)
    return lines


def find_middle(mask: np.ndarray) -> tuple[float, float]:
    """The pixel of a mask that is farthest from its border: where a person would click."""
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.unravel_index(int(distance.argmax()), mask.shape)
    return float(x), float(y)


def try_instances(bench: Bench, seeds: int) -> list[dict[str, Any]]:
    """A line for each made scene."""
    lines = []
    cases = [(seed, number, t) for seed in range(seeds) for number in (2, 3) for t in (False, True)]
    for obj_id in bench.objects:
        mesh = normalise(bench.dataset.mesh(obj_id, "models"))
        size = bench.dataset.models()[obj_id].diameter
        for seed, count, touching in bar(cases, desc=f"object {obj_id}", unit=" scenes"):
            about = {"sizes": [size] * count, "clutter": 2, "touching": touching}
            scene = make_scene([mesh] * count, 100 * obj_id + seed, **about)
            lines.append({"obj_id": obj_id, "count": count, "touching": touching, "seed": seed})
            lines[-1] |= _count_instances(bench, bench.objects.index(obj_id), scene, count)
    return lines


def _count_instances(bench: Bench, index: int, scene: Any, count: int) -> dict[str, Any]:
    """What is found of those that are seen by half, at least; and how often one is found twice, or nothing is there."""
    detector, start = bench.detector, time.process_time()
    sight = detector.look(scene.rgb, scene.depth, scene.matrix)
    claims, rejected = detector.seek(sight, index, instances=count)
    found = detector.choose(sight, claims, rejected, instances=count)
    spent = time.process_time() - start
    points = np.asarray(detector.estimator.objects[index][0].surface.points, np.float64)
    told: list[dict[str, Any]] = []
    owners = []
    for one in found:
        errors = []
        for true in scene.camera_from_object:
            placed = one.result.estimate.camera_from_object.to_numpy() @ points
            errors.append(cKDTree(placed).query(true.to_numpy() @ points)[0].mean() / float(true.scale))
        shares = [shared_share(one.mask, mask) for mask in scene.masks]
        best = int(np.argmax(shares))
        owners.append(best if shares[best] > 0.5 else None)
        told.append({"owner": owners[-1], "error": min(errors), "confidence": one.confidence, "present": one.present})
    seen = [number for number, share in enumerate(scene.visible) if share >= 0.5]
    right = lambda number: any(one["owner"] == number and one["error"] < RIGHT for one in told)
    sure = lambda number: any(one["owner"] == number and one["error"] < RIGHT and one["present"] for one in told)
    present = [one["owner"] for one in told if one["present"]]
    return {
        "seen": len(seen),
        "masks": sum(number in owners for number in seen),
        "right": sum(right(number) for number in seen),
        "present": sum(sure(number) for number in seen),
        "duplicates": sum(owners.count(number) > 1 for number in range(count)),
        "false": sum(owner is None for owner in present),
        "proposed": sum(
            max((overlap(mask, scene.masks[number]) for mask in sight.proposals.masks), default=0) >= 0.5
            for number in seen
        ),
        "cpu": spent,
        "detections": told,
    }


def try_masks(bench: Bench, images: slice) -> list[dict[str, Any]]:
    """A line for each target."""
    detector, lines, sights = bench.detector, [], {}
    for frame, obj_id, truth, masks in bench.targets(images, apart=True):
        index = bench.objects.index(obj_id)
        key = id(frame)
        if key not in sights:
            sights = {key: detector.look(frame.rgb, frame.depth, frame.camera)}
        others = [mask for other, mask in masks.items() if other != obj_id]
        line: dict[str, Any] = {"obj_id": obj_id}
        for name, given in spoil(masks[obj_id], others, eroded=6).items():
            start = time.process_time()
            mended = mend_mask(detector, index, sights[key], given)
            spent = time.process_time() - start
            kinds = [("before", None, given), ("after", None, given)]
            if mended is not None:
                kinds = [("before", mended.first.estimate, given), ("after", mended.result.estimate, mended.mask)]
            told = {
                when: bench.judge(obj_id, found, truth) | {"iou": overlap(mask, masks[obj_id])}
                for when, found, mask in kinds
            }
            line[name] = told | {"cpu": spent}
        lines.append(line)
    return lines


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Of judged estimates: share of right poses, BOP's average recall of MSSD, share right and sure, mean IoU."""
    add_s = np.array([np.inf if one["add_s"] is None else one["add_s"] for one in rows])
    mssd = np.array([np.inf if one["mssd"] is None else one["mssd"] for one in rows])
    sure = np.array([one["confidence"] for one in rows]) >= Config().confidence.least
    return {
        "right": float((add_s < RIGHT).mean()),
        "ar": float((mssd[:, None] < THRESHOLDS).mean()),
        "sure": float(((add_s < RIGHT) & sure).mean()),
        "iou": float(np.mean([one["iou"] for one in rows])),
    }


def write_page(path: Path, studies: list[dict[str, Any]]) -> None:
    """The page, in Markdown."""
    text = ["# Searches with hints, several instances, and masks that are wrong", ""]
    text += ["Made by `python -m benchmarks.searches`; do not edit by hand.", ""]
    text += [
        "Small studies: a handful of frames each, sizes unknown, poses with `Config.fast()`. A pose is right where"
    ]
    text += [
        f"ADD-S is less than {RIGHT:.0%} of the diameter; AR is BOP's average recall of MSSD, the size included.",
        "",
    ]
    of = lambda study: [one for one in studies if one["study"] == study]
    row = lambda *cells: "| " + " | ".join(str(cell) for cell in cells) + " |"
    if of("hints"):
        text += ["## What a hint is worth", ""]
        text += [row("data", "targets", "hint", "right", "right and present", "AR", "mean IoU")]
        text += ["| --- | ---: | --- | ---: | ---: | ---: | ---: |"]
        for one in of("hints"):
            for hint in HINTS:
                told = summarise([line[hint] for line in one["lines"]])
                cells = [f"{told[key]:.2f}" for key in ("right", "sure", "ar", "iou")]
                text.append(row(one["data"], len(one["lines"]), hint, *cells))
        text += [
            "",
            "The click is on the pixel of the annotated mask that is farthest from its border, the box is that",
        ]
        text += ["mask's. With nothing and a click IoU is that of the mask that was found, else of what was given.", ""]
    if of("instances"):
        text += ["## Several of one object in made scenes", ""]
        text += [row("count", "touching", "scenes", "seen", "proposed", "mask", "right", "present", "twice", "false")]
        text += ["| ---: | --- | " + " | ".join(["---:"] * 8) + " |"]
        lines = [line for one in of("instances") for line in one["lines"]]
        for count in (2, 3):
            for touching in (False, True):
                mine = [one for one in lines if (one["count"], one["touching"]) == (count, touching)]
                if mine:
                    keys = ("seen", "proposed", "masks", "right", "present", "duplicates", "false")
                    totals = [sum(one[key] for one in mine) for key in keys]
                    text.append(row(count, "yes" if touching else "no", len(mine), *totals))
        objects = sorted({line["obj_id"] for line in lines})
        text += [
            "",
            f"Objects {', '.join(map(str, objects))} of YCB-V, on a made table, with `--instances` of the count.",
        ]
        text += [
            "Seen: those of which half, at least, is seen. Proposed: a proposal has an IoU of .5. Mask: a detection"
        ]
        text += [
            "lies on it. Right: with a right pose. Twice: more than one detection lies on it. False: present, on none."
        ]
        text += [""]
    if of("masks"):
        text += ["## Given masks made wrong", ""]
        text += [row("data", "mask", "targets", "AR", "AR, mended", "right", "right, mended", "IoU", "IoU, mended")]
        text += ["| --- | --- | " + " | ".join(["---:"] * 7) + " |"]
        for one in of("masks"):
            for name in SPOILT:
                mine = [line[name] for line in one["lines"] if name in line]
                if not mine:
                    continue
                told = [summarise([line[key] for line in mine]) for key in ("before", "after")]
                cells = [f"{each[key]:.2f}" for key in ("ar", "right", "iou") for each in told]
                text.append(row(one["data"], name, len(mine), *cells))
            cost = np.median([line[name]["cpu"] for line in one["lines"] for name in SPOILT if name in line])
            text += [
                "",
                f"Mended: `ipjax estimate --mask-is-rough`, {cost:.0f} processor seconds, the estimate included.",
            ]
        text += ["One frame of each scene. IoU is with the annotated mask.", ""]
    text += ["## How", ""]
    for one in studies:
        head = one["head"]
        about = f"{head['device']}, {head['cores']} cores, jax {head['jax']}, commit {head['commit']}, {head['date']}"
        text += [f"* {one['study']}, {one['data']}: {about}:", f"  `{head['command']}`."]
    write_text(path, "\n".join(text) + "\n")


def parse_file(text: str) -> tuple[int, Path]:
    """``5=FILE``."""
    number, _, path = text.partition("=")
    return int(number), Path(path)


def main(arguments: list[str] | None = None) -> None:
    """Measure, and write what was found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.searches", description=__doc__.split("\n")[0])
    parser.add_argument("study", choices=(*STUDIES, "page"))
    parser.add_argument("data", type=Path, nargs="?", metavar="DATA", help="in BOP layout")
    parser.add_argument("--objects", type=Path, metavar="FOLDER", help="object files, by number")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="these objects")
    parser.add_argument("--object", type=parse_file, nargs="+", default=[], metavar="N=FILE", help="other object files")
    parser.add_argument("--alignment", type=parse_file, nargs="+", default=[], metavar="N=JSON", help="of their meshes")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from where DATA has none")
    parser.add_argument("--images", type=int, metavar="N", help="the first N images (of masks: of scenes)")
    parser.add_argument("--skip", type=int, default=0, metavar="N", help="but for these first ones")
    parser.add_argument("--seeds", type=int, default=1, help="made scenes of each kind")
    parser.add_argument("--weights", help="of the encoder")
    parser.add_argument("--name", help="of the data, on the page")
    parser.add_argument("--output", type=Path, default=Path("out/searches"), help="folder of what was measured")
    parser.add_argument("--page", type=Path, help="the page, in Markdown, of all that is in --output")
    options = parser.parse_args(arguments)
    if options.study != "page":
        measure(options, parser)
    if options.page is not None:
        order = lambda one: (STUDIES.index(one["study"]), one["data"])
        studies = [json.loads(path.read_text()) for path in options.output.glob("*.json")]
        write_page(options.page, sorted(studies, key=order))


def measure(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """One study on one data set."""
    if options.data is None or (options.objects is None and not options.object):
        parser.error("a study needs DATA, and --objects or --object")
    use_compilation_cache()
    models = options.models if options.models is not None and not (options.data / "models").is_dir() else None
    dataset = Dataset(options.data, "test", models=models)
    files = {}
    for obj_id in dataset.models():
        path = None if options.objects is None else options.objects / f"obj_{obj_id:06d}.ipjax"
        if path is not None and path.is_file() and (options.only is None or obj_id in options.only):
            files[obj_id] = path
    files |= dict(options.object)
    bench = Bench(dataset, files, dict(options.alignment), load_encoder(options.weights))
    if options.study == "hints":
        lines = try_hints(bench, slice(options.skip, options.images))
    elif options.study == "instances":
        lines = try_instances(bench, options.seeds)
    else:
        lines = try_masks(bench, slice(options.skip, options.images))
    name = options.name or dataset.name
    words = [f"python -m benchmarks.searches {options.study} {options.data.name}", "--objects FOLDER"]
    words += [f"--only {' '.join(map(str, options.only))}"] if options.only else []
    words += [f"--object {options.object[0][0]}=FILE --alignment {options.object[0][0]}=JSON"] if options.object else []
    words += [f"--images {options.images}"] if options.images else []
    words += [f"--skip {options.skip}"] if options.skip else []
    words += [f"--seeds {options.seeds}"] if options.study == "instances" else []
    head = {**describe_device(), "commit": commit(), "date": time.strftime("%Y-%m-%d"), "command": " ".join(words)}
    options.output.mkdir(parents=True, exist_ok=True)
    found = {"study": options.study, "data": name, "head": head, "lines": lines}
    write_text(options.output / f"{options.study}_{name.replace(' ', '_')}.json", json.dumps(found, indent=1) + "\n")
    for line in lines:
        print(json.dumps(line))


if __name__ == "__main__":
    main()
