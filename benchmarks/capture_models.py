"""Models and labels of made captures, against the truth: ``python -m benchmarks.capture_models measure SEEDS -o FILE``.

Every seed is a table with five objects, two of which touch (in the odd seeds two pairs), seen in 24 frames of 640 × 480
by a noisy camera; poses are the true ones, off by 1 mm and 0.05° (rms of the whole vector), depth is the raw depth
warped by the true rig. ``--open3d`` also fuses the same frames with Open3D's VoxelBlockGrid. Then ``page FILE… --page
PAGE``.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import KDTree

from benchmarks.measure import commit, describe_device
from ipjax.capture.labels.masks import find_box, label_frames
from ipjax.capture.models.frames import PosedFrame, trust_depth
from ipjax.capture.models.making import ModelConfig, SceneModels
from ipjax.capture.models.separation import Hint
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.inference.depth import register_depth
from ipjax.synthetic.captures import MadeCapture, make_capture
from ipjax.transforms import Similarity

TURN, SHIFT = 0.05, 0.001  # degrees and metres, rms
OPEN3D = "open3d"


def make_frames(seed: int, views: int, size: tuple[int, int], exact: bool) -> tuple[MadeCapture, list[PosedFrame]]:
    """A made capture, and its frames as the steps before would hand them on."""
    made = make_capture(seed, views=views, objects=5, touching=1 + seed % 2, size=size)
    rng = np.random.default_rng([seed, 7])
    step = np.concatenate(
        [rng.normal(0, np.deg2rad(TURN / 3**0.5), (views, 3)), rng.normal(0, SHIFT / 3**0.5, (views, 3))], -1
    )
    poses = made.world_from_camera @ Similarity[np.ndarray].exp(0 * step if exact else step)
    frames = []
    for index, name in enumerate(made.names):
        depth = register_depth(made.raw_depth[index], made.depth_camera, made.colour_from_depth, made.camera, size)
        pose = poses.take(index)
        usable = np.ones(depth.shape, bool)
        frames.append(PosedFrame(name, made.rgb[index], depth, usable, made.camera.to_matrix(), pose))
    return made, frames


def measure_seed(seed: int, views: int, size: tuple[int, int], *, exact: bool, with_open3d: bool) -> dict[str, Any]:
    """Everything about one capture."""
    from ipjax.capture.models.making import fuse_scene, make_objects

    made, frames = make_frames(seed, views, size, exact)
    config = ModelConfig()
    spent: dict[str, float] = {}
    start = time.process_time(), time.perf_counter()
    fused = fuse_scene(frames, config)
    spent["fuse"] = time.process_time() - start[0]
    touching = [[0, 1], [2, 3]][: 1 + seed % 2]
    found: dict[str, Any] = {"seed": seed, "touching": touching}
    for way, hints in (("alone", []), ("clicks", click(made, frames))):
        begin = time.process_time()
        models = make_objects(fused, frames, hints, config)
        spent[f"separate, {way}"] = time.process_time() - begin
        begin = time.process_time(), cpu_of_children()
        labels = label_frames(models.objects, frames)
        spent[f"label, {way}"] = time.process_time() - begin[0] + cpu_of_children() - begin[1]
        match = match_objects(made, labels)
        found[way] = {
            "objects": len(models.objects),
            "masks": measure_masks(made, labels, match),
            "models": measure_models(made, models, match),
        }
    found["cpu_seconds"] = spent
    found["wall_seconds"] = time.perf_counter() - start[1]
    if with_open3d:
        found[OPEN3D] = measure_open3d(made, frames, fused.support, config, fused.surface)
    return found


def cpu_of_children() -> float:
    """CPU seconds of processes that have ended."""
    import resource

    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def click(made: MadeCapture, frames: Sequence[PosedFrame]) -> list[Hint]:
    """One click on every object, in its middle where depth is known, in the frame that shows most of the object that it
    shows least of.
    """
    ids = np.where(np.stack([frame.depth for frame in frames]) > 0, made.ids, -1)
    counts = np.stack([(ids == k).sum((1, 2)) for k in range(len(made.meshes))])
    number = int(counts.min(0).argmax())
    hints = []
    for k in range(len(made.meshes)):
        inner = cv2.distanceTransform((ids[number] == k).astype(np.uint8), cv2.DIST_L2, 5)
        y, x = np.unravel_index(inner.argmax(), inner.shape)
        hints.append(Hint(f"object {k}", made.names[number], float(x), float(y)))
    return hints


def match_objects(made: MadeCapture, labels: list[Any]) -> list[int | None]:
    """Of every true object the found one that shares most pixels with it over all frames; None where none does."""
    count = len(labels[0].visible)
    shared = np.zeros((len(made.meshes), count))
    for ids, label in zip(made.ids, labels, strict=True):
        for k in range(len(made.meshes)):
            shared[k] += [(mask & (ids == k)).sum() for mask in label.visible]
    return [int(row.argmax()) if row.max() > 0 else None for row in shared]


def measure_masks(made: MadeCapture, labels: list[Any], match: list[int | None]) -> dict[str, Any]:
    """Overlaps of every frame's foreground, and of every object where it is seen; and how far boxes are outside."""
    foreground, each, boxes = [], [[] for _ in made.meshes], []
    for ids, label in zip(made.ids, labels, strict=True):
        foreground.append(overlap(ids >= 0, label.visible.any(0)))
        for k, index in enumerate(match):
            truth = ids == k
            if truth.sum() < 0.02 * (ids >= 0).sum():
                continue
            mine = np.zeros_like(truth) if index is None else label.visible[index]
            each[k].append(overlap(truth, mine))
            if index is not None and mine.any():
                boxes.append(outside(find_box(truth), find_box(mine)))
    return {"foreground": foreground, "each": each, "boxes": boxes}


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union."""
    return float((first & second).sum() / max((first | second).sum(), 1))


def outside(truth: tuple[int, ...], mine: tuple[int, ...]) -> list[int]:
    """Pixels by which the left, upper, right and lower side of a box are outside of the true one."""
    (a, b, c, d), (e, f, g, h) = truth, mine
    return [a - e, b - f, e + g - a - c, f + h - b - d]


def place_truth(made: MadeCapture, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in world and faces of a true object."""
    poses = made.world_from_object
    pose = Similarity(poses.rotation[index], poses.translation[index], np.asarray(poses.scale[index]))
    return pose @ made.meshes[index].vertices, made.meshes[index].faces


