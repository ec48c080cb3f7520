"""``ipjax capture depth``: depth in the pixels of the colours, of everything that the capture knows."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

MODES = ("solve", "paper", "factory")
EXAMPLES = """\
examples:
  ipjax capture depth table/ -o work/                       with work/refined.json, or work/poses.json
  ipjax capture depth table/ -o work/ --poses given.json --mode factory

Modes: solve = the depth camera is solved once, against stereo between the colours and the raw depth of all frames, and
every frame's raw depth is warped into its colours and fused with its neighbours'; paper = RobotP's Algorithm 1, every
frame for itself; factory = as the makers of the camera register it. Where the solution is weakly determined, or stereo
and depth disagree, that is said, and the factory's is kept.

Writes rgb/, depth/ (tenths of a millimetre) and camera.json, so that WORK is a folder of frames; confidence/,
depth_pictures/ (the edges of both depths over the colours) and depth.json with the figures of all modes side by side.
Interrupted, it goes on where it was. Exits with 1 where the depth camera is not to be trusted.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "depth", run, "bring depth into the pixels of the colours, without holes", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder for what the steps make", required=True)
    parser.add_argument("--poses", type=Path, metavar="JSON", help="default: WORK/refined.json, or WORK/poses.json")
    parser.add_argument("--mode", choices=MODES, default="solve", help="how (default solve)")
    parser.add_argument("--alone", action="store_true", help="every frame's own depth, not fused with its neighbours'")
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Make the depth of every frame; returns the exit status."""
    from ipjax.capture.depth.making import make_depth
    from ipjax.capture.moving import hide, read_ignored
    from ipjax.capture.records import CaptureError
    from ipjax.capture.trajectories import read_trajectory
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.reports import to_json

    work: Path = options.check_folder(arguments.output)
    candidates = [arguments.poses] if arguments.poses else [work / "refined.json", work / "poses.json"]
    poses = next((path for path in candidates if path.is_file()), None)
    if poses is None:
        raise CaptureError(f"{candidates[-1]}: no such file; make it with ipjax capture pose, or give --poses")
    trajectory = read_trajectory(poses)
    capture = open_given(arguments, poses=False)
    capture = hide(capture, read_ignored(work, capture))
    use_compilation_cache()
    with Bars(quiet=arguments.quiet) as bars:
        report = make_depth(
            capture, trajectory, work, mode=arguments.mode, fused=not arguments.alone, progress=bars.show
        )
    for line in report.lines:
        messages.say(f"{line[0].upper()}{line[1:]}.")
    solved = report.solved
    messages.finish(
        to_json(
            {
                "depth": str(work / "depth"),
                "mode": report.mode,
                "made": report.made,
                "filled": report.filled,
                "trusted": solved.trusted,
                "depth_camera": solved.rig.to_json(),
                "figures": {name: dataclasses.asdict(each) for name, each in report.figures.items()},
                "notes": list(solved.notes),
            }
        )
    )
    return 0 if solved.trusted or arguments.mode == "factory" else 1
