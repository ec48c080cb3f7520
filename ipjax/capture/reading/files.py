"""The files of a capture's frames, whatever the form they lie in, and reading them: metres, without distortion."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.records import Capture, CaptureError, CaptureFrame
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.reading import as_intrinsics, read_camera
from ipjax.files.images.depth import read_depth, remove_sentinel
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb, read_size
from ipjax.files.wording import abbreviate
from ipjax.inference.cutting import undistort_frame
from ipjax.inference.depth import check_frame_unit, find_depth_scale, to_metres
from ipjax.transforms import Similarity

COLOURS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
DEPTHS = (".png", ".tif", ".tiff", ".npy")
CAMERAS = ("camera.json", "camera.yaml", "camera.yml", "camera.txt", "cam_K.txt")
CODE_UNIT = 0.0001  # metres per number, once the bits are back in their places
_CHANGING = 0.05  # share of neighbouring numbers whose lowest three bits may differ, where they are the highest
_HALL = 10_000  # numbers


@dataclasses.dataclass(frozen=True)
class FrameFiles:
    """The files of one frame."""

    name: str
    rgb: Path
    depth: Path | None = None  # registered to the colours
    raw: Path | None = None  # as the depth camera saw it
    ignore: Path | None = None  # non-zero = moves with the camera


@dataclasses.dataclass(frozen=True)
class DepthForm:
    """How the numbers of depth images become metres."""

    scale: float  # metres per number
    coded: bool = False  # the bits are turned by three places, as librealsense's first users stored them
    floats: bool = False  # the numbers are floats, whose unit is another than that of whole numbers

    def read(self, path: Path) -> np.ndarray:
        """float32, metres, 0 = unknown. Raises ValueError."""
        depth = read_depth(path)
        if (depth.dtype.kind == "f") != self.floats:
            kinds = ("floats", "whole numbers") if depth.dtype.kind == "f" else ("whole numbers", "floats")
            raise ValueError(f"{path}: depth of {kinds[0]} among depth of {kinds[1]}: they cannot have one unit")
        if self.coded:
            depth = turn_bits(depth)
        return to_metres(remove_sentinel(depth)[0], self.scale)


@dataclasses.dataclass(frozen=True)
class FrameReader:
    """Reads a frame when it is asked for; CaptureError, in words, for what cannot be read."""

    files: tuple[FrameFiles, ...]
    camera: Intrinsics
    size: tuple[int, int]
    depth: DepthForm | None
    raw: DepthForm | None
    depth_camera: Intrinsics | None
    depth_size: tuple[int, int] | None

    def __call__(self, index: int, /) -> CaptureFrame:
        """Frame number ``index`` of the capture."""
        files = self.files[index]
        try:
            return self._read(files)
        except (ValueError, OSError) as error:
            raise CaptureError(str(error)) from None

    def _read(self, files: FrameFiles) -> CaptureFrame:
        width, height = self.size
        rgb = read_rgb(files.rgb)
        _check_size(files.rgb, rgb, self.size)
        depth = np.zeros((height, width), np.float32)
        if files.depth is not None and self.depth is not None:
            depth = self.depth.read(files.depth)
            _check_size(files.depth, depth, self.size)
        usable = np.ones((height, width), bool)
        if files.ignore is not None:
            hidden = read_mask(files.ignore)
            _check_size(files.ignore, hidden, self.size)
            usable = ~hidden
        if self.camera.distortion:
            rgb, depth, _, _ = undistort_frame(rgb, depth, None, None, self.camera)
            # What lies outside the photo, undistorted, was never seen.
            inside = np.ones((height, width, 3), np.uint8)
            inside, shown, _, _ = undistort_frame(inside, usable.astype(np.float32), None, None, self.camera)
            usable = (shown > 0) & (inside[..., 0] > 0)
        raw = None
        if files.raw is not None and self.raw is not None and self.depth_size is not None:
            raw = self.raw.read(files.raw)
            _check_size(files.raw, raw, self.depth_size)
            if self.depth_camera is not None and self.depth_camera.distortion:
                blank = np.zeros((*raw.shape, 3), np.uint8)
                _, raw, _, _ = undistort_frame(blank, raw, None, None, self.depth_camera)
        return CaptureFrame(
            name=files.name,
            rgb=rgb,
            depth=None if files.depth is None else depth,
            raw_depth=raw,
            usable=np.asarray(usable, bool),
        )


def assemble(
    folder: Path,
    form: str,
    files: Sequence[FrameFiles],
    camera: Intrinsics,
    *,
    depth: DepthForm | None,
    raw: DepthForm | None = None,
    depth_camera: Intrinsics | None = None,
    colour_from_depth: Similarity[np.ndarray] | None = None,
    world_from_camera: Similarity[np.ndarray] | None = None,
    notes: Iterable[str] = (),
) -> Capture:
    """A capture of its files, once their sizes are known to fit.

    Raises:
      CaptureError: an image is missing or has another size, or no frame has depth.
    """
    size = _common_size([item.rgb for item in files], "the colour images")
    _check_camera(camera, size, f"{folder}: the camera", "the colour images")
    with_depth = [item.depth for item in files if item.depth is not None]
    with_raw = [item.raw for item in files if item.raw is not None]
    if not with_depth and not with_raw:
        raise CaptureError(f"{folder}: there is no depth: a capture has a depth image for every colour image")
    for path, found in _sizes(with_depth):
        if found != size:
            raise CaptureError(
                f"{path}: {found[0]} × {found[1]} pixels, and the colour images have {size[0]} × {size[1]}: depth that "
                "is registered to the colours has their size; images of the depth camera itself belong into raw/"
            )
    depth_size = None
    if with_raw:
        depth_size = _common_size(with_raw, "the raw depth images")
        if depth_camera is not None:
            _check_camera(depth_camera, depth_size, f"{folder}: the depth camera", "the raw depth images")
    reader = FrameReader(tuple(files), camera, size, depth, raw, depth_camera, depth_size)
    return Capture(
        folder=folder,
        form=form,
        names=tuple(item.name for item in files),
        camera=camera.camera,
        size=size,
        read_frame=reader,
        depth_camera=None if depth_camera is None else depth_camera.camera,
        depth_size=depth_size,
        colour_from_depth=colour_from_depth,
        world_from_camera=world_from_camera,
        notes=tuple(notes),
    )


def list_images(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The images of a folder by their names without endings, in the order of the names; {} where there is no folder.

    Raises:
      CaptureError: two have the same name.
    """
    found: dict[str, Path] = {}
    if not folder.is_dir():
        return found
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.stem in found:
            raise CaptureError(
                f"{folder}: {found[path.stem].name} and {path.name} are two images of one frame; keep one"
            )
        found[path.stem] = path
    return found


