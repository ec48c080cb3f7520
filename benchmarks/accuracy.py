"""``python -m benchmarks.accuracy DATA [--config both]``: errors of every target, and their medians.

For each target of a data set in BOP layout, with its annotated mask and the object onboarded from its scan (so that the
scale is unknown): rotation error (degrees, to the nearest symmetric pose), translation error (mm), scale error (%),
ADD-S / diameter; `Config()` next to `Config.paper()`. Results stay in ``--output``: if killed, call it again.

``--mesh 5=mesh.obj --alignment 5=map.json --models ycbv`` does the same for a reconstructed mesh, through the
evaluation-only alignment, tells the angle between the estimated and the true long axis, and draws the overlay.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np

from benchmarks.measure import describe_device
from ipjax.bop.dataset import Dataset
from ipjax.bop.estimator import DatasetEstimator
from ipjax.bop.evaluation import evaluate
from ipjax.bop.objects import OnboardedObject, parse_numbered, prepare_objects
from ipjax.bop.records import MM
from ipjax.bop.results import read_results
from ipjax.bop.scoring.summaries import Score
from ipjax.files.settings import read_config
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.compilation_cache import use_compilation_cache


def run(
    dataset: Dataset, objects: dict[int, OnboardedObject], encoder, config: str, output: Path, *, keep: bool = False
) -> tuple[Score, DatasetEstimator]:
    """The score of one configuration, and what found it."""
    estimator = DatasetEstimator(objects, encoder, read_config(config), keep=keep)
    found = evaluate(
        dataset,
        list(objects),
        estimator,
        output / Path(config).stem,
        method=f"ipjax-{Path(config).stem}",
        settings=estimator.settings(),
        alignments=estimator.alignments,
        aligned_by=estimator.aligned_by,
        metrics=("mssd", "mspd", "add", "add_s"),
        on_error="skip",
    )
    return found, estimator


def cells(instance, diameter: float) -> list[str]:
    """One target in one configuration: rotation, translation, scale, ADD-S."""
    if not instance.found:
        return ["–"] * 4
    scale = "–" if math.isnan(instance.scale) else f"{100 * instance.scale:.1f}"
    return [
        f"{math.degrees(instance.rotation):.1f}",
        f"{instance.translation / MM:.1f}",
        scale,
        f"{100 * instance.add_s / diameter:.1f}" if math.isfinite(instance.add_s) else "far",
    ]


def summary(found: Score, diameters: dict[int, float]) -> dict[str, float]:
    """Medians over all targets, one that was not found counting as infinitely wrong, and shares of all targets."""
    all_of = found.instances
    share = np.array([i.add_s / diameters[i.obj_id] for i in all_of])
    return {
        "targets": len(all_of),
        "rotation_deg": float(np.degrees(np.median([i.rotation for i in all_of]))),
        "translation_mm": float(np.median([i.translation for i in all_of]) / MM),
        "scale_percent": float(100 * np.median([math.inf if math.isnan(i.scale) else i.scale for i in all_of])),
        "add_s_percent_of_diameter": float(100 * np.median(share)),
        "add_s_below_10_percent": float(100 * np.mean(share < 0.1)),
    }


def long_axis_error(dataset: Dataset, row) -> float:
    """Degrees between the longest axis of the model at the estimate and at the truth, whichever end is up."""
    points = np.asarray(dataset.mesh(row.obj_id).vertices, np.float64)
    axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    truth = next(t for t in dataset.truths(row.scene_id, row.im_id) if t.obj_id == row.obj_id)
    cosine = abs(float((np.reshape(row.rotation, (3, 3)) @ axis) @ (truth.rotation @ axis)))
    return math.degrees(math.acos(min(cosine, 1.0)))


def main() -> None:
    """Run, print, and write the figures where asked to."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--config", default="both", help="default, paper, both, or a file of settings")
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("--objects", default="auto", help="folder of object files; missing ones are added")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from")
    parser.add_argument("--only", type=int, nargs="+", help="only these objects")
    parser.add_argument("--mesh", action="append", metavar="N=FILE")
    parser.add_argument("--alignment", action="append", metavar="N=JSON")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/accuracy"))
    parser.add_argument("--json", type=Path, help="write the medians here")
    options = parser.parse_args()
    use_compilation_cache()
    dataset = Dataset(options.data, models=options.models)
    encoder = load_encoder(options.weights)
    print(f"encoder: {encoder.identity}")
    meshes = parse_numbered(options.mesh, "--mesh")
    objects = prepare_objects(
        dataset,
        encoder,
        folder=None if options.objects == "auto" else options.objects,
        objects=options.only,
        meshes=meshes,
        alignments=parse_numbered(options.alignment, "--alignment"),
    )
    configs = ["default", "paper"] if options.config == "both" else [options.config]
    diameters = {obj_id: dataset.models()[obj_id].diameter for obj_id in objects}
    output = options.output / options.data.name
    runs = {Path(c).stem: run(dataset, objects, encoder, c, output, keep=bool(meshes)) for c in configs}
    heads = ["rot °", "trans mm", "scale %", "ADD-S %d"]
    print(f"{'scene':>5} {'image':>6} {'object':>6} " + " | ".join(f"{c}: {', '.join(heads)}" for c in runs))
    by_config = [score.instances for score, _ in runs.values()]
    for instances in zip(*by_config, strict=True):
        one = instances[0]
        cells_text = " | ".join(" ".join(f"{c:>8}" for c in cells(i, diameters[i.obj_id])) for i in instances)
        print(f"{one.scene_id:>5} {one.im_id:>6} {one.obj_id:>6} {cells_text}")
    figures = {name: summary(score, diameters) for name, (score, _) in runs.items()}
    for name, entry in figures.items():
        print(
            f"{name}: medians over {entry['targets']} targets: rotation {entry['rotation_deg']:.1f}°, translation "
            f"{entry['translation_mm']:.1f} mm, scale {entry['scale_percent']:.1f} %, ADD-S "
            f"{entry['add_s_percent_of_diameter']:.1f} % of the diameter, below 10 % for "
            f"{entry['add_s_below_10_percent']:.0f} % of the targets"
        )
        for note in runs[name][0].notes:
            print(f"  note: {note}")
    for name in runs if meshes else []:
        print_reconstruction(dataset, *runs[name], name, output)
    if options.json:
        record = {**describe_device(), "encoder": encoder.identity, "data": options.data.name, "figures": figures}
        write_text(options.json, json.dumps(record, indent=1) + "\n", parents=True)


