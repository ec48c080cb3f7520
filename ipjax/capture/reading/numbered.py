"""``frame-N.color.png``, ``frame-N.depth.png``, ``frame-N.pose.txt``: 7-Scenes, 3DMatch, and RealSense captures alike.

Poses are camera to world, 4 × 4, metres; depth is in millimetres, 65535 = unknown, or, as in the captures of
https://github.com/andyzeng/apc-vision-toolbox, in tenths of a millimetre with the bits turned by three places. Such a
capture may have ``raw/frame-N.depth.png`` of the depth camera itself, and ``cam.info.txt`` with both cameras,
``colour_from_depth`` and the poses.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.reading.files import (
    CAMERAS,
    CODE_UNIT,
    COLOURS,
    DepthForm,
    FrameFiles,
    assemble,
    check_names,
    find_depth_form,
    is_coded,
    pick_camera,
)
from ipjax.capture.reading.poses import read_matrix_file, stack_matrices
from ipjax.capture.records import Capture, CaptureError
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.storage.parsing import read_text

_FILE = re.compile(r"(?P<name>.*?)\.(?P<kind>color|depth|pose)\.(?P<end>\w+)")
_OWN_CAMERAS = ("camera-intrinsics.txt", "camera-intrinsics.color.txt")
_MILLIMETRES = 0.001


def is_numbered(folder: Path) -> bool:
    """Whether a folder has this form."""
    return any(folder.glob("*.color.*"))


def open_numbered(folder: Path, *, camera: Any, depth_scale: float | int | None, poses: bool, chosen: slice) -> Capture:
    """A capture of this form; arguments and errors are `open_capture`'s."""
    found: dict[str, dict[str, Path]] = {"color": {}, "depth": {}, "pose": {}}
    for path in sorted(folder.iterdir()):
        match = _FILE.fullmatch(path.name)
        if match is not None and (match["kind"] != "color" or f".{match['end'].lower()}" in COLOURS):
            other = found[match["kind"]].setdefault(match["name"], path)
            if other != path:
                raise CaptureError(f"{folder}: {other.name} and {path.name} are two files of one frame; keep one")
    names = list(found["color"])[chosen]
    raws = {path.name.removesuffix(".depth.png"): path for path in sorted((folder / "raw").glob("*.depth.png"))}
    for images, where in ((found["depth"], folder), (raws, folder / "raw")):
        if images:
            check_names(where, "the depth image", names, images)
    info = _read_info(folder / "cam.info.txt") if (folder / "cam.info.txt").is_file() else {}
    given = camera if camera is not None else info.get("camera")
    intrinsics = pick_camera(folder, given, (*_OWN_CAMERAS, *CAMERAS))
    matrices = {name: read_matrix_file(found["pose"][name]) for name in names if poses and name in found["pose"]}
    places = {name: str(found["pose"].get(name, folder / "cam.info.txt")) for name in names}
    if poses and not matrices:
        matrices = {name: info["poses"][name] for name in names if name in info.get("poses", {})}
    world_from_camera = None
    if matrices:
        check_names(folder, "the pose", names, matrices)
        world_from_camera = stack_matrices([matrices[name] for name in names], [places[name] for name in names])
    files = [FrameFiles(name, found["color"][name], found["depth"].get(name), raws.get(name)) for name in names]
    first = next((path for item in files for path in (item.depth, item.raw) if path is not None), None)
    notes = []
    if first is not None and depth_scale is None and intrinsics.depth_scale is None and is_coded(first):
        forms = [DepthForm(CODE_UNIT, coded=True)] * 2
        notes.append("depth is stored with its bits turned by three places, in tenths of a millimetre")
    else:
        forms = [
            find_depth_form(paths, intrinsics, depth_scale, _MILLIMETRES)
            for paths in ([item.depth for item in files], [item.raw for item in files])
        ]
    depth_camera = info.get("depth_camera")
    return assemble(
        folder,
        "numbered",
        files,
        intrinsics,
        depth=forms[0],
        raw=forms[1],
        depth_camera=depth_camera if raws else None,
        colour_from_depth=info.get("colour_from_depth") if raws else None,
        world_from_camera=world_from_camera,
        notes=notes,
    )


def _read_info(path: Path) -> dict[str, Any]:
    """What ``cam.info.txt`` holds under its headlines: camera, depth_camera, colour_from_depth, poses of frames."""
    try:
        lines = read_text(path, "camera file").splitlines()
    except ValueError as error:
        raise CaptureError(str(error)) from None
    blocks: list[tuple[str, list[list[float]]]] = []
    for number, line in enumerate(lines, 1):
        if line.lstrip().startswith("#"):
            blocks.append((line.strip("# \t"), []))
        elif line.strip() and blocks:
            try:
                blocks[-1][1].append([float(word) for word in line.split()])
            except ValueError:
                raise CaptureError(f"{path}: line {number}: numbers are expected, not {line.strip()[:60]!r}") from None
    found: dict[str, Any] = {"poses": {}}
    for headline, rows in blocks:
        if not rows:
            continue
        matrix = np.array(rows) if len({len(row) for row in rows}) == 1 else np.zeros((0, 0))
        words = headline.lower()
        try:
            if "intrinsic" in words:
                found["depth_camera" if "depth" in words else "camera"] = Intrinsics(matrix)
            elif "depth-to-color" in words:
                pose = stack_matrices([matrix], [f"{path}: {headline}"])
                found["colour_from_depth"] = pose.take(0)
            elif "camera-to-world" in words and " for " in words:
                found["poses"][headline.rpartition(" for ")[2].strip()] = matrix
        except CaptureError:
            raise
        except ValueError as error:
            raise CaptureError(f"{path}: {headline}: {error}") from None
    return found