def pick_camera(folder: Path, camera: Any, names: Iterable[str] = CAMERAS) -> Intrinsics:
    """The camera as given, or of the first of these files in the folder.

    Args:
      camera: a file, a dictionary, K, (fx, fy, cx, cy), `Intrinsics` or None.

    Raises:
      CaptureError: there is none, or it cannot be used.
    """
    try:
        if camera is not None:
            return read_camera(camera) if isinstance(camera, str | Path | dict) else as_intrinsics(camera)
        path = next((folder / name for name in names if (folder / name).is_file()), None)
        if path is not None:
            return read_camera(path)
    except ValueError as error:
        raise CaptureError(str(error)) from None
    raise CaptureError(
        f"{folder}: nothing says what the colour camera is ({', '.join(names)}); give its fx, fy, cx, cy in pixels "
        "(--camera)"
    )


def find_depth_form(
    paths: Iterable[Path | None], camera: Intrinsics, scale: float | int | None, default: float | None = None
) -> DepthForm | None:
    """How depth becomes metres: as given, as the camera's file says, 1 for floats, or as the form has it.

    Args:
      paths: of the depth images; the first decides, and None where there are none.
      scale: metres per number, where the user says so.
      default: of the form of captures.

    Raises:
      CaptureError: nothing says so, or no scene can be that near or far; with the unit that the numbers suggest.
    """
    path = next((p for p in paths if p is not None), None)
    if path is None:
        return None
    try:
        depth, _ = remove_sentinel(read_depth(path))
        if scale is None and camera.depth_scale is None and depth.dtype.kind != "f":
            scale = default
        scale = find_depth_scale(depth, scale, camera)
        check_frame_unit(depth, scale)
    except ValueError as error:
        said = str(error)
        raise CaptureError(said if str(path) in said else f"{path}: {said}") from None
    return DepthForm(scale, floats=depth.dtype.kind == "f")


