"""What ``ipjax estimate`` refuses before the work: options, objects and images that cannot be used."""

import argparse
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.candidates import check_any
from ipjax.commands.interface.detection import is_without_masks
from ipjax.commands.interface.frames import FrameFiles, Images, read_frame

MESHES = (".ply", ".glb", ".obj", ".stl")


def check(arguments: argparse.Namespace) -> None:
    """Refuse what cannot be done before the work; ``--size`` becomes ``--diameter``."""
    for name in ("mask_label", "instance", "obj_id"):
        if len(getattr(arguments, name) or ()) not in (0, len(arguments.objects)):
            raise ValueError(f"--{name.replace('_', '-')} is given once for each object, in their order")
    if arguments.output is not None:
        options.check_output(arguments.output, (".json",))
    several = arguments.frames is not None or len(arguments.objects) > 1 or arguments.instances != 1
    if arguments.instances != 1 and (arguments.mask or arguments.box or arguments.click):
        raise ValueError("--instances is for objects that are sought; a mask, a box or a click shows one")
    if arguments.click and (arguments.mask or arguments.box):
        raise ValueError("--click says where an object is sought; with a --mask or a --box it is not: give one of them")
    if arguments.explain is not None and (arguments.mask or arguments.box):
        raise ValueError("--explain shows how objects are sought; with a --mask or a --box they are not")
    if len(arguments.click or ()) not in (0, len(arguments.objects)):
        raise ValueError(f"--click is given once for each object, in their order; got {len(arguments.click)}")
    if arguments.mask_is_rough and not (arguments.mask or arguments.frames):
        raise ValueError("--mask-is-rough needs a --mask")
    for name, path, suffixes, is_folder in (
        ("overlay", arguments.overlay, options.PICTURES, arguments.frames is not None),
        ("comparison", arguments.compare, options.PICTURES, arguments.frames is not None),
        ("mesh output", arguments.mesh_out, MESHES, several),
        ("explanation", arguments.explain, (".html",), arguments.frames is not None),
    ):
        if path is not None and not is_folder:
            options.check_output(path, suffixes)
        elif path is not None and path.exists() and not path.is_dir():
            of = "--frames" if arguments.frames is not None else "several objects or instances"
            raise ValueError(f"{path}: with {of}, the {name} is a folder")
    if arguments.size is not None:
        if not 1 <= arguments.size < 1e5:
            raise ValueError(f"--size is in millimetres; {arguments.size:g} cannot be right")
        arguments.diameter = 1e-3 * arguments.size
    if arguments.diameter is not None and not 1e-4 < arguments.diameter < 100:
        raise ValueError(f"--diameter is in metres; {arguments.diameter:g} cannot be right")
    options.check_seed(arguments.seed)


def check_objects(objects: list[tuple[Any, Any]], arguments: argparse.Namespace) -> None:
    """Refuse what these object files cannot give, before weights are loaded and anything is compiled."""
    for path, (templates, info) in zip(arguments.objects, objects, strict=True):
        if arguments.compare is not None and templates.reference is None:
            raise ValueError(f"--compare: {path} keeps no photo that it was made from, so nothing to compare with")
        if arguments.mesh_out is not None and (info.vertices is None or info.faces is None):
            raise ValueError(f"--mesh-out: {path} keeps no mesh")


def read_first(files: FrameFiles, arguments: argparse.Namespace, names: list[str]) -> Images:
    """Read a single frame, so that bad images are refused before weights are loaded and anything is compiled."""
    from ipjax.inference.frames import frame

    images = read_frame(files, arguments, names)
    if is_without_masks(files):
        from ipjax.detection.crops import read_scene, undistort_pixel

        read_scene(images.rgb, images.depth, images.camera, arguments.depth_scale)
        for click in arguments.click or ():
            undistort_pixel(click, images.camera, images.rgb.shape[:2])
        return images
    for candidates, box in zip(images.candidates, files.boxes, strict=True):
        given: dict[str, Any] = {"depth_scale": arguments.depth_scale, "crop": arguments.crop}
        if candidates is None:
            frame(images.rgb, images.depth, None, images.camera, box=box, **given)
        else:
            check_any(images, candidates, box, **given)
    return images
