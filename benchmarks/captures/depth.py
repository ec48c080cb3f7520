"""Depth in the pixels of the colours: how exact, on objects and their borders, how full, by which way, at what cost."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

SPREAD = (np.deg2rad(0.05), 0.001)  # of the poses: standard deviation of the whole rotation (rad) and place (m)
EVERY = 8  # frames of a made capture: each so-many-th is judged
_BORDER = 3  # pixels inside an object that count as its border
WAYS = ("factory", "paper", "true rig", "solved", "solved, smoothed", "fused", "fused with stereo")
UNKNOWN = "unknown rig"


def measure(options: Any, done: set[tuple]) -> Iterator[dict]:
    """A row for each capture, told the factory's calibration and not told it; and for each real capture."""
    for seed in options.seeds:
        keys = {told: ("depth", f"made {seed}", options.factory, options.views, told) for told in (True, False)}
        if set(keys.values()) <= done:
            continue
        from ipjax.synthetic.captures import make_capture

        made = make_capture(seed, views=options.views, factory_error=options.factory)
        for told, key in keys.items():
            if key not in done:
                yield {"key": key, **_judge(made, seed, told)}
    if options.real is not None:
        yield from _measure_real(options.real, done)


def _judge(made: Any, seed: int, told: bool) -> dict:
    from ipjax.capture.depth.fusion import NEIGHBOURS, fuse
    from ipjax.capture.depth.making import DepthMaker
    from ipjax.capture.depth.rigs import Rig, difference
    from ipjax.capture.depth.stereo import sweep_view
    from ipjax.capture.depth.warping import smooth_depth, warp

    maker = DepthMaker(*_pretend(made, seed, told))
    start = time.process_time()
    solved = maker.solve()
    cpu = {"solve": (time.process_time() - start) / len(made.names)}
    truth = Rig(np.asarray(made.depth_camera.to_matrix(), float), made.colour_from_depth)
    height, width = made.depth.shape[1:]
    rows: dict[str, list[list[float]]] = {way: [] for way in WAYS}
    confident: list[np.ndarray] = []
    for index in range(0, len(made.names), EVERY):
        start = time.process_time()
        fused = maker.by_rig(index, solved.rig)
        cpu.setdefault("fuse", time.process_time() - start)
        cpu["fuse"] = min(cpu["fuse"], time.process_time() - start)
        start = time.process_time()
        paper = maker.by_paper(index)
        cpu["paper"] = min(cpu.get("paper", np.inf), time.process_time() - start)
        own = warp(maker.raw(index), solved.rig, maker.K, maker.size)
        views = maker.shrink()
        stereo = sweep_view(views, index, base=smooth_depth(warp(maker.raw(index), solved.rig, views.K, views.size)))
        rows_of = (np.arange(height) * views.size[1] // height)[:, None], np.arange(width) * views.size[0] // width
        sure = np.where(stereo.sure, stereo.depth, 0).astype(np.float32)[rows_of]
        images = {
            "factory": made.depth[index],
            "paper": paper,
            "true rig": warp(maker.raw(index), truth, maker.K, maker.size),
            "solved": own,
            "solved, smoothed": smooth_depth(own),
            "fused": fused.depth,
            "fused with stereo": fuse(fused.depth, [sure], slots=NEIGHBOURS).depth,
        }
        for way, depth in images.items():
            rows[way].append(_compare(depth, made.true_depth[index], made.ids[index]))
        error = np.abs(fused.depth - made.true_depth[index])
        near = (fused.depth > 0) & (made.true_depth[index] < 1.3)
        confident.append(np.stack([fused.confidence[near], error[near]]))
    confidence, error = np.concatenate(confident, axis=1)
    bins = [(confidence > low) & (confidence <= low + 0.2) for low in (0.0, 0.2, 0.4, 0.6, 0.8)]
    return {
        "ways": {way: np.nanmean(each, axis=0).tolist() for way, each in rows.items()},
        "apart": difference(solved.solution, truth).tolist(),
        "deviation": solved.deviation.tolist(),
        "trusted": solved.trusted,
        "notes": list(solved.notes),
        "by_confidence": [[float(k.mean()), 1e3 * float(np.median(error[k])) if k.any() else None] for k in bins],
        "cpu": cpu,
    }


def _pretend(made: Any, seed: int, told: bool) -> tuple[Any, Any]:
    """The capture as a reader would give it, and its poses, each a little wrong."""
    from ipjax.capture.records import Capture, CaptureFrame, Trajectory
    from ipjax.transforms import Similarity

    height, width = made.depth.shape[1:]
    usable = np.ones((height, width), bool)

    def read(index: int) -> CaptureFrame:
        return CaptureFrame(
            made.names[index], made.rgb[index], made.depth[index], made.raw_depth[index], usable & ~made.gripper
        )

    capture = Capture(
        folder=Path("made"),
        form="frames",
        names=made.names,
        camera=made.camera,
        size=(width, height),
        read_frame=read,
        depth_camera=made.factory_depth_camera,
        depth_size=made.raw_depth.shape[:0:-1],
        colour_from_depth=made.factory_colour_from_depth if told else None,
    )
    rng, count = np.random.default_rng([seed, 7]), len(made.names)
    # Lengths of the three axes together have these medians: 1.54 is the median length of a standard normal vector.
    step = np.concatenate([rng.normal(0, spread / 1.54, (count, 3)) for spread in SPREAD], axis=1)
    poses = made.world_from_camera @ Similarity[np.ndarray].exp(step)
    return capture, Trajectory(made.names, poses, np.ones(count, bool), "true, disturbed")


def _compare(depth: np.ndarray, truth: np.ndarray, ids: np.ndarray) -> list[float]:
    """Objects: median error and bias (mm), 75 % of their borders (mm), filled (%); table: median (mm)."""
    objects, known = ids >= 0, depth > 0
    border = objects & np.asarray(ndimage.binary_dilation(~objects, iterations=_BORDER), bool)
    table = ~objects & (truth < 1.2) & known
    error = 1e3 * (depth - truth)
    percentile = lambda where, share: float(np.percentile(np.abs(error[where]), share)) if where.any() else np.nan
    seen = objects & known
    return [
        percentile(seen, 50),
        float(np.median(error[seen])) if seen.any() else np.nan,
        percentile(border & known, 75),
        100 * float(known[objects].mean()) if objects.any() else np.nan,
        percentile(table, 50),
    ]


def _measure_real(folder: Path, done: set[tuple]) -> Iterator[dict]:
    from ipjax.capture.depth.figures import measure_modes
    from ipjax.capture.depth.making import DepthMaker
    from ipjax.capture.depth.solving import spread
    from ipjax.capture.moving import find_moving, hide
    from ipjax.capture.reading.opening import open_capture
    from ipjax.capture.records import Trajectory

    for name in ("apc", "labelfusion", "cabinet"):
        key = ("depth", name)
        if key in done or not (folder / name).is_dir():
            continue
        capture = open_capture(folder / name, camera="tum-fr3" if name == "cabinet" else None)
        capture = hide(capture, find_moving(capture))
        if capture.world_from_camera is None:
            continue
        poses = Trajectory(capture.names, capture.world_from_camera, np.ones(len(capture), bool), "given")
        maker = DepthMaker(capture, poses)
        start = time.process_time()
        solved = maker.solve()
        cpu = {"solve": (time.process_time() - start) / len(capture)}
        figures = measure_modes(maker, solved.rig, spread(len(capture), 2))
        told = {way: each.tell() for way, each in figures.items()}
        yield {"key": key, "trusted": solved.trusted, "notes": list(solved.notes), "figures": told, "cpu": cpu}


def tell(rows: list[dict]) -> list[str]:
    """The tables."""
    made = [row for row in rows if row["key"][1].startswith("made ")]
    lines = [
        "## Depth in the pixels of the colours (`ipjax capture depth`)",
        "",
        "Made captures with sensor noise; poses disturbed by a median of 1 mm and 0.05°, each for itself, which stereo "
        "feels more than poses that were refined together. *factory*: registered with its wrong calibration; *paper*: "
        "RobotP's Algorithm 1; *solved*: the depth camera solved once, frames warped; *fused*: with four neighbours' "
        "depth; *true rig*: what warping alone could reach. Objects: medians over captures of each capture's mean; "
        f"border: the outer {_BORDER} pixels of an object; *within*: captures with objects ≤ 1.6 mm, border ≤ 4 mm and "
        "≥ 95 % filled.",
        "",
        "| calibration | way | captures | objects, median | worst | bias | border, 75 % | worst | filled | table | "
        "within |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for told in (True, False):
        mine = [row for row in made if row["key"][4] is told]
        for way in WAYS if mine else ():
            table = np.array([row["ways"][way] for row in mine], float)
            middle, worst = np.nanmedian(table, axis=0), np.nanmax(table, axis=0)
            good = (table[:, 0] <= 1.6) & (table[:, 2] <= 4) & (table[:, 3] >= 95)
            lines.append(
                f"| {'given' if told else UNKNOWN} | {way} | {len(mine)} | {middle[0]:.2f} mm | {worst[0]:.2f} | "
                f"{middle[1]:+.2f} | {middle[2]:.1f} mm | {worst[2]:.1f} | {middle[3]:.1f} % | {middle[4]:.2f} mm | "
                f"{good.sum()} |"
            )
    for told in (True, False):
        mine = [row for row in made if row["key"][4] is told]
        if not mine:
            continue
        apart = np.abs([row["apart"] for row in mine])
        turn, shift = np.rad2deg(apart[:, :3].max(1)), 1e3 * apart[:, 3:6].max(1)
        inside = (apart <= 3 * np.array([row["deviation"] for row in mine])).mean()
        cost = {name: np.median([row["cpu"][name] for row in mine]) for name in ("solve", "fuse", "paper")}
        lines += [
            "",
            f"The rig, {'given' if told else UNKNOWN}: trusted in {sum(row['trusted'] for row in mine)} of {len(mine)} "
            f"captures; largest axis {np.median(turn):.2f}° (worst {turn.max():.2f}°) and {np.median(shift):.1f} mm "
            f"(worst {shift.max():.1f}), focal length {100 * np.median(apart[:, 6]):.2f} %, scale "
            f"{100 * np.median(apart[:, 7]):.2f} %; {100 * inside:.0f} % of its numbers within three of the deviations "
            f"that it tells. CPU-s a frame: solving {cost['solve']:.2f}, warping and fusing {cost['fuse']:.2f}; the "
            f"paper's way {cost['paper']:.2f} beside its stereo.",
        ]
    if made:
        parts = []
        for k in range(5):
            shares = [row["by_confidence"][k] for row in made]
            errors = [error for _, error in shares if error is not None]
            if errors:
                parts.append(
                    f"{0.2 * k:.1f}–{0.2 * (k + 1):.1f}: {100 * np.mean([s for s, _ in shares]):.1f} % of the pixels, "
                    f"{np.median(errors):.1f} mm"
                )
        lines += ["", f"Median error by confidence: {'; '.join(parts)}."]
    for row in rows:
        if row not in made:
            figures = "; ".join(f"{way}: {text}" for way, text in row["figures"].items())
            lines += [
                "",
                f"{row['key'][1]} (given poses): {'trusted' if row['trusted'] else 'not trusted'}. "
                f"{'. '.join(row['notes'])}. {figures}. {row['cpu']['solve']:.2f} CPU-s a frame to solve.",
            ]
    return lines