def signed_distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of points from a closed surface, metres, positive outside: exact, among the triangles nearest to it."""
    from trimesh.triangles import closest_point

    rng = np.random.default_rng(0)
    corners = vertices[faces]
    product = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(product, axis=-1)
    chosen = rng.choice(len(faces), 60000, p=area / area.sum())
    root, share = np.sqrt(rng.uniform(size=60000)), rng.uniform(size=60000)
    weights = np.stack([1 - root, root * (1 - share), root * share], -1)
    near = chosen[KDTree((corners[chosen] * weights[..., None]).sum(1)).query(points, 4)[1]]
    best, signed = np.full(len(points), np.inf), np.zeros(len(points))
    for column in near.T:
        away = points - closest_point(corners[column], points)
        distance = np.linalg.norm(away, axis=-1)
        closer = distance < best
        best = np.where(closer, distance, best)
        outwards = (away * product[column]).sum(-1) >= 0
        signed = np.where(closer, np.where(outwards, distance, -distance), signed)
    return signed


def measure_models(made: MadeCapture, models: SceneModels, match: list[int | None]) -> list[dict[str, float]]:
    """Of every true object's model: how far its measured vertices are off, and how much of what was seen it has."""
    found = []
    for k, index in enumerate(match):
        if index is None:
            continue
        item = models.objects[index]
        points = item.world_from_model @ item.mesh.vertices[item.mesh.seen > 0]
        found.append(summarise(1000 * signed_distances(points, *place_truth(made, k))))
    return found


def summarise(millimetres: np.ndarray) -> dict[str, float]:
    """Median and 90 % of how far off, and the mean of the signed distances without what is farther than 5 mm."""
    off = np.abs(millimetres)
    inner = millimetres[off < 5]
    return {
        "median": float(np.median(off)),
        "most": float(np.quantile(off, 0.9)),
        "signed": float(inner.mean()) if len(inner) else float("nan"),
        "far": float((off >= 5).mean()),
    }


