"""``ipjax grasp``: where may a gripper close on an object whose pose was estimated?"""

import argparse
import math
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_camera, parse_numbers

EXAMPLES = """\
examples:
  ipjax grasp mug.ipjax --pose pose.json --base-from-camera hand_eye.json --table 0.0 -o grasps.json
  ipjax grasp mug.ipjax --pose pose.json --base-from-camera hand_eye.json --table 0.0 --depth depth.png \\
      --camera camera.json --rgb rgb.png --overlay grasps.png -o grasps.json     heeds what else is there, draws it
  ipjax grasp mug.ipjax --pose pose.json --base-from-camera hand_eye.json --table 0.0 --gripper robotiq --top-down \\
      -o grasps.yaml                                                             isaac_grasp
  ipjax grasp mug.ipjax --pose pose.json --gripper mine.json --format graspgen -o grasps.json
  ipjax grasp mug.ipjax --pose pose.json --by-box -o grasps.json                 by the object's box, as the paper
  ipjax grasp mug.ipjax --pose pose.json --write-gripper mine.json               a file of a gripper to begin with

--pose is what 'ipjax estimate -o' wrote, with the uncertainty that is heeded: a grasp that is safe only if the pose is
exact comes behind one that is safe anyway. Of several frames --frame says which, of several of one object --instance.

  base_from_gripper = base_from_camera @ camera_from_object @ object_from_gripper

All of these are rigid and in metres; the gripper's frame has its origin at the hand's base, z along the approach, and
the axis along which the fingers close is named in the file (Franka's: y). --base-from-camera is a JSON file with that
matrix by that name. --table is the height of the table in the robot's base, z up; without a robot it is a plane
NX,NY,NZ,D in the camera's frame, n · x = D with n away from the table. Without a table the wanted approach is along the
camera's view. With --depth, a hand just behind something that was measured hits it; farther behind it may be free or
not, and such a grasp has a lower score.

The last line, and "decision" of the JSON, say whether to grasp: "grasp", "look again from here", with a place for the
camera, or "do not", by the probability that the best grasp succeeds.

Files by their ending: .json is ours, with every frame named, .yaml isaac_grasp of NVIDIA's Isaac, whose frame is the
mesh's, in metres; --format graspgen is GraspGen's JSON, in which every gripper closes along x.
"""
FORMATS = ("ipjax", "isaac", "graspgen")
_SUFFIXES = {"ipjax": (".json",), "isaac": (".yaml", ".yml"), "graspgen": (".json",)}


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(commands, "grasp", run, "plan where a gripper may close on an object that was found", EXAMPLES)
    parser.add_argument("object", metavar="OBJ.ipjax", type=Path, help="an object file, from 'ipjax onboard'")
    parser.add_argument("--pose", type=Path, metavar="JSON", help="its pose, from 'ipjax estimate -o'")
    parser.add_argument("--frame", metavar="NAME", help="of several frames in it, which")
    parser.add_argument(
        "--instance",
        type=int,
        metavar="N",
        help="of several estimates of the object in it, which, from 0",
    )
    parser.add_argument(
        "--gripper", default="franka", metavar="franka|robotiq|FILE", help="the gripper (default franka), or its JSON"
    )
    parser.add_argument(
        "--write-gripper", type=Path, metavar="JSON", help="write the gripper's measures, to be changed"
    )
    parser.add_argument(
        "--base-from-camera", type=Path, metavar="FILE", help="where the camera stands, from 'ipjax calibrate'"
    )
    parser.add_argument(
        "--table",
        type=parse_table,
        metavar="Z|NX,NY,NZ,D",
        help="its height in the robot's base, metres; or a plane in the camera's frame",
    )
    options.add_depth(parser, "of the frame: what else is there is not hit")
    parser.add_argument("--rgb", type=Path, metavar="FILE", help="colour image of the frame, for --overlay")
    parser.add_argument("--by-box", action="store_true", help="by the object's box, as the paper, not its surface")
    parser.add_argument("--top-down", action="store_true", help="only approaches within 15 degrees of straight down")
    parser.add_argument(
        "--tilt",
        type=float,
        metavar="DEGREES",
        help="only approaches within this of straight down (without --table: of the camera's view)",
    )
    options.add_changes(parser, "GraspConfig", "grasps=8")
    options.add_seed(parser)
    options.add_output(parser, "FILE", "where the grasps go: .json or .yaml (default: the best on the screen)")
    parser.add_argument("--format", choices=FORMATS, help="of that file (default: by its ending)")
    parser.add_argument("--overlay", type=Path, metavar="PNG", help="a picture of the best of them in the image")
    options.add_reporting(parser, quiet="no notes on stderr")


