"""Refined poses: from the first ones and from far off, how exact, how sure, how well frames agree, and the cost."""

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures.comparing import compare

# From where: the first poses that ipjax finds, or the true ones with normal errors per axis, degrees and metres.
STARTS: dict[str, tuple[float, float] | None] = {
    "found": None,
    "0.2°, 2.7 mm": (0.12, 0.0016),
    "2°, 15 mm": (2.0, 0.015),
}
REAL_STARTS = {"1.5°, 10 mm": (1.5, 0.010), "2°, 15 mm": (2.0, 0.015)}
WAYS = ("global", "groups then global", "groups", "without points")
REAL = ("apc", "labelfusion", "cabinet", "kitchen")


def measure(options: Any, done: set[tuple]) -> Iterator[dict]:
    """A row for each capture, start and way that is not done."""
    from benchmarks.captures.poses import _make

    for seed in options.seeds:
        keys = [("refine", f"made {seed}", options.factory, start, way) for start in STARTS for way in WAYS]
        keys = [key for key in keys if key not in done and (key[4] in options.ways)]
        if not keys:
            continue
        with tempfile.TemporaryDirectory() as folder:
            capture, truth = _make(seed, options, Path(folder))
            found = _find(capture)
            for key in keys:
                yield {"key": key, **_try(capture, truth, found, STARTS[key[3]], key[4], seed)}
    if options.real is not None:
        for name in REAL:
            for start, size in REAL_STARTS.items():
                key = ("refine", name, 0, start, "global")
                if key not in done:
                    capture = _open(options.real / name)
                    yield {"key": key, **_try(capture, capture.world_from_camera, _find(capture), size, "global", 1)}


def _open(folder: Path) -> Any:
    from ipjax.capture.reading.opening import open_capture

    camera = "tum-fr3" if folder.name == "cabinet" else None
    return open_capture(folder, camera=camera, every=4 if folder.name == "kitchen" else 1)


def _find(capture: Any) -> Any:
    """The first poses without those that are given; None where they are refused."""
    from ipjax.capture.poses.initial import find_poses
    from ipjax.capture.records import CaptureError

    try:
        return find_poses(dataclasses.replace(capture, world_from_camera=None), "depth")
    except CaptureError:
        return None


def _try(capture: Any, truth: Any, found: Any, size: Any, way: str, seed: int) -> dict:
    from ipjax.capture.moving import find_moving, hide
    from ipjax.capture.records import Trajectory
    from ipjax.capture.refinement.agreement import list_neighbours, measure_agreement
    from ipjax.capture.refinement.certainty import off_by
    from ipjax.capture.refinement.refining import refine
    from ipjax.transforms import Similarity

    if size is None:
        if found is None:
            return {"frames": len(capture), "refused": True}
        start = found.trajectory
    else:
        rng = np.random.default_rng([seed, 51])
        step = np.repeat([np.deg2rad(size[0]), size[1]], 3) * rng.normal(size=(len(capture), 6))
        start = Trajectory(capture.names, truth @ Similarity.exp(step), np.ones(len(capture), bool), "disturbed")
    begin = time.process_time()
    moving = find_moving(capture)
    capture = hide(capture, moving)
    tracks = None if way == "without points" or found is None else found.tracks
    stages: Any = "global" if way == "without points" else way
    refined = refine(capture, start, tracks, stages=stages)
    cpu = time.process_time() - begin
    known = start.registered
    frames = [capture.read_frame(index) for index in range(len(capture))]
    depths = [np.where(frame.usable, frame.depth, 0) for frame in frames]
    poses = refined.trajectory.world_from_camera
    off = off_by(poses.take(known), truth.take(known))
    assert refined.trajectory.covariance is not None
    expected = np.sqrt(np.einsum("nii->ni", refined.trajectory.covariance[known]))
    row = {
        "frames": len(capture),
        "registered": int(known.sum()),
        "moving": float(moving.mean()),
        "bias": off.mean(0).tolist(),
        "over_expected": np.sqrt(np.mean((off / expected)[refined.sure[known]] ** 2, axis=0)).tolist()
        if refined.sure.any()
        else None,
        "sure": refined.sure.tolist(),
        "spread": refined.spread,
        "offset": refined.camera_from_depth.log()[:6].tolist(),
        "cpu": cpu,
    }
    for name, some in (("before", start.world_from_camera), ("after", poses), ("truth", truth)):
        row[f"apart_{name}"] = float(
            np.nanmedian(measure_agreement(depths, capture.camera, some, list_neighbours(known)))
        )
        for offset in (False, True):
            places, turned = compare(some, truth, known, offset=offset)
            row[f"{name}_{'offset' if offset else 'plain'}"] = [places.tolist(), turned.tolist()]
    if refined.sure.sum() > 2:
        places, turned = compare(poses, truth, refined.sure, offset=True)
        row["sure_offset"] = [places.tolist(), turned.tolist()]
    return row


