"""``ipjax degrade``: a mesh as a reconstruction model would have made it."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax degrade mug.glb -o worse.glb --level 2 --alignment worse.json
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "degrade",
        run,
        "make a mesh worse, as reconstruction models do, and keep the map back to the original",
        EXAMPLES,
    )
    parser.add_argument("mesh", metavar="MESH", type=Path, help="OBJ, PLY, GLB, glTF or STL")
    options.add_output(parser, "GLB", "the worse mesh to write", required=True)
    parser.add_argument("--level", type=int, default=2, choices=(1, 2, 3, 4), help="4 is worst (default 2)")
    options.add_seed(parser, "of what is random about it")
    parser.add_argument("--alignment", type=Path, metavar="JSON", help="where the map back goes; for evaluation only")
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Write the degraded mesh and, if wanted, its similarity to the original; returns the exit status."""
    output = options.check_output(arguments.output, (".glb",))
    options.check_seed(arguments.seed)
    if arguments.alignment is not None:
        options.check_output(arguments.alignment, (".json",))
    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.saving import save_mesh
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.reports import to_json
    from ipjax.synthetic.degradation import alignment_as_json, degrade

    mesh = load_mesh(arguments.mesh)
    worse, alignment = degrade(mesh, arguments.level, arguments.seed)
    save_mesh(worse, output)
    back = alignment_as_json(alignment)
    if arguments.alignment is not None:
        write_text(arguments.alignment, to_json(back))
    messages.say(f"{output}: level {arguments.level}")
    messages.finish(to_json({"mesh": str(output), "level": arguments.level, "seed": arguments.seed, "alignment": back}))
    return 0
