"""Meshes that an image-to-3D model made, with the photo they were made from against without.

    python -m benchmarks.reconstructions made [--objects 6]
    python -m benchmarks.reconstructions real --data ../shared/data
    python -m benchmarks.reconstructions page

``made``: objects made in code, whose mesh is what such models do to one (level 3 of `ipjax.synthetic.degradation`: the
back is the mirrored front), and a photo of the true object from where the mesh is accurate. Tells how well the photo's
camera is found, how a photo of another object compares, and how each object is found on a cluttered table with several
values of ``score.invented``. Defaults and thresholds are chosen on these.

``real``: SAM 3D's meshes of YCB objects and InstantMesh's mustard bottle, sought in the frames of the data sets that
show them. Only the banana and the bottle have their photo. ``page`` writes benchmarks/results/reconstructions.md.
"""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import commit
from ipjax.config import ConfidenceConfig, Config, OnboardConfig
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.transforms import Similarity, rotation_from_vector

INVENTED = (0.0, 0.25)  # values of ``score.invented`` that are compared
QUERIES = 4  # of each made object


def without_photo(templates: Any) -> Any:
    """The same templates as the mesh alone gives."""
    plain = dataclasses.replace(templates, seen=jnp.ones_like(templates.seen), photo_centre=None)
    surface = dataclasses.replace(
        plain.surface, seen=jnp.ones_like(plain.surface.seen), along_std=None, across_std=None
    )
    return dataclasses.replace(plain, surface=surface)


def turned_by(first: np.ndarray, second: np.ndarray) -> float:
    """Degrees between two rotations."""
    return float(np.degrees(np.arccos(np.clip((np.trace(first.T @ second) - 1) / 2, -1, 1))))


def photograph(
    mesh: Any, front: np.ndarray, lens: Any, seed: int
) -> tuple[np.ndarray, np.ndarray, Similarity[np.ndarray]]:
    """The object alone, seen from within 15° of a direction of its frame: colours, mask, camera_from_object."""
    from ipjax.rendering.render import render_scene
    from ipjax.synthetic.scenes import HEIGHT, WIDTH
    from ipjax.synthetic.sensor import Sensor, expose

    rng = np.random.default_rng([seed, 31])
    ahead = -front / np.linalg.norm(front)
    right = np.cross(rng.normal(size=3), ahead)
    right /= np.linalg.norm(right)
    straight = np.stack([right, np.cross(ahead, right), ahead])
    way, angle = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, 15))
    rotation = rotation_from_vector(angle * np.array([np.cos(way), np.sin(way), 0.0])) @ straight
    pose = Similarity(rotation, np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(3.0, 4.5)]), np.ones(()))
    light = {"direction": [*rng.normal(size=2) * 0.5, 1.0], "ambient": 0.6, "diffuse": 0.45}
    drawn = render_scene([(mesh, pose.to_jax())], lens, HEIGHT, WIDTH, light=light)
    mask = np.asarray(drawn.mask[0])
    rgb = np.where(mask[..., None], drawn.rgb[0], 128).astype(np.uint8)
    return expose(rng, rgb, Sensor()), mask, pose