def tell(rows: list[dict]) -> list[str]:
    """The tables of made and of real captures."""
    lines = [
        "## Refined poses (`ipjax capture refine`)",
        "",
        "From the first poses that `ipjax capture pose` finds, or from the true ones with normal errors in every axis. "
        "Places are compared after the worlds were laid over each other; *with offset*: and one constant motion of the "
        "camera was solved, which depth alone cannot know where its registration to the colours is off (*factory*). "
        "*Bias* is the mean of the signed errors along the camera's axes (right, down, ahead). *Over expected*: root "
        "mean square of errors over their own standard deviations, of frames that are sure.",
        "",
        "| captures | factory | from | way | place, median before → after | worst after | rotation, median before → "
        "after | worst after | with offset: place, worst | rotation, worst | bias, mm | bias, ° | sure | over "
        "expected | CPU-s |",
        "| ---: | ---: | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    made = [row for row in rows if row["key"][1].startswith("made ") and "refused" not in row]
    for factory, start, way in sorted({tuple(row["key"][2:]) for row in made}):
        mine = [row for row in made if tuple(row["key"][2:]) == (factory, start, way)]
        every = lambda name, part, mine=mine: np.concatenate([row[name][part] for row in mine])
        bias = np.mean([row["bias"] for row in mine], axis=0)
        expected = [np.sqrt(np.mean(np.square(row["over_expected"]))) for row in mine if row["over_expected"]]
        told = ", ".join(f"{1e3 * x:+.2f}" for x in bias[3:]), ", ".join(f"{np.rad2deg(x):+.3f}" for x in bias[:3])
        places, turned = every("after_plain", 0), every("after_plain", 1)
        lines.append(
            f"| {len(mine)} | {factory:g} | {start} | {way} | {1e3 * np.median(every('before_plain', 0)):.2f} → "
            f"{1e3 * np.median(places):.2f} mm | {1e3 * places.max():.2f} mm | "
            f"{np.median(every('before_plain', 1)):.3f} → {np.median(turned):.3f}° | {turned.max():.3f}° | "
            f"{1e3 * np.median(every('after_offset', 0)):.2f}, {1e3 * every('after_offset', 0).max():.2f} mm | "
            f"{np.median(every('after_offset', 1)):.3f}, {every('after_offset', 1).max():.3f}° | "
            f"{told[0]} | {told[1]} | "
            f"{sum(sum(row['sure']) for row in mine)} of {sum(row['registered'] for row in mine)} | "
            f"{np.median(expected) if expected else float('nan'):.1f} | {np.mean([row['cpu'] for row in mine]):.0f} |"
        )
    real = [row for row in rows if not row["key"][1].startswith("made ")]
    if real:
        lines += [
            "",
            "Real captures from disturbed poses, against those of a robot (apc, labelfusion), motion capture (cabinet) "
            "or KinectFusion (kitchen), a constant offset of the camera solved. *Apart*: median difference of depth "
            "between frames that follow one another.",
            "",
            "| capture | from | apart before → after (given poses) | place, median, worst | rotation, median, worst "
            "| sure | of the sure ones: place, worst | rotation, worst | moves with the camera | CPU-s |",
            "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        ]
    for row in real:
        places, turned = (np.array(part) for part in row["after_offset"])
        sure = row.get("sure_offset")
        apart = [1e3 * row[f"apart_{name}"] for name in ("before", "after", "truth")]
        own = f"{1e3 * max(sure[0]):.1f} mm | {max(sure[1]):.2f}°" if sure else "– | –"
        lines.append(
            f"| {row['key'][1]} | {row['key'][3]} | {apart[0]:.1f} → {apart[1]:.1f} mm ({apart[2]:.1f}) | "
            f"{1e3 * np.median(places):.1f}, {1e3 * places.max():.1f} mm | "
            f"{np.median(turned):.2f}, {turned.max():.2f}° | {sum(row['sure'])} of {row['frames']} | {own} | "
            f"{100 * row['moving']:.0f} % | {row['cpu']:.0f} |"
        )
    return lines
