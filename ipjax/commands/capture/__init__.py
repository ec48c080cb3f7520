"""``ipjax capture``: from a capture of a scene to a data set, at once or a step at a time."""

from typing import Any

from ipjax.commands.capture import arrange, check, depth, label, model, pose, refine, run, views
from ipjax.commands.interface.parser import Parser, add_command

_STEPS = (run, check, pose, refine, depth, model, label, views, arrange)  # as --help lists them
EXAMPLES = """\
examples:
  ipjax capture run table/ -o mytable/         all of it: mytable/ in BOP's layout, mytable.work/report.html
  ipjax capture check table/ -o check.html     what it has, what is missing, and what looks wrong
  ipjax capture pose table/ -o work/           where the camera stood, frame by frame: work/poses.json
  ipjax capture refine table/ -o work/         the same, made exact: work/refined.json
  ipjax capture depth table/ -o work/          depth in the pixels of the colours, without holes: work/depth/
  ipjax capture model table/ -o work/          models of what stands on the table: work/models/
  ipjax capture label table/ -o work/          masks, boxes and poses of every frame, in BOP's layout: work/dataset/
  ipjax capture views table/ -o work/          the scene as other cameras would see it: work/views/
  ipjax capture arrange work/models/ -o made/  the models in new arrangements, with the truth

A capture is a folder of frames: rgb/NAME.png, depth/NAME.png (registered to the colours), camera.json, and, if they are
known, poses.json and ignore.png (non-zero = moves with the camera); a TUM RGB-D sequence; or a scene of a BOP data set.
"""


def add(commands: Any) -> None:
    """The command and its steps."""
    parser = add_command(
        commands, "capture", None, "make a data set of a hand-held RGB-D capture, step by step", EXAMPLES
    )
    steps = parser.add_subparsers(title="steps", metavar="STEP", required=True, parser_class=Parser)
    for step in _STEPS:
        step.add(steps)
