"""``ipjax capture views``: what would a camera see from where none stood?"""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.capture.model import add_again, describe_inputs, find_poses, open_frames
from ipjax.commands.capture.opening import add_capture
from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_count

EXAMPLES = """\
examples:
  ipjax capture views table/ -o work/                                  36 cameras around the scene: work/views/
  ipjax capture views table/ -o work/ --path smooth --count 100        along the way that the camera went
  ipjax capture views table/ -o work/ --path mine.json --dataset new/  from cameras of your own
  ipjax capture views table/ --poses poses.json -o work/               with the poses of this file

Every view is drawn from the frames that look at the same things from about the same side: their depth is carried into
it, each of its pixels is taken where those frames agree that a surface is, and their colours are blended. Holes are
filled from farther frames. What no frame knows stays black, has depth 0, and is white in unknown/.

Paths: orbit = a circle around the middle of the scene, as far and as high as the captured cameras are (to and fro,
where these did not go around); smooth = through all captured cameras, evenly; FILE = JSON, a list (or dictionary) of
4 x 4 matrices world_from_camera in metres, in the world of the poses, OpenCV's axes: x right, y down, z ahead.

Reads WORK/refined.json or WORK/poses.json, and WORK/depth/ if the step depth made it. Writes a data set in BOP's
layout, WORK/views/ or where --dataset says, with masks and poses of the objects if WORK/models/ is there; and
WORK/views.png.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(steps, "views", run, "draw the scene as other cameras would see it", EXAMPLES)
    add_capture(parser)
    options.add_output(parser, "WORK", "folder of what the steps make", required=True)
    parser.add_argument("--poses", type=Path, metavar="FILE", help="of the frames (default: those in WORK)")
    parser.add_argument("--path", default="orbit", metavar="orbit|smooth|FILE", help="of new cameras (default orbit)")
    parser.add_argument("--count", type=parse_count, metavar="N", help="of new cameras (default 36; a FILE: all)")
    parser.add_argument("--dataset", type=Path, metavar="DATASET", help="the data set (default WORK/views)")
    add_again(parser)
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Draw the views and write the data set; returns the exit status."""
    import numpy as np

    from ipjax.capture.labels.dataset import LabelledScene, check_dataset, read_made_of, write_scenes
    from ipjax.capture.labels.masks import label_frames, label_nothing
    from ipjax.capture.models.storing import LIST, read_models
    from ipjax.capture.views.choosing import find_middle
    from ipjax.capture.views.drawing import ViewConfig, draw_views
    from ipjax.capture.views.paths import orbit_path, read_path, smooth_path
    from ipjax.capture.views.pictures import draw_sheet
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.drawing import write_image
    from ipjax.transforms import Similarity

    work: Path = options.check_folder(arguments.output)
    root: Path = options.check_folder(arguments.dataset or work / "views")
    check_dataset(root)
    given = None
    if arguments.path not in ("orbit", "smooth"):
        given = read_path(arguments.path)
        if arguments.count is not None:
            raise ValueError("--count is of an orbit or a smooth path; a file of cameras has its own number of them")
    frames = open_frames(arguments, work, arguments.poses)
    models = list(read_models(work / "models")) if (work / "models" / LIST).is_file() else []
    config = ViewConfig()
    told = {
        "config": repr(config),
        "path": Path(arguments.path).read_text() if given is not None else [arguments.path, arguments.count],
        "models": (work / "models" / LIST).read_text() if models else None,
    }
    made_of = describe_inputs(arguments, work, told, arguments.poses or find_poses(work))
    if read_made_of(root) == made_of and not arguments.again:
        messages.say(f"{root} was made of the same already; --again makes it once more.")
        messages.finish({"dataset": str(root), "made": False})
        return 0
    poses = [frame.world_from_camera.to_matrix() for frame in frames]
    captured = Similarity[np.ndarray].from_matrix(np.stack(poses))
    count = arguments.count or 36
    if given is not None:
        path = given
    elif arguments.path == "smooth":
        path = smooth_path(captured, count)
    else:
        path = orbit_path(captured, find_middle(frames), count)
    use_compilation_cache()
    with Bars(quiet=arguments.quiet) as bars:
        views = draw_views(frames, path, config, progress=lambda done, total: bars.show("drawing", done, total))
        if models:
            labels = label_frames(models, views, progress=lambda done, total: bars.show("labelling", done, total))
        else:
            labels = [label_nothing(view) for view in views]
        scene = LabelledScene(
            views, labels, beside={"unknown": [(~view.usable).astype("uint8") * 255 for view in views]}
        )
        write_scenes(
            root,
            models,
            [scene],
            replace=True,
            about={"made_of": made_of},
            progress=lambda done, total: bars.show("writing", done, total),
        )
    write_image(work / "views.png", draw_sheet(views))
    known = [float(view.usable.mean()) for view in views]
    messages.say(
        f"{len(views)} views from {len(frames)} frames, {100 * sum(known) / len(known):.0f} % of their pixels known "
        f"(least {100 * min(known):.0f} %): {root}"
    )
    messages.finish(
        {
            "dataset": str(root),
            "made": True,
            "views": len(views),
            "known": [round(share, 4) for share in known],
            "objects": [model.name for model in models],
        }
    )
    return 0