def is_coded(path: Path) -> bool:
    """Whether depth is stored with its bits turned by three places, so that the lowest three are the highest.

    These then hardly change from pixel to pixel, and where they do, it is the turned numbers that go on smoothly. Of a
    scene that is all nearer than 0.8 m they are zero, and the numbers, as millimetres, would be of a hall.
    """
    try:
        depth = read_depth(path)
    except ValueError as error:
        raise CaptureError(str(error)) from None
    if depth.dtype != np.uint16:
        return False
    left, right = depth[:, :-1], depth[:, 1:]
    both = (left > 0) & (right > 0)
    changing = both & ((left & 7) != (right & 7))
    if not both.any() or changing.sum() > _CHANGING * both.sum():
        return False
    if not changing.any():
        known = depth[depth > 0]
        return not (known & 7).any() and bool(np.median(known) > _HALL)
    steps = [
        np.median(np.abs(a[changing].astype(np.int64) - b[changing]))
        for a, b in ((left, right), (turn_bits(left), turn_bits(right)))
    ]
    return bool(steps[1] < steps[0])


def turn_bits(depth: np.ndarray) -> np.ndarray:
    """uint16 with its bits turned back by three places."""
    return (depth >> 3) | (depth << 13)


def check_names(folder: Path, what: str, wanted: Iterable[str], there: Iterable[str]) -> None:
    """Refuse a capture of which some frames lack something. Raises CaptureError that names them."""
    there = set(there)
    missing = [name for name in wanted if name not in there]
    if missing:
        raise CaptureError(f"{folder}: {what} is missing of {abbreviate(missing)}; add it, or remove the frames")


def _common_size(paths: Sequence[Path], what: str) -> tuple[int, int]:
    first: tuple[int, int] | None = None
    for path, size in _sizes(paths):
        first = first or size
        if size != first:
            raise CaptureError(
                f"{path}: {size[0]} × {size[1]} pixels, and {paths[0].name} has {first[0]} × {first[1]}: {what} of a "
                "capture are of one camera, and of one size"
            )
    assert first is not None
    return first


def _sizes(paths: Iterable[Path]):
    for path in paths:
        try:
            if path.suffix.lower() == ".npy":
                height, width = read_depth(path).shape
                yield path, (width, height)
            else:
                yield path, read_size(path)
        except ValueError as error:
            raise CaptureError(str(error)) from None


def _check_camera(camera: Intrinsics, size: tuple[int, int], whose: str, what: str) -> None:
    if camera.size is not None and tuple(camera.size) != size:
        raise CaptureError(
            f"{whose} is for images of {camera.size[0]} × {camera.size[1]} pixels, and {what} have "
            f"{size[0]} × {size[1]}"
        )


def _check_size(path: Path, image: np.ndarray, size: tuple[int, int]) -> None:
    height, width = image.shape[:2]
    if (width, height) != size:
        raise ValueError(f"{path}: {width} × {height} pixels, and {size[0]} × {size[1]} are expected")
