"""Photo → object → pose: how well an object that one photo showed is found in another frame.

    python -m benchmarks.photo_pairs ycbv --data FOLDER [--limit N]
    python -m benchmarks.photo_pairs across --data FOLDER --others FOLDER …
    python -m benchmarks.photo_pairs synthetic [--data FOLDER] [--pairs 200] [--limit N]
    python -m benchmarks.photo_pairs table RESULTS.jsonl … [--page benchmarks/results/photos.md]

Each pair is a reference (one masked photo, with or without its depth) and a query (an RGB-D frame of the same object).
The object is made from the reference without learned reconstruction weights ("rgb": the outline inflated, "rgbd": the
depth completed) and found in the query; "scan" onboards the true mesh, the upper bound. The reference's true pose gives
the canonical frame: estimated camera_from_reference_camera ∘ true reference_camera_from_object is compared with the
true pose in the query. A reference without depth has no unit: there, one unit is the true depth of the object's centre
in the reference, and the size is found by the estimate; with depth, the measured size is kept.

In some synthetic scenes the object is also sought behind another object's mask, where it is not; those lines, and what
each estimate says of its own certainty, are what `benchmarks.calibration` reads. For it, objects made in code can also
be known from degraded meshes (``--methods level2``, see `ipjax.synthetic.degradation`).

Results are lines of JSON, one per pair and method, written as they come: run again to go on. Templates are fewer than
by default (24 × 8 instead of 40 × 10) for speed; objects from "rgb" have the photo's views, whatever is asked for.
"""

import argparse
import dataclasses
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pairs import (
    BINS,
    PER_REFERENCE,
    REPEATED,
    Group,
    Shot,
    dataset_groups,
    rigid,
    synthetic_groups,
    view_angle,
)
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.transforms import Similarity

METHODS = ("rgb", "rgbd", "scan")
DEGRADED = ("level1", "level2", "level3", "level4")  # the true mesh made worse, for objects made in code
SCANS = 3  # of them, for objects made in code, that are also tried with the true mesh or a worse copy of it


def run(
    groups: Iterator[Group],
    output: Path,
    config,
    limit: int | None,
    weights: str | None = None,
    methods: Sequence[str] = METHODS,
) -> None:
    """Try every pair by every method; lines already in ``output`` are not tried again."""
    from benchmarks.measure import commit
    from ipjax.files.weights.encoder import load_encoder
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.estimator import Estimator
    from ipjax.onboarding.foreground import Photo
    from ipjax.onboarding.mesh import onboard
    from ipjax.onboarding.photo import onboard_photo
    from ipjax.records import Camera
    from ipjax.synthetic.degradation import degrade

    done = set()
    if output.exists():
        done = {tuple(parse_json(line)["key"]) for line in read_lines(output, repair=True)}
    use_compilation_cache()
    encoder = load_encoder(weights)
    everything = Estimator([], encoder)
    scans: dict[str, tuple] = {}
    state, tried = commit(), 0
    for group in groups:
        for method in methods:
            left = len(group.queries) if limit is None else min(limit - tried, len(group.queries))
            queries = group.queries[: max(left, 0)]
            if method not in ("rgb", "rgbd"):
                queries = queries[: SCANS if group.synthetic else 0]
            keys = [(method, group.object, group.reference.name, query.name) for query in queries]
            if all(key in done for key in keys):
                continue
            start, failure = time.perf_counter(), ""
            ref = group.reference
            lens = Camera.from_matrix(ref.K)
            made, back = None, None
            try:
                plain = dataclasses.replace(group.mesh, scale=1.0, centre=(0.0, 0.0, 0.0))
                if method == "scan":
                    if group.object not in scans:
                        unit = group.metres_per_unit
                        found = onboard(plain, encoder, config, metres_per_unit=unit, progress=False)
                        scans[group.object] = found
                    made = scans[group.object]
                elif method in DEGRADED:
                    worse, back = degrade(plain, int(method[-1]))
                    made = onboard(worse, encoder, config, progress=False)
                else:
                    depth = {"depth": ref.depth} if method == "rgbd" else {}
                    photo = onboard_photo(
                        Photo(ref.rgb),
                        encoder,
                        config,
                        mask=ref.mask,
                        camera=lens,
                        lrm="inflate",
                        progress=False,
                        **depth,
                    )
                    made = photo.templates, photo.info
            except ValueError as error:
                failure = str(error)
            onboarding = time.perf_counter() - start
            # One estimator for all: it compiles once for each shape of templates.
            everything.objects = [] if made is None else [made]
            estimator = None if made is None else everything
            for key, query in zip(keys, queries, strict=True):
                if key in done:
                    continue
                start = time.perf_counter()
                row = {"key": key, "angle": view_angle(ref, query), "failure": failure, "commit": state}
                if estimator is not None:
                    row |= judge(group, method, estimator, query, back)
                row |= {"onboard_s": onboarding, "estimate_s": time.perf_counter() - start}
                if estimator is not None and query.other is not None:
                    row["absent"] = search_absent(estimator, query)
                append_json(output, row)
                text = f"ADD-S {row['add_s']:.3f}, {row['rotation']:.0f}°" if "add_s" in row else row["failure"]
                print(f"{' '.join(key)} at {row['angle']:.0f}°: {text}", flush=True)
        tried += len(group.queries)
        if limit is not None and tried >= limit:
            return


