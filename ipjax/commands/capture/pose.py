"""``ipjax capture pose``: where did the camera stand?"""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

METHODS = ("auto", "given", "board", "structure", "depth")
EXAMPLES = """\
examples:
  ipjax capture pose table/ -o work/
  ipjax capture pose table/ -o work/ --method structure            motion by COLMAP: pip install 'ipjax[capture]'
  ipjax capture pose table/ -o work/ --board charuco:7x5:0.04:0.03:DICT_4X4_50

Methods: given = the poses that the capture has; board = a printed board is the world, KIND:COLUMNSxROWS:LENGTH:LENGTH:
DICTIONARY, with the squares and markers of a charuco board, or the markers of an aruco board and the gaps between them,
in metres, or chessboard:COLUMNSxROWS:LENGTH of squares; depth = features and their depth; structure = structure from
motion, its scale by depth. auto = the board if one is described, else the poses given, else depth, and structure where
that leaves frames out.

Writes poses.json, tracks.npz (points recognised in several frames), trajectory.png, and ignore.png where something is
found that moves with the camera; removes what ipjax capture refine made of earlier poses. Exits with 1 where frames are
left without a pose.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "pose", run, "find where the camera stood, frame by frame, in metres", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder for what the steps make", required=True)
    parser.add_argument("--method", choices=METHODS, default="auto", help="how (default auto)")
    parser.add_argument("--board", metavar="WORD", help="a board that lies in the scene; see below")
    parser.add_argument("--keep-gripper", action="store_true", help="do not look for things that move with the camera")
    options.add_seed(parser)
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Find the poses and write them; returns the exit status."""
    from ipjax.capture.poses.boards import parse_board
    from ipjax.capture.poses.initial import find_poses
    from ipjax.capture.poses.storing import write_poses

    work: Path = options.check_folder(arguments.output)
    board = None if arguments.board is None else parse_board(arguments.board)
    capture = open_given(arguments)
    with Bars(quiet=arguments.quiet) as bars:
        found = find_poses(
            capture,
            arguments.method,
            board=board,
            find_gripper=not arguments.keep_gripper,
            seed=options.check_seed(arguments.seed),
            progress=bars.show,
        )
    for name in ("refined.json", "refinement.json", "refinement.png"):  # they are of other poses, and would go before
        (work / name).unlink(missing_ok=True)
    lines = write_poses(work, capture, found)
    for line in lines:
        messages.say(f"{line[0].upper()}{line[1:]}.")
    trajectory = found.trajectory
    lost = [name for name, known in zip(trajectory.names, trajectory.registered, strict=True) if not known]
    messages.finish(
        {
            "poses": str(work / "poses.json"),
            "source": trajectory.source,
            "registered": int(trajectory.registered.sum()),
            "without_a_pose": lost,
            "scale": trajectory.scale,
            "agreement": trajectory.agreement,
            "points": found.tracks.count,
            "pixels_off": None if found.off != found.off else found.off,
            "depth_off": None if found.depth_off != found.depth_off else found.depth_off,
            "notes": list(found.notes),
        }
    )
    return 1 if lost else 0
