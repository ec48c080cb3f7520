"""``ipjax capture arrange``: models dropped onto a table, with the truth."""

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

from ipjax.commands.capture.model import add_again
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_count

EXAMPLES = """\
examples:
  ipjax capture arrange work/models/ -o made/                        all models that ipjax capture model made
  ipjax capture arrange mug.ply box.obj --unit mm -o made/ --scenes 20 --things 6
  ipjax capture arrange ycbv/models/ -o made/ --things 8 --noise     models of a BOP data set, a cheap camera
  ipjax capture arrange mug.ipjax box.ipjax -o made/                 objects that were onboarded with --unit

The models fall onto a table, one after another and turned at random, until all rest (MuJoCo; each collides as its
convex hull). What falls off, or is in another by more than 0.8 mm, is dropped anew. Table, room and light are other in
each scene; the light stays where it is as the camera moves. The same seed makes the same scenes.

Writes a data set in BOP's layout: images, exact depth (--noise: as a structured-light camera has it), masks, poses,
boxes, visible shares, models; and DATASET.png beside it.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "arrange", run, "draw models in new arrangements, with the truth", EXAMPLES)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODELS", help="folders, meshes, object files")
    options.add_output(parser, "DATASET", "folder of the data set", required=True)
    parser.add_argument("--unit", choices=("m", "cm", "mm", "inch"), default="m", help="of mesh files (default m)")
    parser.add_argument("--scenes", type=parse_count, default=1, metavar="N", help="arrangements (default 1)")
    parser.add_argument("--count", type=parse_count, default=12, metavar="N", help="views of each (default 12)")
    parser.add_argument("--things", type=parse_count, metavar="N", help="in each (default: every model once)")
    parser.add_argument("--size", type=_parse_size, default=(640, 480), metavar="WxH", help="pixels (default 640x480)")
    parser.add_argument("--noise", action="store_true", help="colours and depth as a cheap camera has them")
    add_again(parser)
    options.add_seed(parser)
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Arrange the models and write the data set; returns the exit status."""
    from ipjax.capture.labels.dataset import LabelledScene, check_dataset, read_made_of, write_scenes
    from ipjax.capture.labels.pictures import draw_labels
    from ipjax.capture.views.arranging import arrange
    from ipjax.capture.views.gathering import gather_models
    from ipjax.inference.drawing import write_image
    from ipjax.synthetic.sensor import PERFECT, STRUCTURED_LIGHT

    root: Path = options.check_folder(arguments.output)
    check_dataset(root)
    seed = options.check_seed(arguments.seed)
    models = gather_models(arguments.models, arguments.unit)
    made_of = _describe(arguments)
    if read_made_of(root) == made_of and not arguments.again:
        messages.say(f"{root} was made of the same already; --again makes it once more.")
        messages.finish({"dataset": str(root), "made": False})
        return 0
    found = []
    with Bars(quiet=arguments.quiet) as bars:
        for number in range(arguments.scenes):
            found.append(
                arrange(
                    models,
                    seed + number,
                    views=arguments.count,
                    count=arguments.things,
                    size=arguments.size,
                    sensor=STRUCTURED_LIGHT if arguments.noise else PERFECT,
                )
            )
            bars.show("arranging", number + 1, arguments.scenes)
        write_scenes(
            root,
            models,
            [LabelledScene(one.frames, one.labels, one.which) for one in found],
            replace=True,
            about={"made_of": made_of, "seed": seed},
            progress=lambda done, total: bars.show("writing", done, total),
        )
    names = [models[i].name for i in found[0].which]
    write_image(root.with_name(root.name + ".png"), draw_labels(found[0].frames, found[0].labels, names))
    deepest = max(one.deep for one in found)
    messages.say(
        f"{len(found)} arrangements of {len(found[0].which)} things, {arguments.count} views each; the deepest contact "
        f"is {1000 * deepest:.2f} mm: {root}"
    )
    messages.finish(
        {
            "dataset": str(root),
            "made": True,
            "scenes": len(found),
            "views": arguments.count,
            "objects": [model.name for model in models],
            "things": [list(one.which) for one in found],
            "deepest_contact_m": deepest,
        }
    )
    return 0


def _describe(arguments: argparse.Namespace) -> str:
    """A word that is another whenever the models or the options are."""
    files = [p for path in arguments.models for p in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    listed = [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files if p.is_file()]
    names = ("unit", "scenes", "count", "things", "size", "noise", "seed")
    told = [listed, {name: getattr(arguments, name) for name in names}]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def _parse_size(text: str) -> tuple[int, int]:
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts) or not all(16 <= int(p) <= 4096 for p in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is no size: give WIDTHxHEIGHT, for instance 640x480")
    return int(parts[0]), int(parts[1])