def parse_table(text: str) -> tuple[float, ...]:
    """A height, or the four numbers of a plane; argparse.ArgumentTypeError, in words, otherwise."""
    try:
        values = parse_numbers(text)
    except ValueError:
        values = ()
    if len(values) not in (1, 4):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no table: give its height in metres, or a plane NX,NY,NZ,D with commas and no spaces"
        )
    return values


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Plan, print, write and draw; returns the exit status, 1 where there is no grasp."""
    kind = _check(arguments)
    from ipjax.robot.grippers import read_gripper, write_gripper

    gripper = read_gripper(arguments.gripper)
    if arguments.write_gripper is not None:
        write_gripper(arguments.write_gripper, gripper)
        messages.say(f"{arguments.write_gripper}: {gripper.name}")
        if arguments.pose is None:
            from ipjax.robot.grippers import describe_gripper

            messages.finish(describe_gripper(gripper))
            return 0
    import jax
    import numpy as np

    from ipjax.files.objects.loading import load
    from ipjax.files.rigid import read_rigid
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.reports import to_json
    from ipjax.robot.files.estimates import read_estimate
    from ipjax.robot.files.plans import grasps_as_json
    from ipjax.robot.grasps.decision import decide
    from ipjax.robot.grasps.planning import box_grasps, plan_grasps

    config = _read_config(arguments)
    templates, info = load(arguments.object)
    estimate = read_estimate(arguments.pose, templates, info, frame=arguments.frame, instance=arguments.instance)
    if not bool(estimate.present):
        messages.keep(f"{arguments.pose}: {info.name} may not be here: the pose is a guess", is_warning=True)
    where = arguments.base_from_camera
    base_from_camera = None if where is None else read_rigid(where, "base_from_camera").to_jax()
    rgb, camera, workspace = _read_workspace(arguments, base_from_camera)
    if workspace.table is not None:
        _check_table(np.asarray(workspace.table, np.float64), estimate, info.name, messages)
    messages.print_notes()
    use_compilation_cache()
    plan = jax.jit(box_grasps if arguments.by_box else plan_grasps)
    grasps = plan(gripper, templates, estimate, workspace, jax.random.key(arguments.seed), config)
    document = grasps_as_json(
        grasps,
        gripper,
        estimate.camera_from_object,
        base_from_camera,
        mesh_scale=info.mesh_scale,
        mesh_centre=info.mesh_centre,
    )
    document |= {
        "object": info.name,
        "object_file": str(arguments.object),
        "mesh_file": info.mesh_file,
        "pose_file": str(arguments.pose),
        "method": "box" if arguments.by_box else "surface",
        "set": arguments.changes,
        "seed": arguments.seed,
    }
    found = document["grasps"]
    decision = decide(gripper, grasps, estimate, base_from_camera, known=templates, table=workspace.table)
    document["decision"] = decision.as_json()
    for line in (*_summary(info.name, found), decision.describe()):
        messages.say(line)
    if arguments.output is not None:
        if kind == "ipjax":
            write_text(arguments.output, to_json(document))
        else:
            _write_list(arguments.output, kind, grasps, gripper, estimate, info)
    if arguments.overlay is not None:
        from ipjax.inference.drawing import write_image
        from ipjax.robot.drawing import draw_grasps

        rgb = rgb if rgb.dtype == np.uint8 else (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
        write_image(arguments.overlay, draw_grasps(rgb, camera, gripper, grasps, estimate.camera_from_object, info))
        document["overlay"] = str(arguments.overlay)
    messages.finish(to_json(document))
    return 0 if found else 1


def _check(arguments: argparse.Namespace) -> str:
    """Refuse what cannot be done before the work; returns the format of the output."""
    if arguments.pose is None and arguments.write_gripper is None:
        raise ValueError("--pose is missing: the file that 'ipjax estimate -o' wrote")
    kind = arguments.format
    if kind is None:
        ending = "" if arguments.output is None else arguments.output.suffix.lower()
        kind = "isaac" if ending in _SUFFIXES["isaac"] else "ipjax"
    if arguments.output is not None:
        endings = _SUFFIXES[kind] if arguments.format else (".json", ".yaml", ".yml")
        options.check_output(arguments.output, endings)
    if arguments.write_gripper is not None:
        options.check_output(arguments.write_gripper, (".json",))
    if arguments.overlay is not None:
        options.check_output(arguments.overlay, options.PICTURES)
        if arguments.rgb is None or arguments.camera is None:
            raise ValueError("--overlay needs the image, --rgb, and its --camera")
    if arguments.depth is not None and arguments.camera is None:
        raise ValueError("--depth needs its --camera")
    if arguments.table is not None and len(arguments.table) == 1 and arguments.base_from_camera is None:
        raise ValueError(
            "--table Z is a height in the robot's base, so it needs --base-from-camera; or give a plane in the "
            "camera's frame, --table NX,NY,NZ,D"
        )
    if arguments.table is not None and len(arguments.table) == 4 and math.hypot(*arguments.table[:3]) < 1e-6:
        raise ValueError("--table: the plane's normal has no length")
    if arguments.top_down and arguments.tilt is not None:
        raise ValueError("--top-down is --tilt 15: give one of them")
    if arguments.top_down and arguments.table is None:
        raise ValueError("--top-down needs --table, which tells where down is")
    if arguments.tilt is not None and not 0 < arguments.tilt <= 180:
        raise ValueError(f"--tilt is an angle from 0 to 180 degrees, not {arguments.tilt:g}")
    options.check_seed(arguments.seed)
    given = [
        arguments.object,
        arguments.gripper,
        arguments.pose,
        arguments.base_from_camera,
        arguments.depth,
        arguments.camera,
    ]
    options.check_apart([arguments.output, arguments.overlay, arguments.write_gripper], [*given, arguments.rgb])
    return kind


def _read_config(arguments: argparse.Namespace) -> Any:
    import dataclasses

    from ipjax.config import GraspConfig

    config = options.change(arguments, GraspConfig())
    degrees = 15.0 if arguments.top_down else arguments.tilt
    return config if degrees is None else dataclasses.replace(config, tilt=math.radians(degrees))


def _read_workspace(arguments: argparse.Namespace, base_from_camera: Any) -> tuple[Any, Any, Any]:
    """The colour image, its camera, and what is around the object."""
    import jax.numpy as jnp
    import numpy as np

    from ipjax.records import Camera
    from ipjax.robot.records import Workspace, table_in_camera

    rgb = camera = table = depth = lens = None
    if arguments.camera is not None:
        from ipjax.files.cameras.reading import read_camera

        camera = read_camera(parse_camera(arguments.camera), arguments.image)
    if arguments.rgb is not None:
        from ipjax.files.cameras.reading import as_intrinsics
        from ipjax.files.images.opening import read_rgb
        from ipjax.inference.images import check_images

        rgb = read_rgb(arguments.rgb)
        if camera is not None:
            check_images(rgb, np.zeros(rgb.shape[:2], np.uint8), as_intrinsics(camera))
    if arguments.table is not None:
        if len(arguments.table) == 1:
            table = table_in_camera(arguments.table[0], base_from_camera)
        else:
            table = jnp.asarray(arguments.table, jnp.float32) / math.hypot(*arguments.table[:3])
    if arguments.depth is not None:
        from ipjax.detection.crops import read_scene
        from ipjax.files.images.depth import read_depth

        measured = read_depth(arguments.depth)
        picture = np.zeros((*measured.shape, 3), np.uint8) if rgb is None else rgb
        scene = read_scene(picture, measured, camera, arguments.depth_scale)
        depth, lens = jnp.asarray(scene.depth), Camera.from_matrix(scene.matrix)
    return rgb, camera, Workspace(table=table, depth=depth, camera=lens)


def _check_table(table: Any, estimate: Any, name: str, messages: Messages) -> None:
    """What a camera sees lies on the side of the table where the camera is."""
    normal, offset = table[:3], float(table[3])
    if offset > 0:
        raise ValueError(
            f"the camera is {offset:.2f} m below the table: is base_from_camera inverted, or the plane's normal the "
            "wrong way round?"
        )
    height = float(normal @ estimate.camera_from_object.translation) - offset
    if height < 0:
        messages.keep(f"the middle of {name} is {-1e3 * height:.0f} mm below the table", is_warning=True)


def _write_list(path: Path, kind: str, grasps: Any, gripper: Any, estimate: Any, info: Any) -> None:
    from ipjax.robot.files.graspgen import write_graspgen
    from ipjax.robot.files.isaac_grasp import write_isaac_grasp
    from ipjax.robot.files.listing import list_grasps

    listed = list_grasps(
        grasps,
        gripper,
        scale=float(estimate.camera_from_object.scale),
        mesh_scale=info.mesh_scale,
        mesh_centre=info.mesh_centre,
        object_file=info.mesh_file,
    )
    if kind == "isaac":
        write_isaac_grasp(path, listed, gripper)
    else:
        write_graspgen(path, listed, gripper)


def _summary(name: str, found: list[dict[str, Any]]) -> list[str]:
    """A line for all, and one for the best."""
    if not found:
        return [f"{name}: no grasp: nothing that fits between the fingers can be reached"]
    best = found[0]
    return [
        f"{name}: {len(found)} grasp{'s' if len(found) > 1 else ''}; the best: score {best['score']:.2f}, closes on "
        f"{1e3 * best['width_m']:.1f} mm, {1e3 * best['spare_m']:.1f} mm to spare per finger, holds at "
        f"{best['safe']:.0%} of the likely poses"
    ]
