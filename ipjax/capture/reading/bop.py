"""One scene of a BOP data set, with the poses of its cameras where ``scene_camera.json`` has them.

``cam_R_w2c`` and ``cam_t_w2c`` (millimetres) are camera_from_world:
https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md.
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
from ipjax.capture.reading.poses import stack_matrices
from ipjax.capture.records import Capture, CaptureError
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.reading import read_camera
from ipjax.files.storage.parsing import read_json
from ipjax.transforms import Similarity

_MM = 1e-3  # metres
_SAME = 0.05  # pixels by which K may differ between images of one camera


def is_bop(folder: Path) -> bool:
    """Whether a folder has this form."""
    return (folder / "scene_camera.json").is_file()


def open_bop(folder: Path, *, camera: Any, depth_scale: float | int | None, poses: bool, chosen: slice) -> Capture:
    """A capture of this form; arguments and errors are `open_capture`'s."""
    path = folder / "scene_camera.json"
    try:
        document = read_json(path, "camera file")
    except ValueError as error:
        raise CaptureError(str(error)) from None
    if not isinstance(document, dict) or not all(str(key).isdigit() for key in document):
        raise CaptureError(f"{path}: the cameras of images are expected, by their numbers")
    entries = {int(key): value for key, value in document.items()}
    colours = list_images(folder / "rgb", COLOURS) or list_images(folder / "gray", COLOURS)
    if not colours:
        raise CaptureError(f"{folder}: it has no images in rgb/ or gray/")
    names = list(colours)[chosen]
    odd = [name for name in names if not name.isdigit() or not isinstance(entries.get(int(name)), dict)]
    if odd:
        raise CaptureError(f"{path}: it has no camera of image {odd[0]}")
    depths = list_images(folder / "depth", DEPTHS)
    if depths:
        check_names(folder / "depth", "the depth image", names, depths)
    own = [entries[int(name)] for name in names]
    intrinsics = pick_camera(folder, camera) if camera is not None else _one_camera(path, names, own)
    files = [FrameFiles(name, colours[name], depths.get(name)) for name in names]
    return assemble(
        folder,
        "bop",
        files,
        intrinsics,
        depth=find_depth_form((item.depth for item in files), intrinsics, depth_scale),
        world_from_camera=_read_poses(path, names, own) if poses else None,
    )


def _one_camera(path: Path, names: list[str], entries: list[dict]) -> Intrinsics:
    first: Intrinsics | None = None
    for name, entry in zip(names, entries, strict=True):
        try:
            camera = read_camera(entry)
        except ValueError as error:
            raise CaptureError(f"{path}: image {name}: {error}") from None
        first = first or camera
        if np.abs(camera.matrix - first.matrix).max() > _SAME or camera.depth_scale != first.depth_scale:
            raise CaptureError(
                f"{path}: image {name} has another camera than image {names[0]}: a capture is of one camera throughout"
            )
    assert first is not None
    return first


def _read_poses(path: Path, names: list[str], entries: list[dict]) -> Similarity[np.ndarray] | None:
    if not any("cam_R_w2c" in entry for entry in entries):
        return None
    matrices = []
    for name, entry in zip(names, entries, strict=True):
        try:
            matrix = np.eye(4)
            matrix[:3, :3] = np.asarray(entry["cam_R_w2c"], np.float64).reshape(3, 3)
            matrix[:3, 3] = np.asarray(entry["cam_t_w2c"], np.float64).reshape(3) * _MM
        except KeyError as error:
            raise CaptureError(f"{path}: image {name} has no {error.args[0]}, which others have") from None
        except (TypeError, ValueError):
            raise CaptureError(f"{path}: image {name}: cam_R_w2c has nine numbers, cam_t_w2c three") from None
        matrices.append(matrix)
    return stack_matrices(matrices, [f"{path}: image {name}" for name in names]).inverse()
