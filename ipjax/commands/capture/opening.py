"""The options by which every step is told its capture."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.interface.parser import parse_camera, parse_count

FORMS = ("frames", "tum", "numbered", "bop")


def add_capture(parser: Any) -> None:
    """The folder, and what it does not say itself."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the capture")
    parser.add_argument("--form", choices=FORMS, help="its form, where the folder does not show it")
    parser.add_argument("--camera", metavar="FILE", help="BOP JSON, ROS CameraInfo, or fx,fy,cx,cy (default: its own)")
    parser.add_argument("--depth-scale", type=float, metavar="S", help="metres per depth unit, e.g. 0.001")
    parser.add_argument("--every", type=parse_count, default=1, metavar="N", help="take each N-th frame only")


def open_given(arguments: argparse.Namespace, *, poses: bool = True) -> Any:
    """The capture that the options of `add_capture` name. Raises CaptureError in one sentence."""
    from ipjax.capture.reading.opening import open_capture
    from ipjax.capture.records import CaptureError

    # Both may have poses.json, ignore.png and depth/, and what was recorded cannot be made again.
    if arguments.output is not None and arguments.output.resolve() == arguments.folder.resolve():
        raise CaptureError(
            f"{arguments.output}: what is made would replace the capture's own files; give another folder"
        )
    return open_capture(
        arguments.folder,
        form=arguments.form,
        camera=None if arguments.camera is None else parse_camera(arguments.camera),
        depth_scale=arguments.depth_scale,
        poses=poses,
        every=arguments.every,
    )
