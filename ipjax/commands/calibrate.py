"""``ipjax calibrate``: where on a robot, or beside it, is the camera?"""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_camera

EXAMPLES = """\
examples:
  ipjax calibrate --board charuco:7x5:0.04:0.03:DICT_4X4_50 --print-board board.pdf
  ipjax calibrate images/ --robot-poses poses.json --camera camera.json --board charuco:7x5:0.04:0.03:DICT_4X4_50 \\
      --eye to-hand -o base_from_camera.json --report calibration.html
  ipjax calibrate images/ --robot-poses ur.csv --rotation rotvec --camera 615,615,320,240 \\
      --board chessboard:10x7:0.025 --eye in-hand -o gripper_from_camera.json

Print the board at 100 %, glue it to something flat, measure a square and write what you measured. The camera is either
on the hand (--eye in-hand; the board lies still) or beside the robot (--eye to-hand; the hand holds the board). Take 15
or more images, the hand at rest, turned about two axes at least, by 20° and more, the board large in the image and
seen from aside, too. The answer is gripper_from_camera or base_from_camera, 4 × 4, metres, OpenCV's camera axes.

Boards: charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY (charuco-legacy: as OpenCV printed them before 4.6), aruco:COLUMNS
xROWS:MARKER:GAP:DICTIONARY, chessboard:COLUMNSxROWS:SQUARE (squares are counted), lengths in metres.

Robot poses are base_from_gripper of each image, by its name or in the images' order: JSON or YAML (a list, or {NAME:
pose}), CSV, or rows of numbers. A pose is a matrix of 4 × 4 (a row of 16 may also go column by column), or x, y, z with
a rotation. Where the file's names do not say what its numbers are, --rotation must: xyzw or wxyz (quaternions), rotvec
(Universal Robots), rpy (ROS: about fixed x, y, z), or three axes: ZYX (KUKA's A, B, C), xyz (about fixed axes). Metres
or millimetres, radians or degrees are told by their size, or by --unit and --angles.

Each view's error is that of a calibration without it. A pair of image and pose that does not fit is left out and named;
where the pairing is shifted, or --eye is wrong, it says so and exits with 2.
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "calibrate",
        run,
        "find where the camera is on a robot, from images of a board",
        EXAMPLES,
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", nargs="*", help="images of the board, or their folder")
    parser.add_argument("--robot-poses", type=Path, metavar="FILE", help="base_from_gripper of each image; see below")
    parser.add_argument("--camera", metavar="FILE", help="BOP JSON, ROS CameraInfo, or fx,fy,cx,cy")
    parser.add_argument("--board", metavar="WORD", required=True, help="the printed board; see below")
    parser.add_argument("--eye", choices=("in-hand", "to-hand"), help="the camera is on the hand, or beside the robot")
    options.add_output(parser, "JSON", "the answer, and what is told of it")
    parser.add_argument("--rotation", metavar="WORD", help="how rotations are written: xyzw, wxyz, rotvec, rpy, ZYX …")
    parser.add_argument("--angles", choices=("rad", "deg"), help="of the robot's angles (default: by their size)")
    parser.add_argument("--unit", choices=("m", "mm"), help="of the robot's positions (default: by their size)")
    parser.add_argument("--report", type=Path, metavar="HTML", help="a page with every image and its errors")
    parser.add_argument("--print-board", type=Path, metavar="FILE", help="write the board as PDF or PNG, to print it")
    options.add_reporting(parser, quiet="no progress bar, no notes")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Print a board, or calibrate; returns the exit status."""
    from ipjax.capture.poses.boards import parse_board

    board = parse_board(arguments.board)
    if arguments.print_board is not None:
        if arguments.images:
            raise ValueError("--print-board writes the board and needs no images")
        return _print_board(board, arguments, messages)
    _check(arguments)
    from ipjax.files.cameras.reading import as_intrinsics, read_camera
    from ipjax.robot.hand_eye.from_files import calibrate_files, to_document, write_outcome
    from ipjax.robot.hand_eye.reading.observing import list_images
    from ipjax.robot.hand_eye.reading.pose_forms import Form

    form = Form(arguments.rotation, arguments.angles, arguments.unit)
    intrinsics = as_intrinsics(read_camera(parse_camera(arguments.camera)))
    images = list_images(arguments.images)
    with Bars(quiet=arguments.quiet) as bars:
        outcome = calibrate_files(
            images, arguments.robot_poses, intrinsics, board, arguments.eye, form=form, progress=bars.show
        )
    found = outcome.calibration.found
    write_outcome(arguments.output, outcome)
    if arguments.report is not None:
        from ipjax.robot.hand_eye.page import write_page

        write_page(arguments.report, outcome, intrinsics)
    _show(outcome, messages)
    messages.say(f"{arguments.output}: {found.answer}")
    messages.finish({found.answer: found.mount_from_camera.to_matrix().tolist(), "unit": "m"} | to_document(outcome))
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what is missing before the work."""
    given = {
        "images": arguments.images,
        "--robot-poses": arguments.robot_poses,
        "--camera": arguments.camera,
        "--eye": arguments.eye,
        "-o": arguments.output,
    }
    missing = [name for name, value in given.items() if not value]
    if missing:
        raise ValueError(f"a calibration needs {', '.join(missing)} (a board to print: --print-board board.pdf)")
    options.check_output(arguments.output, (".json",))
    if arguments.report is not None:
        options.check_output(arguments.report, (".html", ".htm"))
    options.check_apart([arguments.output, arguments.report], [arguments.robot_poses, arguments.camera])


def _print_board(board: Any, arguments: argparse.Namespace, messages: Messages) -> int:
    from ipjax.robot.hand_eye.printing import SUFFIXES, write_board

    path, paper = write_board(options.check_output(arguments.print_board, SUFFIXES), board)
    messages.say(f"{path}: {board.word} on {paper}; print it at 100 %, and measure the bar of 100 mm")
    messages.finish({"board": board.word, "path": str(path), "paper": paper})
    return 0


def _show(outcome: Any, messages: Messages) -> None:
    import numpy as np

    found = outcome.calibration.found
    rows = [
        (
            view.name,
            str(view.corners),
            f"{view.pixels:.2f}",
            f"{np.degrees(view.rotation):.2f}",
            f"{1000 * view.translation:.1f}",
            "" if view.counted else "left out",
        )
        for view in outcome.views
    ]
    messages.show(("image", "corners", "pixels", "rotation °", "translation mm", ""), rows)
    turn, shift = found.deviations
    rotation, translation = outcome.typical
    messages.say(
        f"{found.answer} by {len(found.used)} views: ± {np.degrees(turn):.3f}°, ± {1000 * shift:.2f} mm; a view is off "
        f"by {np.degrees(rotation):.2f}° and {1000 * translation:.1f} mm without it (median)"
    )
    for one in outcome.observations:
        if one.sighting is None:
            messages.note(f"{one.name}: {one.reason}")
    for line in (*outcome.calibration.wrong.values(), *outcome.notes):
        messages.note(line)