def measure_open3d(
    made: MadeCapture, frames: list[PosedFrame], support: Any, config: ModelConfig, ours: Any
) -> dict[str, Any]:
    """The same frames through VoxelBlockGrid; both surfaces against all true objects, above the cut."""
    import open3d as o3d  # pyright: ignore[reportMissingImports]

    core = o3d.core
    device = core.Device("CPU:0")
    begin = time.process_time()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (core.float32, core.float32, core.float32),
        ((1,), (1,), (3,)),
        config.voxel,
        16,
        20000,
        device,
    )
    for frame in frames:
        depth = np.where(trust_depth(frame) > 0, frame.depth, 0).astype(np.float32)
        image = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth)))
        colour = o3d.t.geometry.Image(core.Tensor(frame.rgb.astype(np.float32) / 255))
        intrinsic = core.Tensor(frame.camera)
        extrinsic = core.Tensor(frame.camera_from_world.to_matrix())
        blocks = grid.compute_unique_block_coordinates(image, intrinsic, extrinsic, 1.0, 1.5, 4.0)
        grid.integrate(blocks, image, colour, intrinsic, intrinsic, extrinsic, 1.0, 1.5, 4.0)
    mesh = grid.extract_triangle_mesh(1.5).to_legacy()
    spent = time.process_time() - begin
    truths = [place_truth(made, k) for k in range(len(made.meshes))]
    vertices = np.concatenate([points for points, _ in truths])
    starts = np.cumsum([0] + [len(points) for points, _ in truths])
    faces = np.concatenate([item[1] + start for item, start in zip(truths, starts[:-1], strict=True)])
    low, high = vertices.min(0) - 0.01, vertices.max(0) + 0.01
    found: dict[str, Any] = {"cpu_seconds": spent}
    for name, points in ((OPEN3D, np.asarray(mesh.vertices)), ("ours", ours.vertices)):
        inside = ((points > low) & (points < high)).all(1) & (support.heights(points) > config.cut)
        found[name] = summarise(1000 * signed_distances(points[inside], vertices, faces))
    return found