def run_made(output: Path, objects: int, weights: str | None) -> None:
    """Write a line for every photo and one for every search; lines that are there are not made again."""
    from ipjax.files.meshes.cleaning import clean
    from ipjax.files.meshes.mesh import normalise
    from ipjax.files.weights.encoder import load_encoder
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.estimator import Estimator
    from ipjax.onboarding.mesh import onboard
    from ipjax.onboarding.photo_camera import locate_photo
    from ipjax.onboarding.photographed import mark_seen
    from ipjax.synthetic.degradation import degrade
    from ipjax.synthetic.objects import KINDS, make_object
    from ipjax.synthetic.scenes import make_scene

    done = {tuple(parse_json(line)["key"]) for line in read_lines(output)} if output.exists() else set()
    use_compilation_cache()
    encoder = load_encoder(weights)
    estimator = Estimator([], encoder)
    config = OnboardConfig(directions=24, rolls=8)  # fewer than by default, for speed
    past: tuple | None = None
    for index in range(objects):
        kind = KINDS[index % len(KINDS)]
        name = f"{kind}-{index}"
        if (name, "end") in done:
            continue
        mesh, other = make_object(kind, 7000 + index), make_object(KINDS[(index + 3) % len(KINDS)], 8000 + index)
        worse, back = degrade(mesh, 3, index)
        templates, info = onboard(worse, encoder, config, progress=False)
        unit = normalise(clean(worse)[0])
        seen = worse.seen > 0.5
        front = back.rotation @ (worse.vertices[seen].mean(0) - worse.vertices[~seen].mean(0))
        scenes = [
            make_scene([mesh, other], seed=70_000 + 100 * index + k, sizes=[0.15, 0.12], clutter=2)
            for k in range(QUERIES)
        ]
        lens = scenes[0].camera
        rgb, mask, pose = photograph(mesh, front, lens, index)
        true = pose @ back @ info.object_from_mesh.to_numpy().inverse()
        given: dict[str, Any] = {"resolution": config.resolution, "fill": config.fill, "camera_given": True}
        start = time.perf_counter()
        found = locate_photo(templates, unit, encoder, rgb, mask, lens.to_matrix(), **given)
        row = {
            "key": [name, "camera"],
            "degrees": turned_by(found.camera_from_object.rotation, true.rotation),
            "overlap": found.overlap,
            "fit": found.fit,
            "commit": commit(),
            "seconds": time.perf_counter() - start,
        }
        if past is not None:  # the photo of the object before
            wrong = locate_photo(templates, unit, encoder, past[0], past[1], past[2], **given)
            row["other"] = [wrong.overlap, wrong.fit]
        past = rgb, mask, lens.to_matrix()
        marked = mark_seen(templates, unit, found, mask)
        truth = np.asarray(worse.seen)
        row["seen"] = [float(np.asarray(marked.surface.seen).mean()), float(truth.mean())]
        append_json(output, row)
        print(row, flush=True)
        bodies = {"without": (without_photo(marked), Config())}
        for value in INVENTED:
            bodies[f"{value:g}"] = marked, eqx.tree_at(lambda c: c.score.invented, Config(), value)
        for k, scene in enumerate(scenes):
            if scene.masks[0].sum() < 400:
                continue
            for method, (body, settings) in bodies.items():
                estimator.objects, estimator.config = [(body, info)], settings
                crop = estimator.frame(0, scene.rgb, scene.depth, scene.masks[0], scene.camera)
                result = estimator.run(0, *crop)
                found_pose = result.estimate.camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
                found_pose = found_pose @ back.inverse()
                right = scene.camera_from_object[0].to_numpy()
                offset = (found_pose @ mesh.vertices - right @ mesh.vertices) / float(right.scale)
                parts = result.crop_estimate.agreement
                row = {
                    "key": [name, method, k],
                    "degrees": turned_by(found_pose.rotation, right.rotation),
                    "add": float(np.linalg.norm(offset, axis=1).mean()),
                    "confidence": float(result.estimate.confidence),
                    "agreement": [float(getattr(parts, f.name)) for f in dataclasses.fields(parts)],
                }
                append_json(output, row)
                text = f"{row['degrees']:.0f}°, ADD {row['add']:.2f}, confidence {row['confidence']:.2f}"
                print(name, method, k, text, flush=True)
        append_json(output, {"key": [name, "end"]})


# object: its mesh, the alignment to the scan, and its photo with mask and camera, in the folder of shared data
MESHES = {
    4: ("lrm/sam3d/soup_a/soup_a.obj", "lrm/sam3d/soup_a/soup_a_to_obj_000004.json", None),
    16: ("lrm/sam3d/wood_b/wood_b.obj", "lrm/sam3d/wood_b/wood_b_to_obj_000016.json", None),
    10: (
        "lrm/sam3d/banana/banana.obj",
        "lrm/sam3d/banana/banana_to_obj_000010.json",
        ("lrm/sam3d/source_scenes/test/000001", "mask_visib/000000_000000.png"),
    ),
    5: (
        "dexycb/instantmesh_mustard.obj",
        "dexycb/instantmesh_mustard_to_obj_000005.json",
        ("dexycb/test/000000", "mask_visib/000000_000000.png"),
    ),
}
DATASETS = ("ycbv", "realsense", "dexycb")