def judge(group: Group, method: str, estimator, query: Shot, back: Any = None) -> dict:
    """The pose found in the query against the truth of both frames; distances in diameters.

    ``back`` maps a degraded mesh onto the true one.
    """
    from scipy.spatial import KDTree

    from ipjax import metrics
    from ipjax.bop.scoring.errors import stack, surface_errors
    from ipjax.inference.reports import relative_pose

    info = estimator.objects[0][1]
    try:
        crop = estimator.frame(0, query.rgb, query.depth, query.mask, query.K)
    except ValueError as error:
        return {"failure": str(error)}
    result = estimator.run(0, *crop, diameter=info.measured_diameter)
    estimate = result.estimate
    if not bool(estimate.success):
        return {"failure": "no pose found"}

    found = estimate.camera_from_object
    if method in ("scan", *DEGRADED):
        pose = camera_from_true_mesh(found, info, back)
        scale = float(pose.scale) / group.metres_per_unit  # metres per metre of the model
        pose = Similarity(pose.rotation, pose.translation, np.asarray(scale))
    else:
        there = group.reference.camera_from_object
        if info.measured_diameter is None:
            unit = 1 / there.translation[2]
            there = Similarity(there.rotation, unit * there.translation, np.asarray(unit))
        pose = relative_pose(found, info) @ there
        scale = float(pose.scale)
    model = group.model
    # What is told as its size: of an object from a photo without depth not that of the guess, which "scale" is.
    diameter = float(estimate.diameter) / model.diameter if method == "rgb" else scale
    points, true = model.points, query.camera_from_object
    tree = KDTree(points)
    rigid_pose = rigid(pose.rotation, pose.translation)
    errors = surface_errors(model, query.K[None], stack([true]), stack([rigid_pose]))
    middle = (points.min(0, keepdims=True) + points.max(0, keepdims=True)) / 2
    moved = (pose @ middle - true @ middle)[0]
    steps = np.arange(0.05, 0.51, 0.05)
    mssd, mspd = float(errors.mssd[0]) / model.diameter, float(errors.mspd[0]) * 640 / query.rgb.shape[1]
    return {
        "add_s": float(metrics.add_s(points, true, pose, nearest=lambda x: tree.query(x)[0])) / model.diameter,
        "add": float(metrics.add(points, true, pose)) / model.diameter,
        "rotation": float(np.degrees(errors.rotation[0])),
        "translation_mm": float(1e3 * np.linalg.norm(moved)),
        "scale": scale,
        "diameter": diameter,
        "mssd_recall": float(np.mean(mssd < steps)),
        "mspd_recall": float(np.mean(mspd < 100 * steps)),
        **certainty(estimate),
        "squared_mahalanobis": squared_mahalanobis(
            pose.rotation @ true.rotation.T, moved, np.asarray(estimate.covariance, np.float64)
        ),
        "independent": float(estimator.config.confidence.independent),
        "scale_free": info.measured_diameter is None,
        "scale_deviations": float((1 - 1 / diameter) * estimate.diameter / max(float(estimate.scale_std), 1e-9)),
    }


def camera_from_true_mesh(camera_from_object: Similarity, info, back: Any = None) -> Similarity[np.ndarray]:
    """An estimate as the pose of the mesh that was onboarded, or of the one that this is a degraded copy of."""
    camera_from_mesh = camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
    return camera_from_mesh if back is None else camera_from_mesh @ back.inverse()