def print_reconstruction(dataset: Dataset, found: Score, estimator: DatasetEstimator, name: str, output: Path) -> None:
    """ADD-S and the long axis of what was found from a reconstructed mesh, and its picture."""
    from ipjax.inference.drawing import draw, gather_evidence, write_image

    rows = {(r.scene_id, r.im_id, r.obj_id): r for r in read_results(next((output / name).glob("*.csv")))}
    for one in found.instances:
        key = (one.scene_id, one.im_id, one.obj_id)
        if key not in rows:
            print(f"{name}: object {one.obj_id} was not found")
            continue
        print(
            f"{name}: object {one.obj_id}, ADD-S {one.add_s / MM:.1f} mm, long axis off by "
            f"{long_axis_error(dataset, rows[key]):.1f}°"
        )
        if key in estimator.results:  # not where a finished run was only read again
            result, frame = estimator.results[key], dataset.frame(*key[:2])
            evidence = gather_evidence(
                result.templates, result.query, result.crop_estimate, result.info, estimator.estimator.config
            )
            path = output / f"{name}_{one.scene_id:06d}_{one.im_id:06d}_{one.obj_id:06d}.png"
            write_image(path, draw(frame.rgb, frame.camera, [result.estimate], [result.info], [evidence]))
            print(f"  picture: {path}")


if __name__ == "__main__":
    main()
