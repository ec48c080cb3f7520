"""Our own folder of frames, the one that ``ipjax estimate --frames`` reads, and what a capture adds to it.

::

    rgb/NAME.png|jpg         colours
    depth/NAME.png           registered to the colours; may be left out where there is raw/
    raw/NAME.png             as the depth camera saw it; may be left out
    camera.json              fx, fy, cx, cy (or cam_K) of the colours, depth_scale (to millimetres, as BOP has it), lens
    depth_camera.json        the same of raw/; "colour_from_depth": 4 × 4, metres, if it is known
    poses.json               {"NAME": 4 × 4, …}: world_from_camera, metres; may be left out
    ignore.png, ignore/NAME.png    non-zero where something moves with the camera; may be left out
"""

from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.reading.files import (
    COLOURS,
    DEPTHS,
    FrameFiles,
    assemble,
    check_names,
    find_depth_form,
    list_images,
    pick_camera,
)
from ipjax.capture.reading.poses import read_named_poses, stack_matrices
from ipjax.capture.records import Capture, CaptureError
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.reading import read_camera
from ipjax.files.storage.parsing import read_json
from ipjax.transforms import Similarity


def is_frames(folder: Path) -> bool:
    """Whether a folder has this form."""
    return (folder / "rgb").is_dir()


def open_frames(folder: Path, *, camera: Any, depth_scale: float | int | None, poses: bool, chosen: slice) -> Capture:
    """A capture of this form; arguments and errors are `open_capture`'s."""
    colours = list_images(folder / "rgb", COLOURS)
    if not colours:
        raise CaptureError(f"{folder}: it has no images in rgb/")
    names = list(colours)[chosen]
    found = {kind: list_images(folder / kind, DEPTHS) for kind in ("depth", "raw")}
    for kind, images in found.items():
        if images:
            check_names(folder / kind, "the depth image" if kind == "depth" else "the raw depth image", names, images)
    intrinsics = pick_camera(folder, camera)
    ignored = list_images(folder / "ignore", COLOURS)
    if ignored and not ignored.keys() & colours.keys():
        raise CaptureError(f"{folder / 'ignore'}: {next(iter(ignored))} is the name of no frame, nor are the others")
    everywhere = folder / "ignore.png"
    files = [
        FrameFiles(
            name,
            colours[name],
            found["depth"].get(name),
            found["raw"].get(name),
            ignored.get(name, everywhere if everywhere.is_file() else None),
        )
        for name in names
    ]
    depth_camera, colour_from_depth = read_depth_camera(folder / "depth_camera.json") if found["raw"] else (None, None)
    if found["raw"] and depth_camera is None and not found["depth"]:
        raise CaptureError(
            f"{folder}: it has raw/ and no depth/, and no depth_camera.json that says what camera raw/ is of: fx, fy, "
            "cx, cy and depth_scale, and colour_from_depth if it is known"
        )
    given = folder / "poses.json"
    return assemble(
        folder,
        "frames",
        files,
        intrinsics,
        depth=find_depth_form((item.depth for item in files), intrinsics, depth_scale),
        raw=find_depth_form((item.raw for item in files), depth_camera or intrinsics, depth_scale),
        depth_camera=depth_camera,
        colour_from_depth=colour_from_depth,
        world_from_camera=read_named_poses(given, names) if poses and given.is_file() else None,
    )


def read_depth_camera(path: Path) -> tuple[Intrinsics | None, Similarity[np.ndarray] | None]:
    """The depth camera, and where it stands, of ``depth_camera.json``; None where it is not there.

    Raises:
      CaptureError: it cannot be used.
    """
    if not path.is_file():
        return None, None
    try:
        document = read_json(path, "camera file")
        if not isinstance(document, dict):
            raise ValueError(f"{path}: a dictionary is expected: fx, fy, cx, cy, depth_scale, colour_from_depth")
        matrix = document.pop("colour_from_depth", None)
        try:
            camera = read_camera(document)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    except ValueError as error:
        raise CaptureError(str(error)) from None
    if matrix is None:
        return camera, None
    pose = stack_matrices([matrix], [f"{path}: colour_from_depth"])
    return camera, pose.take(0)