def run_real(data: Path, output: Path, weights: str | None) -> None:
    """Seek every reconstructed mesh, without its photo and with it where there is one, in all frames that show it."""
    from ipjax.bop.alignments import read_alignment
    from ipjax.bop.dataset import Dataset
    from ipjax.bop.estimator import DatasetEstimator
    from ipjax.bop.evaluation import evaluate
    from ipjax.bop.objects import OnboardedObject
    from ipjax.bop.records import MM
    from ipjax.files.cameras.reading import read_camera
    from ipjax.files.meshes.cleaning import clean
    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.mesh import normalise
    from ipjax.files.objects.loading import load
    from ipjax.files.objects.saving import save
    from ipjax.files.weights.encoder import load_encoder
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.onboarding.mesh import onboard
    from ipjax.onboarding.photo import prepare_photo
    from ipjax.onboarding.photographed import add_photo

    use_compilation_cache()
    encoder = load_encoder(weights)
    lines = output / "real.jsonl"
    done = {tuple(parse_json(line)["key"]) for line in read_lines(lines)} if lines.exists() else set()
    for number, (mesh, alignment, photo) in MESHES.items():
        for method in ("without", "with") if photo else ("without",):
            path = output / f"{Path(mesh).stem}_{method}.ipjax"
            if not path.is_file() and method == "without":
                onboard(data / mesh, encoder, out=path, progress=False)
            elif not path.is_file() and photo is not None:
                folder = data / photo[0]
                rgb, camera = folder / "rgb/000000.png", read_camera(folder / "scene_camera.json", 0)
                prepared = prepare_photo(rgb, mask=folder / photo[1], camera=camera)
                alone = load(output / f"{Path(mesh).stem}_without.ipjax", encoder)
                save(path, *add_photo(*alone, normalise(clean(load_mesh(data / mesh))[0]), prepared, encoder, rgb))
            for name in DATASETS:
                dataset = Dataset(data / name, models=None if name == "ycbv" else data / "ycbv")
                if number not in {target.obj_id for target in dataset.targets} or (name, number, method) in done:
                    continue
                one = OnboardedObject(number, path, read_alignment(data / alignment), Path(alignment).name)
                estimator = DatasetEstimator({number: one}, encoder, Config(), keep=True)
                found = evaluate(
                    dataset,
                    [number],
                    estimator,
                    output / name / f"{number}_{method}",
                    method="ipjax-default",
                    settings=estimator.settings(),
                    alignments=estimator.alignments,
                    aligned_by=estimator.aligned_by,
                    metrics=("mssd", "add_s"),
                    on_error="skip",
                    restart="always",
                )
                rows = []
                for instance in found.instances:
                    key = instance.scene_id, instance.im_id, instance.obj_id
                    result = estimator.results.get(key)
                    rows.append(
                        {
                            "frame": f"{instance.scene_id}/{instance.im_id}",
                            "add_s_mm": instance.add_s / MM if instance.found else None,
                            "degrees": float(np.degrees(instance.rotation)) if instance.found else None,
                            "confidence": 0.0 if result is None else float(result.estimate.confidence),
                            "seen": 0.0 if result is None else float(result.estimate.agreement.seen),
                        }
                    )
                row = {"key": [name, number, method], "mesh": Path(mesh).name, "rows": rows, "commit": commit()}
                append_json(lines, row)
                print(name, number, method, rows, flush=True)


def confidence(agreement: list[float], with_photo: bool) -> float:
    """By the settings that the code has now, whatever they were when the pose was found."""
    from ipjax.estimation.confidence import probability
    from ipjax.records import Agreement

    settings = ConfidenceConfig()
    weights = np.array(settings.drawn)
    if with_photo:
        weights += settings.invented * np.array([-1, 0, 0, 0, 0, 1, 0])
    return float(probability(Agreement(*map(jnp.asarray, agreement)), jnp.asarray(weights)))