def write_page(results: list[dict[str, Any]], beside: list[dict[str, Any]], command: str) -> str:
    """The page; ``beside``: captures from which Open3D's figures are taken."""
    states = dict.fromkeys(f"{row['device']}, jax {row['jax']}, commit {row['commit']}" for row in results)
    seeds = ", ".join(str(item["seed"]) for item in results)
    lines = [
        "# Models and labels of made captures",
        "",
        f"Made by `{command}`, then `page`; do not edit by hand. Measured on: {'; '.join(states)}.",
        "",
        f"Seeds {seeds}. Every capture: five objects of 0.12 to 0.22 m on a table, one pair touching (two pairs "
        "in odd seeds), the others 3 cm apart or more; 24 frames of 640 × 480 with noise, frayed edges and holes; "
        f"true poses off by {1000 * SHIFT:g} mm and {TURN:g}° (rms); raw depth warped by the true rig. Settings were "
        "chosen on others (100 to 102).",
        "",
        "`alone`: nothing is said; `clicks`: one click on each object, all in one frame.",
        "",
        "## Masks: intersection over union with what is truly visible",
        "",
        "| | foreground of frames, median | worst | objects apart, median | worst | touching objects, median | worst |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for way in ("alone", "clicks"):
        fore = [v for item in results for v in item[way]["masks"]["foreground"]]
        kinds: dict[bool, list[float]] = {False: [], True: []}
        for item in results:
            tied = {k for pair in item["touching"] for k in pair}
            for k, values in enumerate(item[way]["masks"]["each"]):
                if values:
                    kinds[k in tied].append(float(np.median(values)))
        cells = [f"{np.median(fore):.3f}", f"{min(fore):.3f}"]
        for tied in (False, True):
            cells += [f"{np.median(kinds[tied]):.3f}", f"{min(kinds[tied]):.3f}"] if kinds[tied] else ["–", "–"]
        lines.append(f"| {way} | {' | '.join(cells)} |")
    lines += [
        "",
        "Of an object the median over its frames is taken; the worst is that of the worst object.",
        "",
        "## Models: distance of their measured vertices from the true surface, mm",
        "",
        "| | median | median of the worst object | 90 % | 90 % of the worst object | signed mean | farther than 5 mm |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for way in ("alone", "clicks"):
        rows = [row for item in results for row in item[way]["models"]]
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        cells = [f"{f(columns[name]):.2f}" for name in ("median", "most") for f in (np.median, max)]
        cells += [mean_error(columns["signed"]), f"{100 * np.mean(columns['far']):.2f} %"]
        lines.append(f"| {way} | {' | '.join(cells)} |")
    lines += [
        "",
        "Positive = outside of the true surface.",
        "",
        "## Boxes: pixels by which the visible box's sides are outside of the true ones",
        "",
        "| | left | upper | right | lower |",
        "|---|---:|---:|---:|---:|",
    ]
    for way in ("alone", "clicks"):
        sides = np.array([row for item in results for row in item[way]["masks"]["boxes"]], float)
        trimmed = np.clip(sides, -10, 10)
        lines.append(f"| {way} | {' | '.join(mean_error(column) for column in trimmed.T)} |")
    counts = {way: sum(item[way]["objects"] == 5 for item in results) for way in ("alone", "clicks")}
    lines += [
        "",
        "Means ± standard errors; errors beyond 10 pixels count as 10.",
        "",
        f"Five objects were found in {counts['alone']} of {len(results)} captures alone, with clicks in "
        f"{counts['clicks']}.",
        "",
        "## CPU seconds of a capture",
        "",
        "| " + " | ".join(results[0]["cpu_seconds"]) + " |",
        "|" + "---:|" * len(results[0]["cpu_seconds"]),
        "| "
        + " | ".join(f"{np.median([r['cpu_seconds'][k] for r in results]):.1f}" for k in results[0]["cpu_seconds"])
        + " |",
        "",
    ]
    compared = [item[OPEN3D] for item in beside if OPEN3D in item]
    if compared:
        lines += [
            "## Beside Open3D's VoxelBlockGrid (2 mm voxels, the same trusted pixels)",
            "",
            "Both surfaces, before objects are told apart, against all true objects, above 3 mm of the table. Seeds: "
            f"{', '.join(str(item['seed']) for item in beside if OPEN3D in item)}, on which settings were chosen.",
            "",
            "| | median, mm | 90 %, mm | signed mean, mm | farther than 5 mm |",
            "|---|---:|---:|---:|---:|",
        ]
        for name in ("ours", OPEN3D):
            rows = [item[name] for item in compared]
            cells = [f"{np.mean([r[k] for r in rows]):.2f}" for k in ("median", "most", "signed")]
            lines.append(f"| {name} | {' | '.join(cells)} | {100 * np.mean([r['far'] for r in rows]):.2f} % |")
        spent = np.median([item["cpu_seconds"] for item in compared])
        lines += ["", f"Open3D takes {spent:.1f} CPU seconds for fusion and surface.", ""]
    return "\n".join(lines)


def mean_error(values: Any) -> str:
    """Mean ± standard error, in bold where the mean is farther from zero than three standard errors."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    text = f"{values.mean():+.2f} ± {error:.2f}"
    return f"**{text}**" if abs(values.mean()) > 3 * error else text


def unmeasured(seeds: Sequence[int], output: Path, at: str | int) -> list[int]:
    """Those seeds of which the file has no line of this commit."""
    rows = [json.loads(line) for line in read_lines(output)] if output.exists() else []
    done = {row["seed"] for row in rows if row.get("commit") == at}
    return [seed for seed in seeds if seed not in done]


def main() -> None:
    """Measure seeds, or write the page of what was measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    steps = parser.add_subparsers(dest="step", required=True)
    measure = steps.add_parser("measure", help="measure seeds; a line of JSON each")
    measure.add_argument("seeds", type=int, nargs="+")
    measure.add_argument("-o", "--output", type=Path, required=True, metavar="JSONL")
    measure.add_argument("--views", type=int, default=24)
    measure.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    measure.add_argument("--exact", action="store_true", help="with exact poses")
    measure.add_argument("--open3d", action="store_true", help="beside Open3D, which must be installed")
    page = steps.add_parser("page", help="the page of what was measured")
    page.add_argument("results", type=Path, nargs="+", metavar="JSONL")
    page.add_argument("--beside", type=Path, nargs="*", default=[], metavar="JSONL", help="measured with --open3d")
    page.add_argument("--page", type=Path)
    options = parser.parse_args()
    if options.step == "measure":
        state = {**describe_device(), "commit": commit()}
        for seed in unmeasured(options.seeds, options.output, state["commit"]):
            found = measure_seed(
                seed, options.views, tuple(options.size), exact=options.exact, with_open3d=options.open3d
            )
            found |= state
            append_json(options.output, found)
            print(f"seed {seed}: {found['cpu_seconds']}", file=sys.stderr, flush=True)
        return
    read = lambda paths: sorted(
        (json.loads(line) for path in paths for line in path.read_text().splitlines()), key=lambda item: item["seed"]
    )
    results = read(options.results)
    seeds = " ".join(str(item["seed"]) for item in results)
    text = write_page(results, read(options.beside), f"python -m benchmarks.capture_models measure {seeds}")
    print(text)
    if options.page:
        write_text(options.page, text)


if __name__ == "__main__":
    main()
