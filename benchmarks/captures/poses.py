"""First poses: how many frames are placed, how exactly, how much too large, and what it costs."""

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures.comparing import compare, compare_scale

WAYS = ("depth", "structure")


def measure(options: Any, done: set[tuple]) -> Iterator[dict]:
    """A row for each capture and way that is not done."""
    for seed in options.seeds:
        keys = {way: ("poses", f"made {seed}", options.factory, options.views, way) for way in WAYS}
        if set(keys.values()) <= done:
            continue
        with tempfile.TemporaryDirectory() as folder:
            capture, truth = _make(seed, options, Path(folder))
            for way, key in keys.items():
                if key not in done:
                    yield {"key": key, **_try(capture, truth, way, offset=False)}
    if options.real is not None:
        from ipjax.capture.reading.opening import open_capture

        for folder in sorted(path for path in options.real.iterdir() if path.is_dir()):
            camera = "tum-fr3" if folder.name == "cabinet" else None
            capture = open_capture(folder, camera=camera, every=4 if folder.name == "kitchen" else 1)
            truth = capture.world_from_camera
            for gripper in (True, False):
                for way in WAYS:
                    key = ("poses", folder.name, gripper, len(capture), way)
                    if key not in done:
                        yield {"key": key, **_try(capture, truth, way, offset=True, find_gripper=gripper)}


def _make(seed: int, options: Any, folder: Path) -> tuple[Any, Any]:
    """A capture as its user has it, and its true poses; every third has a gripper."""
    from ipjax.capture.reading.opening import open_capture
    from ipjax.synthetic.captures import make_capture, write_capture

    made = make_capture(seed, views=options.views, factory_error=options.factory, gripper=seed % 3 == 0)
    return open_capture(write_capture(made, folder)), made.world_from_camera


def _try(capture: Any, truth: Any, way: str, *, offset: bool, find_gripper: bool = True) -> dict:
    from ipjax.capture.poses.initial import find_poses
    from ipjax.capture.records import CaptureError

    start = time.process_time()
    try:
        found = find_poses(dataclasses.replace(capture, world_from_camera=None), way, find_gripper=find_gripper)
    except CaptureError as error:
        return {"frames": len(capture), "refused": str(error), "cpu": time.process_time() - start}
    cpu = time.process_time() - start
    trajectory, known = found.trajectory, found.trajectory.registered
    places, turned = compare(trajectory.world_from_camera, truth, known, offset=offset)
    return {
        "frames": len(capture),
        "registered": int(known.sum()),
        "agreement": trajectory.agreement,
        "still": float(found.still.mean()),
        "scale": compare_scale(trajectory.world_from_camera, truth, known),
        "places": places.tolist(),
        "turned": turned.tolist(),
        "pixels": found.off,
        "cpu": cpu,
    }


def tell(rows: list[dict]) -> list[str]:
    """The tables of made and of real captures."""
    made = [row for row in rows if row["key"][1].startswith("made ")]
    lines = [
        "## First poses (`ipjax capture pose`)",
        "",
        "*depth*: features and their depth, adjusted together; *structure*: structure from motion by COLMAP, scale by "
        "depth. Both have the same features and matches. Places are compared after the worlds were laid over each "
        "other, without changing the scale; *scale* is how much too large the trajectory is; *CPU* is all of it, from "
        "reading to poses. *factory*: how wrong the given calibration of the depth camera is, in units of 2 mm and "
        "0.25° per axis; a millimetre along the camera's axis is 0.14 % of the scale, whatever finds the poses.",
        "",
        "| captures | factory | by | frames placed | refused | place, rms | median over captures | worst | rotation, "
        "median | worst | scale, median | worst | within 0.3 % | agreement, least | CPU-s |",
        "| ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for factory, way in sorted({(row["key"][2], row["key"][4]) for row in made}):
        mine = [row for row in made if (row["key"][2], row["key"][4]) == (factory, way)]
        good = [row for row in mine if "refused" not in row]
        rms = [1e3 * np.sqrt(np.mean(np.square(row["places"]))) for row in good]
        turned = [np.median(row["turned"]) for row in good]
        scale = np.abs([100 * row["scale"] for row in good])
        placed = sum(row["registered"] for row in good)
        lines.append(
            f"| {len(mine)} | {factory:g} | {way} | {placed} of {sum(row['frames'] for row in mine)} | "
            f"{len(mine) - len(good)} | {np.sqrt(np.mean(np.square(rms))):.2f} mm | {np.median(rms):.2f} | "
            f"{max(rms):.2f} | {np.median(turned):.3f}° | {max(max(row['turned']) for row in good):.2f}° | "
            f"{np.median(scale):.2f} % | {scale.max():.2f} % | {(scale <= 0.3).sum()} of {len(good)} | "
            f"{100 * min(row['agreement'] for row in good):.0f} % | {np.mean([row['cpu'] for row in mine]):.1f} |"
        )
    real = [row for row in rows if row not in made]
    if real:
        lines += [
            "",
            "Real captures, against the poses of a robot (apc, labelfusion), motion capture (cabinet) or KinectFusion "
            "(kitchen), with one constant offset of the camera solved. *hidden*: what is found that moves with the "
            "camera is left out, or not. The depth of kitchen is not registered to its colours.",
            "",
            "| capture | hidden | by | frames placed | place, rms | rotation, median | worst | agreement | CPU-s |",
            "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
        ]
    for row in real:
        _, name, gripper, _, way = row["key"]
        head = f"| {name} | {'yes' if gripper else 'no'} | {way} | "
        if "refused" in row:
            lines.append(head + f"refused: {row['refused']} | | | | | {row['cpu']:.1f} |")
            continue
        rms = 1e3 * np.sqrt(np.mean(np.square(row["places"])))
        lines.append(
            head + f"{row['registered']} of {row['frames']} | {rms:.1f} mm | {np.median(row['turned']):.2f}° | "
            f"{max(row['turned']):.2f}° | {100 * row['agreement']:.0f} % | {row['cpu']:.1f} |"
        )
    return lines
