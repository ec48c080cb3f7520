"""``ipjax capture refine``: the poses made exact, and how well each is known."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

STAGES = ("global", "groups", "groups-then-global")
EXAMPLES = """\
examples:
  ipjax capture refine table/ -o work/                       begins with work/poses.json, of ipjax capture pose
  ipjax capture refine table/ -o work/ --poses given.json

Depth images are brought to agree, and points that were recognised in several frames (work/tracks.npz). What moves with
the camera is looked for, too, and left out, with what work/ignore.png hides.

Writes refined.json (poses with covariances), refinement.json (how well each frame is known, what is not determined),
refinement.png (the frames' points over one another, before and after), and ignore.png where something moves with the
camera. Exits with 1 where a frame is not sure.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "refine", run, "make the poses exact, and say how well each is known", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder for what the steps make", required=True)
    parser.add_argument("--poses", type=Path, metavar="JSON", help="where to begin (default: WORK/poses.json)")
    parser.add_argument("--stages", choices=STAGES, default="global", help="how frames are taken together")
    parser.add_argument("--without-tracks", action="store_true", help="by depth alone")
    parser.add_argument("--keep-gripper", action="store_true", help="do not look for things that move with the camera")
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Refine the poses and write them; returns the exit status."""
    import numpy as np

    from ipjax.capture.moving import find_moving
    from ipjax.capture.poses.tracks import read_tracks
    from ipjax.capture.refinement.agreement import draw_agreement, list_neighbours, measure_agreement
    from ipjax.capture.refinement.refining import describe, refine
    from ipjax.capture.trajectories import read_trajectory, write_trajectory
    from ipjax.files.images.masks import read_mask
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.drawing import write_image
    from ipjax.inference.reports import to_json

    work: Path = options.check_folder(arguments.output)
    before = read_trajectory(arguments.poses or work / "poses.json")
    capture = open_given(arguments, poses=False)
    if capture.names != before.names:
        raise ValueError(f"{arguments.poses or work / 'poses.json'}: it is of other frames than {capture.folder}")
    tracks = None
    if not arguments.without_tracks and (work / "tracks.npz").is_file():
        tracks = read_tracks(work / "tracks.npz")
    width, height = capture.size
    ignore = read_mask(work / "ignore.png") if (work / "ignore.png").is_file() else np.zeros((height, width), bool)
    if ignore.shape != (height, width):
        raise ValueError(f"{work / 'ignore.png'}: it is of another size than the frames, {width} × {height}")
    if not arguments.keep_gripper:
        ignore = ignore | find_moving(capture)
    with Bars(quiet=arguments.quiet) as bars:
        found = refine(
            capture,
            before,
            tracks,
            ignore=ignore,
            stages=arguments.stages.replace("-", " "),
            progress=bars.show,
        )
    depths: list[Any] = [None] * len(capture)
    for index in np.flatnonzero(before.registered):
        frame = capture.read_frame(int(index))
        depths[index] = np.where(frame.usable & ~ignore, frame.depth, 0)
    neighbours = list_neighbours(before.registered)
    apart = [
        measure_agreement(depths, capture.camera, poses.world_from_camera, neighbours)
        for poses in (before, found.trajectory)
    ]
    lines = describe(found, *(float(np.nanmedian(each)) if np.isfinite(each).any() else None for each in apart))
    work.mkdir(parents=True, exist_ok=True)
    write_image(work / "refinement.png", draw_agreement(depths, capture.camera, before, found.trajectory, lines[:6]))
    if ignore.any():
        write_image(work / "ignore.png", ignore.astype("uint8") * 255)
    names = capture.names
    report = {
        "poses": str(work / "refined.json"),
        "sure": [name for name, sure in zip(names, found.sure, strict=True) if sure],
        "remarks": {name: text for name, text in zip(names, found.remarks, strict=True) if text},
        "pairs": [
            {
                "frames": [names[i], names[j]],
                "agreeing_before": round(float(a), 4),
                "agreeing_after": round(float(b), 4),
            }
            for (i, j), a, b in zip(found.pairs, found.share_before, found.share_after, strict=True)
        ],
        "neighbours_apart_before": [None if np.isnan(x) else float(x) for x in apart[0]],
        "neighbours_apart_after": [None if np.isnan(x) else float(x) for x in apart[1]],
        "camera_from_depth": found.camera_from_depth.to_matrix().tolist() if found.offset_told else None,
    }
    write_text(work / "refinement.json", to_json(report) + "\n")
    write_trajectory(work / "refined.json", found.trajectory)
    for line in lines:
        messages.say(f"{line[0].upper()}{line[1:]}.")
    messages.finish(to_json({key: report[key] for key in ("poses", "sure", "remarks", "camera_from_depth")}))
    return 0 if found.sure[before.registered].all() else 1