def certainty(estimate) -> dict:
    """Confidence, agreement and ambiguity of an estimate."""
    parts = [getattr(estimate.agreement, part.name) for part in dataclasses.fields(estimate.agreement)]
    return {
        "confidence": float(estimate.confidence),
        "agreement": [float(x) for x in parts],
        "ambiguity_deg": float(np.degrees(np.linalg.norm(np.asarray(estimate.ambiguity)))),
    }


def squared_mahalanobis(turn: np.ndarray, moved: np.ndarray, covariance: np.ndarray) -> float:
    """The squared Mahalanobis length of an error in rotation and translation: 6 on average under a right covariance."""
    from scipy.spatial.transform import Rotation

    error = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), moved])
    return float(error @ np.linalg.solve(covariance, error))


def search_absent(estimator, query: Shot) -> dict:
    """Search behind another object's mask, where the object is absent; the certainty of that estimate."""
    try:
        crop = estimator.frame(0, query.rgb, query.depth, query.other, query.K)
    except ValueError as error:
        return {"failure": str(error)}
    result = estimator.run(0, *crop, diameter=estimator.objects[0][1].measured_diameter)
    return certainty(result.estimate) if bool(result.estimate.success) else {"failure": "no pose found"}


RIGHT = 15  # degrees


def is_called(row: dict) -> bool:
    """Whether the object is called present, by the weights that the confidence has today."""
    import jax.numpy as jnp

    from ipjax.config import ConfidenceConfig
    from ipjax.estimation.confidence import probability
    from ipjax.records import Agreement

    config = ConfidenceConfig()
    weights = config.photo if row["key"][0] == "rgb" else config.drawn
    return float(probability(Agreement(*jnp.asarray(row["agreement"])), jnp.asarray(weights))) >= config.least