def tell_made(made: list[dict[str, Any]]) -> list[str]:
    """The part of the page about objects made in code."""
    cameras = [row for row in made if row["key"][1] == "camera"]
    text = [
        "## The photo's camera, found relative to the mesh",
        "",
        "Objects made in code, as such a model returns them (`degrade`, level 3), and a photo of the true object from "
        "within 15° of where the mesh is accurate. *Other*: the same for the photo of another object.",
        "",
        "| object | off by ° | features | outline | other: features | other: outline | surface seen % |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in cameras:
        other = [f"{x:.2f}" for x in row.get("other", [])] or ["–", "–"]
        figures = [f"{row['degrees']:.1f}", f"{row['overlap']:.2f}", f"{row['fit']:.2f}", *other]
        text.append(f"| {row['key'][0]} | {' | '.join(figures)} | {100 * row['seen'][0]:.0f} |")
    text += [
        "",
        "## These objects on cluttered tables",
        "",
        "| photo, `score.invented` | searches | within 15° | ADD < 10 % | called present | of them ADD < 10 % |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    searches = [row for row in made if "add" in row]
    for method in dict.fromkeys(row["key"][1] for row in searches):
        rows = [row for row in searches if row["key"][1] == method]
        right = np.array([r["add"] < 0.1 for r in rows])
        sure = np.array([confidence(r["agreement"], method != "without") for r in rows]) >= ConfidenceConfig().least
        turned = np.mean([r["degrees"] < 15 for r in rows])
        text.append(
            f"| {method} | {len(rows)} | {turned:.0%} | {right.mean():.0%} | {sure.mean():.0%} | "
            f"{right[sure].mean() if sure.any() else float('nan'):.0%} |"
        )
    return [*text, ""]


def write_page(output: Path, page: Path) -> None:
    """The figures of both runs in Markdown."""
    read = lambda name: [parse_json(line) for line in read_lines(output / name)] if (output / name).exists() else []
    made, real = read("made.jsonl"), read("real.jsonl")
    states = ", ".join(dict.fromkeys(row["commit"] for row in [*made, *real] if "commit" in row)) or "unknown"
    text: list[str] = [
        "# Meshes that an image-to-3D model made, with their photo against without",
        "",
        f"Made by `python -m benchmarks.reconstructions`, measured at commit {states}; do not edit by hand.",
        "",
    ]
    if made:
        text += tell_made(made)
    text += [
        "## Real reconstructions",
        "",
        "Every frame that shows the object, annotated masks. ADD-S after the evaluation-only alignment; degrees count "
        "the symmetries that the data set names. The photos of the soup can and the wood block are not at hand.",
        "",
        "| data | mesh | frame | ADD-S mm: without | with | degrees: without | with | confidence: without | with |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    plain = {(row["key"][0], row["key"][1]): row for row in real if row["key"][2] == "without"}
    cell = lambda value, digits: "–" if value is None else f"{value:.{digits}f}"
    for (name, number), row in plain.items():
        beside = next((r for r in real if r["key"] == [name, number, "with"]), None)
        for index, one in enumerate(row["rows"]):
            both = [one, beside["rows"][index] if beside else {}]
            parts = [("add_s_mm", 1), ("degrees", 0), ("confidence", 2)]
            cells = [cell(each.get(part), digits) for part, digits in parts for each in both]
            text.append(f"| {name} | {row['mesh']} | {one['frame']} | {' | '.join(cells)} |")
    write_text(page, "\n".join(text) + "\n")


def main() -> None:
    """Measure what is asked for, or write the page."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.reconstructions", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("what", choices=("made", "real", "page"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="the shared data, for real")
    parser.add_argument("--objects", type=int, default=6, help="made in code")
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/reconstructions"))
    parser.add_argument("--page", type=Path, default=Path("benchmarks/results/reconstructions.md"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if options.what == "made":
        run_made(options.output / "made.jsonl", options.objects, options.weights)
    elif options.what == "real":
        run_real(options.data, options.output, options.weights)
    else:
        write_page(options.output, options.page)


if __name__ == "__main__":
    main()
