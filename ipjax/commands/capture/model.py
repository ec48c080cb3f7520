"""``ipjax capture model``: what stands on the table?"""

import argparse
import hashlib
import json
import re
from pathlib import Path
from typing import Any

from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax capture model table/ -o work/
  ipjax capture model table/ -o work/ --object mug:312,204 --object box:420,233@000007
  ipjax capture model table/ -o work/ --object mug:280,160,70,90 --voxel 1.5 --close

Objects are what stands on the table, apart from one another. Those that touch are told apart by the creases between
them, or by a pixel or a box of each in one frame: --object NAME:X,Y or NAME:X,Y,W,H, with @FRAME where it is not the
first. Where something else than the table is taken for what they stand on, as the front of a large box may be,
--support X,Y tells.

Reads WORK/refined.json or WORK/poses.json, and WORK/depth/, if the step depth made it. Writes WORK/models/: NAME.ply
and NAME_points.ply of each object, scene.ply and scene_points.ply, models.json; and the picture WORK/models.png.
"""


_IN_MEMORY = 100_000_000  # pixels of all frames together: about 1 GB


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "model", run, "make models of the objects and of the scene", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder of what the steps make", required=True)
    add_objects(parser)
    add_again(parser)
    options.add_reporting(parser, quiet="no progress bar")


def add_objects(parser: Any) -> None:
    """The options that say which objects there are, and how their models are made."""
    parser.add_argument(
        "--object", action="append", type=_parse_hint, metavar="NAME:X,Y[,W,H]", help="one, by a pixel or a box of it"
    )
    parser.add_argument("--support", type=_parse_pixel, metavar="X,Y", help="a pixel of what they stand on")
    parser.add_argument("--voxel", type=float, default=2.0, metavar="MM", help="of the objects (default 2)")
    parser.add_argument("--close", action="store_true", help="close the bottoms, on which the objects stand")
    parser.add_argument("--together", action="store_true", help="do not divide what touches without being told")
    parser.add_argument(
        "--shape-symmetries", action="store_true", help="symmetric is what the shape, not the colour, is"
    )


def read_objects(arguments: argparse.Namespace) -> tuple[list[Any], Any]:
    """What `add_objects` says: hints, and a ModelConfig; ValueError, in words, where it cannot be."""
    from ipjax.capture.models.making import ModelConfig

    if not 0.3 <= arguments.voxel <= 20:
        raise ValueError(f"--voxel is in millimetres, from 0.3 to 20, not {arguments.voxel:g}")
    config = ModelConfig(
        voxel=arguments.voxel / 1000,
        alone=not arguments.together,
        close=arguments.close,
        colour_symmetries=not arguments.shape_symmetries,
    )
    return arguments.object or [], config


def add_again(parser: Any) -> None:
    """``--again``: a step whose result is there is not repeated otherwise."""
    parser.add_argument("--again", action="store_true", help="even if what is there was made of the same")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Make the models and write them; returns the exit status."""
    from ipjax.capture.labels.pictures import draw_models
    from ipjax.capture.models.making import make_models
    from ipjax.capture.models.storing import check_place, read_made_of, write_models
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.drawing import write_image

    work: Path = options.check_folder(arguments.output)
    hints, config = read_objects(arguments)
    frames = open_frames(arguments, work)
    made_of = describe_inputs(arguments, work, {"config": repr(config), "hints": repr([*hints, arguments.support])})
    folder = work / "models"
    check_place(folder)
    if read_made_of(folder) == made_of and not arguments.again:
        messages.say(f"{folder} was made of the same already; --again makes it once more.")
        messages.finish({"models": str(folder), "made": False})
        return 0
    use_compilation_cache()
    with Bars(quiet=arguments.quiet) as bars:
        found = make_models(frames, hints, config, support_at=arguments.support, progress=bars.show)
    write_models(folder, found, made_of)
    write_image(work / "models.png", draw_models(found.objects))
    for line in found.notes:
        messages.say(f"{line[0].upper()}{line[1:]}.")
    messages.finish(
        {
            "models": str(folder),
            "made": True,
            "objects": [item.name for item in found.objects],
            "notes": list(found.notes),
        }
    )
    return 0


def open_frames(arguments: argparse.Namespace, work: Path, poses: Path | None = None) -> Any:
    """The frames of the capture with the best poses and depth that the steps before left in the folder, or with the
    poses of a file.
    """
    from ipjax.capture.models.frames import CaptureFrames
    from ipjax.capture.moving import read_ignored
    from ipjax.capture.records import CaptureError
    from ipjax.capture.trajectories import read_trajectory

    capture = open_given(arguments, poses=False)
    found = poses or find_poses(work)
    if found is None:
        raise CaptureError(f"{work}: it has no poses.json; make it with ipjax capture pose")
    improved = work if (work / "depth").is_dir() else None
    frames = CaptureFrames(capture, read_trajectory(found), improved, read_ignored(work, capture))
    # Every frame is looked at several times: short captures are kept in memory.
    pixels = len(frames) * capture.size[0] * capture.size[1]
    return list(frames) if pixels < _IN_MEMORY else frames


def find_poses(work: Path) -> Path | None:
    """The refined poses where they are, else the first ones."""
    return next((path for path in (work / "refined.json", work / "poses.json") if path.is_file()), None)


def describe_inputs(arguments: argparse.Namespace, work: Path, about: dict[str, Any], poses: Path | None = None) -> str:
    """A word that is another whenever the capture, the poses, the depth or the settings are."""
    files = [path for path in (poses or find_poses(work), work / "ignore.png") if path is not None and path.is_file()]
    texts = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    lists = {}
    own = work.resolve()  # may lie in the capture's folder, and what is in it changes with every step
    for kind, folder in (("capture", arguments.folder), ("depth", work / "depth"), ("confidence", work / "confidence")):
        if folder.is_dir():
            entries = sorted(p for p in folder.rglob("*") if p.is_file())
            if kind == "capture":
                entries = [p for p in entries if not p.resolve().is_relative_to(own)]
            lists[kind] = [(str(p.relative_to(folder)), p.stat().st_size, p.stat().st_mtime_ns) for p in entries]
    told = [arguments.form, arguments.camera, arguments.depth_scale, arguments.every, texts, lists, about]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def _parse_pixel(text: str) -> Any:
    try:
        hint = _parse_hint(f"support:{text}")
    except argparse.ArgumentTypeError:
        hint = None
    if hint is None or hint.right is not None:
        raise argparse.ArgumentTypeError(f"{text!r} is no pixel: give X,Y or X,Y@FRAME")
    return hint


def _parse_hint(text: str) -> Any:
    from ipjax.capture.models.separation import Hint

    found = re.fullmatch(r"(?P<name>[^:@]+):(?P<numbers>[-\d.,]+)(@(?P<frame>.+))?", text)
    try:
        numbers = [float(part) for part in found["numbers"].split(",")] if found else []
    except ValueError:
        numbers = []
    if found is None or len(numbers) not in (2, 4):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no hint: give NAME:X,Y or NAME:X,Y,W,H, for instance mug:312,204 or mug:280,160,70,90@000007"
        )
    x, y = numbers[:2]
    box = {} if len(numbers) == 2 else {"right": x + numbers[2], "bottom": y + numbers[3]}
    return Hint(found["name"], found["frame"], x, y, **box)