def table(rows: list[dict]) -> str:
    """Markdown: by method and angle; what was not found counts as a miss, the next-to-last columns are of the right."""
    lines = [
        "| object from | angle | pairs | ADD-S < 10 % | rotation < 15° | < 30° | of the right: median rotation "
        "| median shift | size within 10 % | called present | right of these | MSSD recall | MSPD recall |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    spans = [*itertools.pairwise(BINS), (0, 30), (60, 90), (0, 45), (0, 60), (0, 180.1)]
    for method in (*METHODS, *DEGRADED):
        for low, high in dict.fromkeys(spans):
            chosen = [row for row in rows if row["key"][0] == method and low <= row["angle"] < high]
            if not chosen:
                continue
            found = [row for row in chosen if "add_s" in row]
            right = [row for row in found if row["rotation"] < RIGHT]
            called = [row for row in found if is_called(row)]
            mean = lambda test, found=found, chosen=chosen: sum(test(row) for row in found) / len(chosen)
            middle = lambda name, right=right: f"{np.median([row[name] for row in right]):.0f}" if right else "–"
            sized = f"{np.mean([abs(row['scale'] - 1) < 0.1 for row in right]):.0%}" if right else "–"
            lines.append(
                f"| {method} | {low:.0f}–{high:.0f}° | {len(chosen)} | {mean(lambda r: r['add_s'] < 0.1):.0%} "
                f"| {len(right) / len(chosen):.0%} | {mean(lambda r: r['rotation'] < 30):.0%} "
                f"| {middle('rotation')}° | {middle('translation_mm')} mm | {sized} "
                f"| {len(called)} | {sum(row in right for row in called)} "
                f"| {mean(lambda r: r['mssd_recall']):.2f} | {mean(lambda r: r['mspd_recall']):.2f} |"
            )
    return "\n".join(lines)


def size_table(rows: list[dict]) -> str:
    """Markdown: the diameter that is told of objects from a photo without depth, where the rotation is right: how far
    it is off, and how that compares with the standard deviation that is told with it; "" where no line has one."""
    lines = [
        "| angle | right pairs | mean error of the diameter | its deviation | within 10 % | in stated deviations: mean "
        "| within 1 | within 2 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rows = [row for row in rows if row["key"][0] == "rgb" and row.get("diameter") and row["rotation"] < RIGHT]
    for low, high in (*itertools.pairwise(BINS), (0, 180.1)):
        chosen = [row for row in rows if low <= row["angle"] < high]
        if not chosen:
            continue
        off = np.array([row["diameter"] - 1 for row in chosen])
        told = np.array([row["scale_deviations"] for row in chosen])
        lines.append(
            f"| {low:.0f}–{high:.0f}° | {len(chosen)} | {off.mean():+.1%} | {off.std():.1%} "
            f"| {np.mean(abs(off) < 0.1):.0%} | {told.mean():+.2f} | {np.mean(abs(told) < 1):.0%} "
            f"| {np.mean(abs(told) < 2):.0%} |"
        )
    return "\n".join(lines) if rows else ""


def states(rows: list[dict]) -> str:
    """The commits that made the lines, in their order."""
    return ", ".join(dict.fromkeys(row.get("commit", "unknown") for row in rows))


def write_page(path: Path, text: str, rows: list[dict]) -> None:
    """The tables with what they rest on."""
    from benchmarks.measure import describe_device

    device = describe_device()
    head = [
        "# Objects from one photo" + (" without depth" if {row["key"][0] for row in rows} == {"rgb"} else ""),
        "",
        "Made by `python -m benchmarks.photo_pairs`; do not edit by hand. Each object is made from one masked photo "
        "(`rgb`: its outline inflated, size unknown; `rgbd`: its depth completed, size known) or from the true mesh "
        "(`scan`, the upper bound, on at most three queries of a reference), and found in another RGB-D frame with a "
        "given mask. Angles are between the two views of the object. The photo's true pose gives the canonical frame. "
        "Pairs where nothing was found count as misses; right is a rotation within 15°, up to the object's symmetries. "
        "MSSD and MSPD recalls are means over BOP's ten thresholds.",
        "",
        f"{device['device']}, {device['cores']} cores, jax {device['jax']}, Python {device['python']}, "
        f"commit {states(rows)}.",
    ]
    write_text(path, "\n".join(head) + "\n\n" + text + "\n", parents=True)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("ycbv", "across", "synthetic", "table"))
    parser.add_argument("results", type=Path, nargs="*")
    parser.add_argument("--data", type=Path, help="a BOP data set: frames for ycbv, scans for synthetic")
    parser.add_argument("--others", type=Path, nargs="+", help="with across: data sets of the same objects")
    parser.add_argument("--output", type=Path, help="lines of JSON (default build/photo_pairs_WHAT.jsonl)")
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--page", type=Path, help="with table: write it here, too, with where it comes from")
    parser.add_argument("--limit", type=int, help="stop after so many pairs")
    parser.add_argument(
        "--methods",
        nargs="+",
        default=list(METHODS),
        choices=[*METHODS, *DEGRADED],
        metavar="rgb|rgbd|scan|levelN",
        help="what the object is known from (default: rgb rgbd scan)",
    )
    parser.add_argument(
        "--queries", type=int, default=PER_REFERENCE, help=f"queries of each synthetic reference ({PER_REFERENCE})"
    )
    parser.add_argument("--directions", type=int, default=24)
    parser.add_argument("--rolls", type=int, default=8)
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.what == "table":
        rows = {path: [parse_json(line) for line in read_lines(path)] for path in options.results}
        tables = lambda path: "\n\n".join(filter(None, (table(rows[path]), size_table(rows[path]))))
        text = "\n\n".join(f"## {path.stem}\n\n{tables(path)}" for path in options.results)
        print(text)
        if options.page:
            write_page(options.page, text, list(itertools.chain(*rows.values())))
        return
    from ipjax.config import OnboardConfig

    output = options.output or Path("build") / f"photo_pairs_{options.what}.jsonl"
    output.parent.mkdir(parents=True, exist_ok=True)
    if options.what in ("ycbv", "across"):
        if options.data is None:
            sys.exit(f"{options.what} needs --data FOLDER")
        if options.what == "across" and not options.others:
            sys.exit("across needs --others FOLDER …: data sets with objects of the first")
        folders = [options.data, *(options.others if options.what == "across" else [])]
        groups = dataset_groups(folders, REPEATED if options.what == "ycbv" else None)
    else:
        groups = synthetic_groups(options.pairs, options.data, options.seed, options.queries)
    start = time.perf_counter()
    run(
        groups,
        output,
        OnboardConfig(directions=options.directions, rolls=options.rolls),
        options.limit,
        options.weights,
        options.methods,
    )
    rows = [parse_json(line) for line in read_lines(output)]
    print(f"\n{options.directions} × {options.rolls} templates; this run took {time.perf_counter() - start:.0f} s\n")
    print(table(rows))
    print(f"\n{size_table(rows)}")


if __name__ == "__main__":
    main()
