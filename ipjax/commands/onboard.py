"""``ipjax onboard``: from a mesh or a photo to an object file."""

import argparse
import time
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_camera, parse_count, parse_numbers

EXAMPLES = """\
examples:
  ipjax onboard mug.glb -o mug.ipjax
  ipjax onboard scan.ply -o scan.ipjax --unit mm           the mesh's unit is known: sizes are compared in the result
  ipjax onboard part.stl -o part.ipjax --directions 20     half the templates: faster, less accurate
  ipjax onboard part.stl -o part.ipjax --set surface=4096  any other setting of onboarding
  ipjax onboard mug.jpg -o mug.ipjax                       a photo of it before a plain background
  ipjax onboard mug.jpg --mask mug_mask.png -o mug.ipjax --report mug.html
  ipjax onboard mug.jpg --box 210,130,90,120 -o mug.ipjax  the mask is cut out inside the box
  ipjax onboard rgb.png --mask mask.png --depth depth.png --camera camera.json --depth-scale 0.001 -o mug.ipjax
                                                           the front is measured, and so is the size
  ipjax onboard made.glb --photo mug.jpg -o mug.ipjax      a mesh that SAM 3D, InstantMesh … made, and its photo

The mesh may be a scan, CAD, or what a single-view reconstruction made: in any frame and unit, coloured by a texture or
by vertices. A photo becomes a mesh by TripoSR where its weights are, else without learned weights: its outline is
inflated, or its depth completed. The report shows what was seen and what was guessed. An object from a photo without
depth is found through that photo: its rotation does not rest on the guessed shape. An image-to-3D model invents what
its photo did not show; with the photo beside the mesh, a pose that rests on that is called less sure.
"""
PHOTOS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
UNREAD_PHOTOS = (".heic", ".heif", ".avif")  # what phones write, and Pillow alone does not read
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
# Options that make sense for a photo only, as argparse names them.
PHOTO_ONLY = ("mask", "mask_label", "box", "click", "depth", "camera", "image", "depth_scale")
PHOTO_ONLY += ("lrm", "lrm_weights", "save_mesh")
WITH_MESH = ("mask", "mask_label", "box", "click")  # of them, those that also belong to the photo beside a mesh


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "onboard",
        run,
        "make an object file from a mesh or from one photo: see it from everywhere and describe every view",
        EXAMPLES,
    )
    parser.add_argument("source", metavar="SOURCE", type=Path, help="mesh (OBJ, PLY, GLB, glTF, STL) or photo")
    options.add_output(parser, "OBJ.ipjax", "the object file to write", required=True)
    parser.add_argument("--report", type=Path, metavar="HTML", help="a page of what was made; needs nothing beside it")
    parser.add_argument("--name", help="of the object (default: the file's)")
    parser.add_argument("--unit", choices=tuple(UNITS), help="of the mesh file, if known; never guessed")
    options.add_views(parser, "the sphere, of meshes and photos with depth")
    parser.add_argument("--channels", type=parse_count, metavar="N", help="cut features to N principal directions")
    options.add_changes(parser, "OnboardConfig", "surface=4096")
    parser.add_argument("--backend", default="auto", help="renderer: auto, egl, osmesa, native or raster")
    options.add_encoder(parser)
    options.add_reporting(parser, quiet="no progress bars, no notes")
    photo = parser.add_argument_group("photos")
    options.add_mask(
        photo,
        "the object (default: transparency, a plain background, or rembg where it is installed)",
        "cut the object out inside this box, pixels",
    )
    photo.add_argument("--click", type=parse_numbers, metavar="X,Y", help="cut out the object at this pixel")
    options.add_depth(photo, "depth aligned to the photo: metric front and size")
    beside = parser.add_argument_group("meshes that an image-to-3D model made (with --mask, --box or --click)")
    beside.add_argument("--photo", type=Path, metavar="PHOTO", help="the photo that the mesh was made from")
    beside.add_argument("--photo-camera", metavar="FILE", help="its camera: BOP JSON, ROS CameraInfo, or fx,fy,cx,cy")
    photo.add_argument("--lrm", choices=("triposr", "inflate", "auto"), help="who makes the mesh (default auto)")
    photo.add_argument("--lrm-weights", type=Path, metavar="FILE", help="TripoSR's checkpoint")
    photo.add_argument("--save-mesh", type=Path, metavar="GLB", help="also write the reconstructed mesh")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Make the object file and, if wanted, the report and the mesh; returns the exit status."""
    is_photo = _check(arguments)
    from ipjax.config import OnboardConfig

    start = time.perf_counter()
    config = options.change(arguments, OnboardConfig(**options.read_views(arguments, "channels")))
    make = _from_photo if is_photo else _from_mesh if arguments.photo is None else _from_mesh_with_photo
    templates, info, encoder, photo = make(arguments, config)
    warned: tuple[str, ...] = ()
    if arguments.report is not None:
        from ipjax.files.meshes.cleaning import clean
        from ipjax.files.meshes.loading import load_mesh
        from ipjax.files.meshes.mesh import normalise
        from ipjax.onboarding.report.findings import examine
        from ipjax.onboarding.report.page import write_report

        source = load_mesh(arguments.source) if photo is None else photo.reconstruction.mesh
        mesh = normalise(clean(source)[0])
        if templates.photo_centre is not None:
            from ipjax.onboarding.photographed import mark_vertices

            mesh = mark_vertices(mesh, templates)
        found = examine(templates, info, mesh, encoder, config, backend=arguments.backend)
        write_report(arguments.report, templates, info, mesh, found, photo, backend=arguments.backend)
        warned = found.warnings
    messages.print_notes()
    count = len(templates.camera_from_object.scale)
    seconds = time.perf_counter() - start
    if not arguments.quiet:
        for note in info.notes:
            messages.say(f"note: {note}")
        for warning in warned:
            messages.say(f" {warning}", mark="warning:", style="yellow")
        unit = _diameter(info, is_photo)
        if info.reference is not None:
            messages.say(f"camera of the photo: {info.reference.describe_camera()}")
        messages.say(f"{arguments.output}: {count} templates of {info.name}, diameter {unit}, in {seconds:.0f} s")
        if arguments.report is not None:
            messages.say(f"{arguments.report}: what was made of it")
    size = 1 / info.mesh_scale  # diameter in mesh units
    messages.finish(
        {
            "object_file": str(arguments.output),
            "object": info.name,
            "templates": count,
            "diameter_mesh_units": None if is_photo and not info.metres_per_unit else size,
            "diameter_mm": 1e3 * size * info.metres_per_unit if info.metres_per_unit else None,
            "photo_camera": None if info.reference is None else info.reference.camera_as_json(),
            "encoder": info.encoder,
            "notes": list(info.notes),
            "warnings": [*messages.warnings, *warned],
            "report": None if arguments.report is None else str(arguments.report),
            "mesh": None if arguments.save_mesh is None else str(arguments.save_mesh),
            "seconds": round(seconds, 3),
        }
    )
    return 0


def _check(arguments: argparse.Namespace) -> bool:
    """Refuse what cannot be done before the work; whether the source is a photo."""
    source = arguments.source
    options.check_output(arguments.output, (".ipjax",))
    is_photo = source.suffix.lower() in PHOTOS
    if not source.is_file():
        raise ValueError(f"{source}: no such {'photo' if is_photo else 'mesh'}")
    for path in (source, arguments.photo):
        if path is not None and path.suffix.lower() in UNREAD_PHOTOS:
            raise ValueError(f"{path}: photos of the format {path.suffix} are not read here: save it as JPEG or PNG")
    if arguments.photo is None and arguments.photo_camera is not None:
        raise ValueError("--photo-camera belongs to --photo")
    if arguments.photo is not None and not is_photo and not arguments.photo.is_file():
        raise ValueError(f"{arguments.photo}: no such photo")
    mesh_refuses = [name for name in PHOTO_ONLY if arguments.photo is None or name not in WITH_MESH]
    for name in mesh_refuses if not is_photo else ("unit", "photo"):
        if getattr(arguments, name) is not None:
            other = "a mesh" if not is_photo else "a photo"
            raise ValueError(f"{source}: --{name.replace('_', '-')} does not belong to {other}")
    for name in ("directions", "rolls") if is_photo and arguments.depth is None else ():
        if getattr(arguments, name) is not None:
            raise ValueError(
                f"{source}: --{name} does not belong to a photo without depth, whose views are the photo's own"
            )
    if arguments.report is not None:
        options.check_output(arguments.report, (".html", ".htm"))
    if arguments.save_mesh is not None:
        options.check_output(arguments.save_mesh, (".glb", ".obj", ".ply", ".stl"))
    return is_photo


def _from_mesh(arguments: argparse.Namespace, config: Any) -> tuple[Any, Any, Any, None]:
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.onboarding.mesh import onboard

    encoder = options.load_encoder(arguments)
    use_compilation_cache()
    unit = None if arguments.unit is None else UNITS[arguments.unit]
    templates, info = onboard(arguments.source, encoder, config, metres_per_unit=unit, **_shared(arguments))
    return templates, info, encoder, None


def _from_mesh_with_photo(arguments: argparse.Namespace, config: Any) -> tuple[Any, Any, Any, None]:
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.onboarding.photo import prepare_photo
    from ipjax.onboarding.photographed import onboard_with_photo

    given = _read_mask(arguments) | {"camera": _read_camera(arguments.photo_camera, None, arguments.photo)}
    # A bad photo is refused before weights are loaded and anything is compiled.
    prepare_photo(arguments.photo, **given)
    encoder = options.load_encoder(arguments)
    use_compilation_cache()
    given["metres_per_unit"] = None if arguments.unit is None else UNITS[arguments.unit]
    given["photo"] = arguments.photo
    found = onboard_with_photo(arguments.source, encoder, config, **given, **_shared(arguments))
    return *found, encoder, None


def _from_photo(arguments: argparse.Namespace, config: Any) -> tuple[Any, Any, Any, Any]:
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.onboarding.photo import onboard_photo, prepare_photo

    given = _read_mask(arguments) | {"depth": arguments.depth, "depth_scale": arguments.depth_scale}
    given["camera"] = _read_camera(arguments.camera, arguments.image, arguments.source)
    # A bad photo is refused before weights are loaded and anything is compiled.
    prepare_photo(arguments.source, **given)
    encoder = options.load_encoder(arguments)
    use_compilation_cache()
    lrm = {"lrm": arguments.lrm or "auto", "lrm_weights": arguments.lrm_weights}
    photo = onboard_photo(arguments.source, encoder, config, **given, **lrm, **_shared(arguments))
    if arguments.save_mesh is not None:
        from ipjax.files.meshes.saving import save_mesh

        save_mesh(photo.reconstruction.mesh, arguments.save_mesh)
    return photo.templates, photo.info, encoder, photo


def _shared(arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments that onboarding a mesh and a photo have in common."""
    return {
        "out": arguments.output,
        "name": arguments.name,
        "progress": not arguments.quiet,
        "backend": arguments.backend,
    }


def _read_mask(arguments: argparse.Namespace) -> dict[str, Any]:
    """What tells the object in the photo, and where a picture goes when nothing does."""
    given = {name: getattr(arguments, name) for name in ("mask", "box", "click")}
    if arguments.mask_label is not None:
        if arguments.mask is None:
            raise ValueError("--mask-label belongs to --mask")
        from ipjax.files.images.masks import read_mask

        given["mask"] = read_mask(arguments.mask, arguments.mask_label)
    return given | {"tried": arguments.output.with_suffix(".tried.png")}


def _read_camera(camera: str | None, image: int | None, photo: Path) -> Any:
    """The photo's camera; of a scene's, that of the image which the photo's name numbers."""
    if camera is None:
        return None
    from ipjax.files.cameras.reading import read_camera

    if image is None and photo.stem.isdigit():
        image = int(photo.stem)
    return read_camera(parse_camera(camera), image)


def _diameter(info: Any, is_photo: bool) -> str:
    size = 1 / info.mesh_scale
    if info.metres_per_unit:
        return f"{size * 1e3 * info.metres_per_unit:.1f} mm"
    return "unknown" if is_photo else f"{size:g} mesh units"
