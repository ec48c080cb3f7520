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
the camera, as ipjax capture pose found it (work/ignore.png), is left out.

Writes refined.json (poses with covariances), refinement.json (how well each frame is known, what is not determined),
and refinement.png (the frames' points over one another, before and after). Exits with 1 where a frame is not sure.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "refine", run, "make the poses exact, and say how well each is known", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder for what the steps make", required=True)
    parser.add_argument("--poses", type=Path, metavar="JSON", help="where to begin (default: WORK/poses.json)")
    parser.add_argument("--stages", choices=STAGES, default="global", help="how frames are taken together")
    parser.add_argument("--without-tracks", action="store_true", help="by depth alone")
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Refine the poses and write them; returns the exit status."""
    from ipjax.capture.moving import hide, read_ignored
    from ipjax.capture.poses.tracks import read_tracks
    from ipjax.capture.refinement.storing import refine_in
    from ipjax.capture.trajectories import read_trajectory
    from ipjax.inference.reports import to_json

    work: Path = options.check_folder(arguments.output)
    before = read_trajectory(arguments.poses or work / "poses.json")
    capture = open_given(arguments, poses=False)
    capture = hide(capture, read_ignored(work, capture))
    tracks = None
    if not arguments.without_tracks and (work / "tracks.npz").is_file():
        tracks = read_tracks(work / "tracks.npz")
    stages = arguments.stages.replace("-", " ")
    with Bars(quiet=arguments.quiet) as bars:
        made = refine_in(work, capture, before, tracks, stages=stages, progress=bars.show)
    for line in made.lines:
        messages.say(f"{line[0].upper()}{line[1:]}.")
    told = {key: made.document[key] for key in ("sure", "remarks", "camera_from_depth")}
    messages.finish(to_json({"poses": str(work / "refined.json")} | told))
    return 0 if made.found.sure[before.registered].all() else 1
