"""What is written beside the poses of a frame: pictures, and meshes at their pose."""

import argparse
from pathlib import Path
from typing import Any

from ipjax.commands.interface.frames import Images
from ipjax.commands.interface.messages import Messages


def draw_frame(
    name: str, images: Images, results: list[Any], masks: list[Any], config: Any, arguments: argparse.Namespace
) -> Path:
    """Write the overlay of one frame; returns its path."""
    import numpy as np

    from ipjax.inference.drawing import draw, gather_evidence, write_image
    from ipjax.inference.photos.corrected_mesh import correct_info

    rgb = images.rgb
    rgb = rgb if rgb.dtype == np.uint8 else (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
    evidence = [gather_evidence(r.templates, r.query, r.crop_estimate, r.info, config) for r in results]
    known = [r.estimate for r in results], [correct_info(r) for r in results]
    picture = draw(rgb, images.camera, *known, evidence, masks=masks)
    target = _picture_path(arguments.overlay, name, arguments)
    write_image(target, picture)
    return target


def _picture_path(target: Path, name: str, arguments: argparse.Namespace) -> Path:
    """The file of a frame's picture: the one named, or one in the folder, which is made."""
    if arguments.frames is None:
        return target
    target.mkdir(parents=True, exist_ok=True)
    return target / f"{name}.png"


def compare_photos(name: str, results: list[Any], arguments: argparse.Namespace) -> Path:
    """Write the photos of one frame's objects with the frame drawn into their views, a row each; returns the path."""
    import numpy as np

    from ipjax.inference.drawing import write_image
    from ipjax.inference.photos.comparison import compare_with_photo

    rows = []
    for one in results:
        title = f"{one.info.name}   confidence {float(one.estimate.confidence):.2f}"
        if bool(one.estimate.success) and not bool(one.estimate.present):
            title += "   not here, or not seen well enough: a guess"
        rows.append(compare_with_photo(one.templates, one.query, one.crop_estimate, title))
    target = _picture_path(arguments.compare, name, arguments)
    write_image(target, np.concatenate(rows))
    return target


def mesh_paths(name: str, count: int, arguments: argparse.Namespace) -> list[Path]:
    """The mesh file of each object in a frame; named as masks are, where there are several."""
    target = arguments.mesh_out
    if arguments.frames is None and len(arguments.objects) == 1 and arguments.instances == 1:
        return [target]
    return [target / f"{name}_{index:06d}.ply" for index in range(count)]


def write_mesh(result: Any, path: Path, messages: Messages) -> str | None:
    """Write the mesh of one object at its pose; returns its path, None where no pose was found."""
    from ipjax.files.meshes.saving import save_mesh
    from ipjax.inference.photos.corrected_mesh import pose_mesh

    if not bool(result.estimate.success):
        messages.note(f"{path}: not written, no pose of {result.info.name} was found")
        return None
    path.parent.mkdir(parents=True, exist_ok=True)
    save_mesh(pose_mesh(result), path)
    return str(path)
