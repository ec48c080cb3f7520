"""``ipjax capture label``: where is each object in each frame?"""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.capture.model import add_again, describe_inputs, open_frames
from ipjax.commands.capture.opening import add_capture
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax capture label table/ -o work/
  ipjax capture label table/ -o work/ --dataset mytable/ --known mug.ipjax

Reads what ipjax capture model made (WORK/models/). Writes a data set in BOP's layout, WORK/dataset/ or where --dataset
says: images, masks (whole and visible), poses, boxes, visible shares, models with diameters and symmetries, targets;
and the picture WORK/labels.png. An object that is known (--known) is given its own mesh and the pose that its estimates
in several frames agree on.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "label", run, "label every frame and write a BOP data set", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder of what the steps make", required=True)
    parser.add_argument("--dataset", type=Path, metavar="DATASET", help="the data set (default WORK/dataset)")
    parser.add_argument(
        "--known", type=Path, action="append", metavar="OBJ.ipjax", help="an object file of one of them"
    )
    add_again(parser)
    options.add_weights(parser)
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Label the frames and write the data set; returns the exit status."""
    from ipjax.capture.labels.dataset import check_dataset, read_made_of, write_dataset
    from ipjax.capture.labels.masks import label_frames
    from ipjax.capture.labels.pictures import draw_labels
    from ipjax.capture.models.storing import LIST, read_models
    from ipjax.inference.drawing import write_image

    work: Path = options.check_folder(arguments.output)
    root: Path = options.check_folder(arguments.dataset or work / "dataset")
    check_dataset(root)
    models = list(read_models(work / "models"))
    frames = open_frames(arguments, work)
    if arguments.weights is not None and not arguments.known:
        raise ValueError("--weights are of the encoder of --known; without it nothing is encoded")
    known = [(str(path), path.stat().st_mtime_ns if path.is_file() else 0) for path in arguments.known or ()]
    told = {"models": (work / "models" / LIST).read_text(), "known": known, "weights": arguments.weights}
    made_of = describe_inputs(arguments, work, told)
    if read_made_of(root) == made_of and not arguments.again:
        messages.say(f"{root} was made of the same already; --again makes it once more.")
        messages.finish({"dataset": str(root), "made": False})
        return 0
    notes: list[str] = []
    with Bars(quiet=arguments.quiet) as bars:
        if arguments.known:
            from ipjax.commands.capture.known import place_known

            models, notes = place_known(arguments, frames, models)
        labels = label_frames(models, frames, progress=lambda done, total: bars.show("labelling", done, total))
        write_dataset(
            root,
            models,
            frames,
            labels,
            replace=True,
            about={"made_of": made_of, "notes": notes},
            progress=lambda done, total: bars.show("writing", done, total),
        )
    write_image(work / "labels.png", draw_labels(frames, labels, [model.name for model in models]))
    for line in notes:
        messages.say(line)
    shares = [[round(float(share), 3) for share in label.shares] for label in labels]
    messages.say(f"{len(frames)} frames with {len(models)} objects: {root}")
    messages.finish(
        {
            "dataset": str(root),
            "made": True,
            "objects": [model.name for model in models],
            "frames": len(frames),
            "visible": shares,
            "notes": notes,
        }
    )
    return 0
