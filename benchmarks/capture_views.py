"""Frames that were left out, drawn from the others: ``python -m benchmarks.capture_views measure SEEDS -o FILE``.

Every seed is a table with five objects, seen in some frames from all around by a noisy camera; every fourth frame is
left out and drawn from the rest, by `ipjax.capture.views.drawing` and by warping the nearest frame alone. Poses are the
true ones, off by 1 mm and 0.05° (rms of the whole vector), depth is the raw depth warped by the true rig. Then
``page FILE… --page PAGE``.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.capture_models import make_frames, unmeasured
from benchmarks.measure import commit, describe_device
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.views.drawing import ViewConfig, draw_views
from ipjax.files.storage.writing import append_json, read_lines, write_text

EVERY = 4  # of so many frames one is left out
WAYS = {"views": ViewConfig(), "nearest frame alone": ViewConfig(near=1, far=0)}
FAR = 0.01  # metres of error that are another surface


def measure_seed(seed: int, views: int, size: tuple[int, int]) -> dict[str, Any]:
    """Both ways, of one capture; what is compared is compared on the pixels that both know."""
    made, frames = make_frames(seed, views, size, exact=False)
    left = list(range(EVERY // 2, views, EVERY))
    rest = [frame for index, frame in enumerate(frames) if index not in left]
    # The views stand where the frames were: at their true poses, which the frames around do not know.
    poses = made.world_from_camera
    wanted = poses.take(left)
    drawn, spent = {}, {}
    for name, config in WAYS.items():
        start = time.process_time()
        drawn[name] = draw_views(rest, wanted, config)
        spent[name] = (time.process_time() - start) / len(left)
    found: dict[str, Any] = {"seed": seed, "frames": views, "size": list(size), "left": len(left), "cpu_a_view": spent}
    for name in WAYS:
        found[name] = []
        for place, index in enumerate(left):
            both = np.logical_and.reduce([drawn[other][place].usable for other in WAYS])
            truth = made.rgb[index], made.true_depth[index], made.ids[index] >= 0
            found[name].append(compare(drawn[name][place], *truth, both))
    return found


def compare(
    view: PosedFrame, rgb: np.ndarray, depth: np.ndarray, objects: np.ndarray, both: np.ndarray
) -> dict[str, float]:
    """One view against the frame that was left out.

    The frame's exposure and white balance, which no other frame tells, are solved: a gain for each channel.
    """
    from skimage.metrics import structural_similarity

    truth, mine = rgb.astype(np.float64), view.rgb.astype(np.float64)
    gain = (mine[both] * truth[both]).sum(0) / np.maximum((mine[both] ** 2).sum(0), 1e-9)
    mine = np.clip(mine * gain, 0, 255)
    told: dict[str, float] = {"known": float(view.usable.mean()), "objects known": float(view.usable[objects].mean())}
    for where, known in (("both", both), ("all", view.usable)):
        # Unknown pixels are the truth's, so that they tell for no way and against none.
        filled = np.where(known[..., None], mine, truth)
        similar = structural_similarity(filled, truth, channel_axis=-1, data_range=255, full=True)[1].mean(-1)
        squared = ((mine - truth)[known] ** 2).mean()
        off = (view.depth - depth)[known & (depth > 0)]
        told |= {
            f"{where} psnr": float(10 * np.log10(255**2 / squared)),
            f"{where} ssim": float(similar[known].mean()),
            f"{where} signed": float(np.median(off)),
            f"{where} off": float(np.median(np.abs(off))),
            f"{where} off 90": float(np.percentile(np.abs(off), 90)),
            f"{where} far": float((np.abs(off) > FAR).mean()),
        }
    off = np.abs(view.depth - depth)[view.usable & objects]
    return told | {"objects off": float(np.median(off)), "objects off 90": float(np.percentile(off, 90))}


def tell(results: Sequence[dict[str, Any]], command: str) -> str:
    """The page."""
    one = results[0]
    states = dict.fromkeys(f"{row['device']}, jax {row['jax']}, commit {row['commit']}" for row in results)
    lines = [
        "# Frames that were left out, drawn from the others",
        "",
        f"Made by `{command}` and `page`; do not edit by hand.",
        "",
        f"{len(results)} made captures of {one['frames']} frames of {one['size'][0]} × {one['size'][1]} pixels (seeds "
        f"{', '.join(str(row['seed']) for row in results)}, none of which chose a setting): five objects on a table, "
        "the whole way around, a noisy camera with an exposure of its own in every frame. Every fourth frame, "
        f"{sum(row['left'] for row in results)} in all, is left out and drawn at its true pose from the rest, whose "
        "poses are off by 1 mm and 0.05° (rms) and whose depth is the raw depth warped by the true rig, holes and all. "
        "*both*: on pixels that both ways know; *all*: on all that the way itself knows. PSNR and SSIM are against the "
        "noisy photo, after its exposure (a gain for each channel) was solved; depth is against the true depth.",
        "",
        "| way | on | known | of objects | PSNR, mean | least | SSIM | depth, signed median | median | 90 % | "
        f"off by more than {1000 * FAR:.0f} mm |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for way in WAYS:
        rows = [view for result in results for view in result[way]]
        mean = lambda key, rows=rows: float(np.mean([row[key] for row in rows]))
        for where in ("both", "all"):
            lines.append(
                f"| {way} | {where} | {100 * mean('known'):.1f} % | {100 * mean('objects known'):.1f} % | "
                f"{mean(where + ' psnr'):.2f} dB | {min(row[where + ' psnr'] for row in rows):.1f} | "
                f"{mean(where + ' ssim'):.3f} | {1000 * mean(where + ' signed'):+.2f} mm | "
                f"{1000 * mean(where + ' off'):.2f} | {1000 * mean(where + ' off 90'):.1f} | "
                f"{100 * mean(where + ' far'):.1f} % |"
            )
    lines += [
        "",
        "On objects, all that the way knows, median and 90 %: "
        + "; ".join(
            f"{way}: depth off by {1000 * np.mean([v['objects off'] for r in results for v in r[way]]):.2f} mm, "
            f"{1000 * np.mean([v['objects off 90'] for r in results for v in r[way]]):.1f}, "
            f"{np.mean([r['cpu_a_view'][way] for r in results]):.1f} CPU-s a view, compilation included"
            for way in WAYS
        )
        + ".",
        "",
        f"Measured on: {'; '.join(states)}.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure seeds, or write the page of what was measured."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.capture_views",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    steps = parser.add_subparsers(dest="step", required=True)
    measure = steps.add_parser("measure", help="measure seeds; a line of JSON each")
    measure.add_argument("seeds", type=int, nargs="+")
    measure.add_argument("-o", "--output", type=Path, required=True, metavar="JSONL")
    measure.add_argument("--views", type=int, default=24)
    measure.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    page = steps.add_parser("page", help="the page of what was measured")
    page.add_argument("results", type=Path, nargs="+", metavar="JSONL")
    page.add_argument("--page", type=Path)
    options = parser.parse_args()
    if options.step == "measure":
        state = {**describe_device(), "commit": commit()}
        for seed in unmeasured(options.seeds, options.output, state["commit"]):
            found = {**measure_seed(seed, options.views, tuple(options.size)), **state}
            append_json(options.output, found)
            print(f"seed {seed}: {found['cpu_a_view']}", file=sys.stderr, flush=True)
        return
    results = [json.loads(line) for path in options.results for line in read_lines(path)]
    results = sorted(results, key=lambda item: item["seed"])
    (width, height), views = results[0]["size"], results[0]["frames"]
    seeds = " ".join(str(item["seed"]) for item in results)
    text = tell(results, f"python -m benchmarks.capture_views measure {seeds} --views {views} --size {width} {height}")
    print(text)
    if options.page:
        write_text(options.page, text)


if __name__ == "__main__":
    main()
