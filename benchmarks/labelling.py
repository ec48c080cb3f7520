"""Labelling many frames: how fast beside one by one, how much memory over time, and what kills do to it.

    python -m benchmarks.labelling throughput --weights FILE    one by one and in batches, in turns
    python -m benchmarks.labelling run --frames 2000            `ipjax label` over so many frames: rate and memory
    python -m benchmarks.labelling soak --frames 120 --kills 20  killed at random and continued: the same bytes?
    python -m benchmarks.labelling page                         benchmarks/results/labelling.md

Frames are made scenes of three objects (`ipjax.synthetic`, seeds from 0) with their true visible masks. Where there are
more frames than scenes, a scene is shown again under another name, and its random numbers are others. Scenes and object
files are made once, in --output. A measurement is a line of figures.jsonl there; ``run`` goes on where it was killed.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import commit, describe_device
from ipjax.config import Config, OnboardConfig
from ipjax.detection.masks import mask_from_pose
from ipjax.files.images.run_lengths import encode_rle
from ipjax.files.objects.loading import load
from ipjax.files.settings import override
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.files.weights.encoder import load_encoder
from ipjax.files.weights.hashes import hash_file
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.inference.drawing import write_image
from ipjax.inference.estimator import Estimator
from ipjax.labelling.batch import Labeller
from ipjax.labelling.entries import as_batch
from ipjax.labelling.records import LabelSettings, seed_of
from ipjax.labelling.shards.reading import read_ahead
from ipjax.labelling.sources.image_wise import ImageWise
from ipjax.onboarding.mesh import onboard
from ipjax.progress import bar
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.scenes import make_scene

KINDS = ("mug", "bottle", "carton")
SIZES = (0.11, 0.2, 0.16)  # metres
CHANGES = ("match.shortlist=64",)  # of Config.fast()
SCENES = 24
DEPTH_SCALE = 0.1  # millimetres per number
PAGE = Path("benchmarks/results/labelling.md")
WAYS: dict[str, dict[str, Any]] = {
    "batches, 1 crop at a time": {"buckets": (1,), "threads": 1},
    "batches, 2 crops in flight (the default here)": {"buckets": (1,), "threads": 2},
    "batches, 4 crops a program, 1 in flight": {"buckets": (4,), "threads": 1},
    "batches, 4 crops a program, 2 in flight": {"buckets": (4,), "threads": 2},
}
ONE_BY_ONE = "one by one"


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.labelling", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("throughput", "run", "soak", "page"))
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=4, help="throughput: turns of all ways")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("--output", type=Path, default=Path("build/labelling"))
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    use_compilation_cache()
    if options.what == "page":
        write_text(options.page, "\n".join(tell(read_figures(options.output))) + "\n")
        return
    make_inputs(options)
    measure: Callable[[argparse.Namespace], dict[str, Any]] = {"throughput": throughput, "run": run, "soak": soak}[
        options.what
    ]
    row = {"what": options.what, **measure(options), **describe_device(), "commit": commit()}
    append_json(options.output / "figures.jsonl", row)
    print(json.dumps(row, indent=1))


def read_figures(folder: Path) -> list[dict[str, Any]]:
    """All that was measured."""
    path = folder / "figures.jsonl"
    return [parse_json(line) for line in read_lines(path)] if path.is_file() else []


def make_inputs(options: argparse.Namespace) -> None:
    """Object files and scenes; what is there is not made again."""
    objects, scenes = options.output / "objects", options.output / "scenes"
    meshes = [make_object(kind) for kind in KINDS]
    paths = [objects / f"obj_{number:06d}.ipjax" for number in range(1, len(KINDS) + 1)]
    if not all(path.is_file() for path in paths):
        objects.mkdir(exist_ok=True)
        encoder = load_encoder(options.weights)
        for path, mesh, size in zip(paths, meshes, SIZES, strict=True):
            onboard(mesh, encoder, OnboardConfig(), out=path, name=path.stem, metres_per_unit=size * mesh.scale)
    scenes.mkdir(exist_ok=True)
    wanted = min(options.frames, SCENES)
    for seed in bar(range(wanted), desc="scenes"):
        key = scenes / f"000000_{seed:06d}"
        if key.with_name(f"{key.name}.mask_visib.json").is_file():
            continue
        scene = make_scene(meshes, seed, sizes=SIZES)
        write_image(key.with_name(f"{key.name}.rgb.png"), scene.rgb)
        depth = np.round(scene.depth * 1000 / DEPTH_SCALE)
        write_image(key.with_name(f"{key.name}.depth.png"), np.where(depth < 65536, depth, 0).astype(np.uint16))
        camera = {"cam_K": np.asarray(scene.matrix, float).ravel().tolist(), "depth_scale": DEPTH_SCALE}
        truth = [{"obj_id": number + 1} for number in range(len(KINDS))]
        info = [{"visib_fract": float(share)} for share in scene.visible]
        masks = {str(number): encode_rle(mask) for number, mask in enumerate(scene.masks)}
        for part, document in (("camera", camera), ("gt", truth), ("gt_info", info), ("mask_visib", masks)):
            write_text(key.with_name(f"{key.name}.{part}.json"), json.dumps(document))


def link_frames(options: argparse.Namespace) -> Path:
    """A folder of as many frames as are wanted, each a link to a scene."""
    folder = options.output / f"frames_{options.frames}"
    folder.mkdir(exist_ok=True)
    scenes = options.output / "scenes"
    parts = ("rgb.png", "depth.png", "camera.json", "gt.json", "gt_info.json", "mask_visib.json")
    for number in range(options.frames):
        for part in parts:
            link = folder / f"000000_{number:06d}.{part}"
            if not link.is_symlink():
                link.symlink_to(scenes.resolve() / f"000000_{number % min(options.frames, SCENES):06d}.{part}")
    return folder


def throughput(options: argparse.Namespace) -> dict[str, Any]:
    """Frames a second one by one and in batches, each from the files on, in turns."""
    numbers = list(range(1, len(KINDS) + 1))
    source = ImageWise(link_frames(options), numbers)
    keys = source.keys()
    objects = [load(path) for path in sorted((options.output / "objects").glob("*.ipjax"))]
    encoder, config = load_encoder(options.weights), override(CHANGES, Config.fast())
    estimator = Estimator(objects, encoder, config, alike=True)

    def one_by_one() -> int:
        crops = 0
        for key in keys:
            frame = source.read(key)
            for obj, mask in frame.masks or ():
                crop = estimator.frame(obj, frame.rgb, frame.depth, mask, frame.camera)
                found = estimator.run(obj, *crop, seed=seed_of(0, key.name, obj)).estimate
                pose = found.camera_from_object
                visible, _ = mask_from_pose(estimator.objects[obj][0], pose, frame.camera, frame.depth)
                encode_rle(visible)
                crops += 1
        return crops

    def in_batches(labeller: Labeller) -> int:
        crops = 0
        for found in read_ahead(source, keys, 8):
            usable = [(key, frame) for key, frame in found if not isinstance(frame, str)]
            made = labeller(as_batch([key for key, _ in usable], [frame for _, frame in usable]))
            crops += int((made["object"] >= 0).sum())
        return crops

    ways: dict[str, Callable[[], int]] = {ONE_BY_ONE: one_by_one}
    for name, settings in WAYS.items():
        labeller = Labeller(encoder, objects, config, LabelSettings(**settings))
        ways[name] = lambda labeller=labeller: in_batches(labeller)
    crops = {name: way() for name, way in ways.items()}  # compiles, too
    assert len(set(crops.values())) == 1, crops
    figures: dict[str, dict[str, list[float]]] = {n: {"wall": [], "cpu": [], "others": []} for n in ways}
    for _ in range(options.rounds):
        for name, way in ways.items():
            start, spent, busy = time.perf_counter(), time.process_time(), _busy()
            way()
            wall, cpu = time.perf_counter() - start, time.process_time() - spent
            others = max((_busy() - busy - cpu) / wall, 0.0)
            for kind, value in (("wall", wall), ("cpu", cpu), ("others", others)):
                figures[name][kind].append(value)
            print(f"{name}: {wall:.1f} s, {cpu:.1f} s of the processor, {others:.2f} cores busy with other work")
    return {"frames": len(keys), "crops": crops[ONE_BY_ONE], "ways": figures}


def _busy() -> float:
    """Seconds that all cores have been busy; 0 where the system does not tell."""
    path = Path("/proc/stat")
    if not path.is_file():
        return 0.0
    ticks = [int(word) for word in path.read_text().split("\n", 1)[0].split()[1:]]
    return (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")


def _command(options: argparse.Namespace, labels: Path, shard_size: int) -> list[str]:
    given = ["label", str(link_frames(options)), "-o", str(labels), "--objects", str(options.output / "objects")]
    given += ["--config", "fast", "--shard-size", str(shard_size), "--previews", "50", "--quiet"]
    for change in CHANGES:
        given += ["--set", change]
    if options.weights:
        given += ["--weights", options.weights]
    return [sys.executable, "-m", "ipjax", *given]


def run(options: argparse.Namespace) -> dict[str, Any]:
    """`ipjax label` over many frames, and the memory that it takes, looked at every few seconds."""
    labels = options.output / f"run_{options.frames}"
    record = options.output / f"run_{options.frames}.jsonl"
    child = subprocess.Popen(_command(options, labels, 100))
    while child.poll() is None:
        time.sleep(5)
        try:
            pages = int(Path(f"/proc/{child.pid}/statm").read_text().split()[1])
        except (OSError, IndexError, ValueError):
            continue
        memory = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
        append_json(record, {"time": time.time(), "pid": child.pid, "frames": _count(labels), "mib": round(memory, 1)})
    if child.returncode not in (0, 1):
        raise SystemExit(f"ipjax label ended with status {child.returncode}")
    spent = [parse_json(line) for path in sorted((labels / "logs").glob("*")) for line in read_lines(path)]
    seen = [parse_json(line) for line in read_lines(record)]
    steady = [one for one in seen if one["frames"] >= 16]  # after everything has been compiled
    third = max(len(steady) // 3, 1)
    return {
        "frames": _count(labels),
        "lost": options.frames - _count(labels),
        "seconds": sum(one["wall_seconds"] for one in spent),
        "first_mib": float(np.median([one["mib"] for one in steady[:third]])),
        "last_mib": float(np.median([one["mib"] for one in steady[-third:]])),
        "most_mib": max(one["mib"] for one in seen),
        "processes": len({one["pid"] for one in seen}),
    }


def _count(labels: Path) -> int:
    """Frames that have been labelled."""
    paths = [*labels.glob("shards/0*/labels.jsonl"), *labels.glob("work/0*/labels.jsonl")]
    total = 0
    for path in paths:
        try:
            total += path.read_bytes().count(b"\n")
        except OSError:  # it has just been finished
            continue
    return total


def soak(options: argparse.Namespace) -> dict[str, Any]:
    """`ipjax label` killed at random moments and continued, beside one that was left alone."""
    alone, killed = (options.output / f"{name}_{options.frames}" for name in ("alone", "killed"))
    subprocess.run(_command(options, alone, 20), check=True)
    shutil.rmtree(killed, ignore_errors=True)
    rng, kills, starts, total = random.Random(0), 0, 0, 0
    while True:
        child, before = subprocess.Popen(_command(options, killed, 20)), _count(killed)
        starts += 1
        # Killed while it labels: not before it has begun, unless by chance while it loads.
        wanted = before + rng.randint(0, max(2 * options.frames // options.kills, 1))
        while child.poll() is None and (_count(killed) < wanted or kills >= options.kills):
            time.sleep(0.5)
        time.sleep(rng.uniform(0, 4))
        if child.poll() is not None:
            break
        child.send_signal(signal.SIGKILL)
        child.wait()
        kills += 1
        total += _count(killed) - before
    hashes = [_hash(folder) for folder in (alone, killed)]
    differ = sorted(name for name in {*hashes[0], *hashes[1]} if hashes[0].get(name) != hashes[1].get(name))
    return {"frames": options.frames, "kills": kills, "starts": starts, "files": len(hashes[0]), "differ": differ}


def _hash(folder: Path) -> dict[str, str]:
    """Every file of the shards, and its content."""
    return {
        path.relative_to(folder).as_posix(): hash_file(path)
        for path in sorted((folder / "shards").rglob("*"))
        if path.is_file()
    }


def tell(rows: list[dict[str, Any]]) -> list[str]:
    """The page: the last figures of each kind, and where and at which commit they were measured."""
    lines = ["# Labelling many frames", ""]
    lines += ["Made by `python -m benchmarks.labelling page`; do not edit by hand.", ""]
    lines += [
        f"Frames of 640 × 480 with three objects ({', '.join(KINDS)}), their masks given; 400 templates each, DINOv2 "
        f"S/14, `Config.fast()` with {', '.join(CHANGES)}.",
        "",
    ]
    for what, write in (("throughput", _tell_throughput), ("run", _tell_run), ("soak", _tell_soak)):
        mine = [row for row in rows if row["what"] == what]
        if mine:
            row = mine[-1]
            lines += [*write(row), ""]
            place = f"{row['device']} ({row['platform']}, {row['cores']} cores), jax {row['jax']}"
            lines += [f"{place}, commit {row['commit']}.", ""]
    return lines[:-1]


def _tell_throughput(row: dict[str, Any]) -> list[str]:
    lines = [
        "## In batches and one by one",
        "",
        f"`python -m benchmarks.labelling throughput --frames {row['frames']}`",
    ]
    lines += [
        "",
        f"{row['crops']} crops of {row['frames']} frames, from the files to run lengths, in turns. Busy: cores",
    ]
    lines[-1] += " that other work on the machine took meanwhile. Ratio: of the fastest rounds, and of the medians."
    lines += [
        "",
        "| how | fastest | median | of the processor | busy | ratio |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    first = row["ways"][ONE_BY_ONE]["wall"]
    for name, figures in row["ways"].items():
        wall = figures["wall"]
        rates = [row["frames"] / seconds for seconds in (min(wall), float(np.median(wall)))]
        ratio = f"{min(first) / min(wall):.2f}, {np.median(first) / np.median(wall):.2f}"
        cpu = 1000 * float(np.median(figures["cpu"])) / row["crops"]
        lines.append(
            f"| {name} | {rates[0]:.2f} frames/s | {rates[1]:.2f} frames/s | {cpu:.0f} ms a crop | "
            f"{np.median(figures['others']):.1f} | {ratio} |"
        )
    return lines


def _tell_run(row: dict[str, Any]) -> list[str]:
    grown = row["last_mib"] / row["first_mib"] - 1
    return [
        "## Many frames",
        "",
        f"`python -m benchmarks.labelling run --frames {row['frames'] + row['lost']}`",
        "",
        f"{row['frames']} frames in {row['seconds'] / 3600:.2f} h, {row['frames'] / row['seconds']:.2f} frames/s, in "
        f"{row['processes']} process{'es' if row['processes'] > 1 else ''}; {row['lost']} lost. Memory: median of the "
        f"first third {row['first_mib']:.0f} MiB, of the last {row['last_mib']:.0f} MiB ({grown:+.1%}), at most "
        f"{row['most_mib']:.0f} MiB.",
    ]


def _tell_soak(row: dict[str, Any]) -> list[str]:
    same = "all the same to the last byte" if not row["differ"] else f"{len(row['differ'])} differ: {row['differ'][:5]}"
    return [
        "## Killed at random",
        "",
        f"`python -m benchmarks.labelling soak --frames {row['frames']} --kills {row['kills']}`",
        "",
        f"{row['frames']} frames, {row['kills']} times kill −9, {row['starts']} starts: {row['files']} files, beside "
        f"those of a run that was left alone {same}.",
    ]


if __name__ == "__main__":
    main()
