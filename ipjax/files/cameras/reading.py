"""Cameras from JSON, YAML and plain numbers, as BOP, ROS, OpenCV, Kalibr, librealsense and others write them."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.cameras import crop, resize
from ipjax.files.cameras.fields import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    MATRIX,
    SHAPE,
    SIZE,
    WIDTH,
    Fields,
    as_number,
    as_numbers,
    find_camera,
)
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.lenses import is_nonzero, read_lens
from ipjax.files.storage.parsing import parse, read_text
from ipjax.files.wording import abbreviate
from ipjax.records import Camera


def as_intrinsics(camera: Any) -> Intrinsics:
    """Whatever describes a camera: `Intrinsics`, a `Camera`, a 3 × 3 matrix, or (fx, fy, cx, cy).

    Raises:
        ValueError: none of these, or not a usable camera.
    """
    if isinstance(camera, Intrinsics):
        return camera
    if isinstance(camera, Camera):
        matrix = camera.to_matrix()
        if matrix.ndim != 2:
            raise ValueError(f"frame takes one camera, not a batch of shape {matrix.shape[:-2]}")
        return Intrinsics(matrix)
    if isinstance(camera, dict):
        return read_camera(camera)
    array = as_numbers(camera, "the camera")
    if array.shape == (4,):
        return Intrinsics(_make_matrix(*array))
    return Intrinsics(array)


def read_camera(source: str | Path | dict, image: int | None = None) -> Intrinsics:
    """A camera from JSON, YAML or plain numbers.

    Known are BOP (scene_camera.json, camera.json), ROS CameraInfo with its region of interest and binning, OpenCV's
    YAML, Kalibr, librealsense, Open3D, ORB-SLAM, and what is spelled like one of them: a matrix, or fx, fy, cx, cy,
    with a size and a lens. Where a file holds several cameras, that of the colour image is taken.

    Args:
        source: a file, or the dictionary it would hold. A text file may hold fx fy cx cy, or nine numbers row by row.
        image: which image of a BOP ``scene_camera.json``; not needed where it holds only one.

    Returns:
        The intrinsics. A ``depth_scale`` multiplies depth to millimetres, as BOP defines it
        (https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md); here it becomes metres.

    Raises:
        ValueError: unreadable, not a usable camera, or a lens that is not understood; names the file.
    """
    if isinstance(source, dict):
        return _read_entry(source, image)
    path = Path(source)
    text = read_text(path, "camera file")
    try:
        return _read_entry(_parse(text), image)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _make_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def _find_matrix(array: np.ndarray) -> np.ndarray | None:
    """K of fx, fy, cx, cy, of nine numbers row by row, or of rows of four that move nothing; None of others."""
    if array.size == 4:
        return _make_matrix(*array.reshape(-1))
    if array.size == 9:
        return array.reshape(3, 3)
    if array.size in (12, 16):
        rows = array.reshape(-1, 4)
        if np.array_equal(rows[2:], np.eye(4)[2 : len(rows)]) and not rows[:2, 3].any():
            return rows[:3, :3]
    return None


def _parse(text: str) -> Any:
    if not text.strip():
        raise ValueError("the file is empty")
    try:  # no more than could be a camera, with some to count
        return [float(word) for word in re.split(r"[\s,;]+", text.strip(), maxsplit=20) if word]
    except ValueError:
        pass
    entry = parse(text)
    if not isinstance(entry, dict | list):
        raise ValueError(f"neither JSON, YAML nor numbers with a camera: {text.strip()[:40]!r}")
    return entry


def _read_entry(entry: Any, image: int | None) -> Intrinsics:
    if isinstance(entry, list):
        if len(entry) == 1 and isinstance(entry[0], dict):
            return _read_entry(entry[0], image)
        array = as_numbers(entry, "the camera")
        matrix = _find_matrix(array)
        if matrix is not None:
            return Intrinsics(matrix)
        raise ValueError(f"{array.size} numbers are no camera; fx fy cx cy, or nine numbers row by row, are expected")
    if not isinstance(entry, dict) or not entry:
        raise ValueError("no camera in it; BOP JSON, fx fy cx cy, or ROS CameraInfo is expected")
    if all(str(key).isdigit() for key in entry):  # BOP scene_camera.json
        images = {int(key): value for key, value in entry.items()}
        if image is None and len(images) == 1:
            image = next(iter(images))
        if image is None:
            raise ValueError(f"it holds the cameras of {len(images)} images; say which one")
        if image not in images:
            raise ValueError(f"it holds no camera for image {image}; it has {abbreviate(sorted(images), 6)}")
        if not isinstance(images[image], dict):
            raise ValueError(f"the entry of image {image} is no camera")
        return _read_entry(images[image], None)
    found = find_camera(entry)
    if found is None:
        names = abbreviate(list(entry), 6)
        raise ValueError(f"no camera among its entries ({names}); cam_K, K, or fx, fy, cx and cy are expected")
    return _read_fields(found)


def _read_fields(fields: Fields) -> Intrinsics:
    matrix = _read_matrix(fields)
    lens, coefficients = read_lens(fields)
    size = _read_size(fields, matrix)
    scale = fields.take(re.compile(r"^depthscale$"))
    skew = fields.take(re.compile(r"^skew$"))
    if skew is not None:
        matrix[0, 1] = matrix[0, 1] or as_number(skew, "the skew")
    camera = Intrinsics(
        matrix,
        distortion=coefficients,
        lens=lens,
        size=size,
        depth_scale=None if scale is None else as_number(scale, "the depth scale") * 1e-3,
    )
    return _crop_and_bin(camera, fields)


def _read_matrix(fields: Fields) -> np.ndarray:
    numbers = [fields.take(pattern) for pattern in (FX, FY, CX, CY)]
    by_columns = any(name == "intrinsicmatrix" for name, _, _ in fields.items)
    given = fields.take(MATRIX)
    matrix = None
    if given is not None:
        if isinstance(given, dict):
            given = given.get("data", ())
        array = as_numbers(given, "the camera matrix")
        matrix = _find_matrix(array)
        if matrix is None:
            raise ValueError(f"the camera matrix has {array.size} entries instead of 9")
        if by_columns and np.array_equal(matrix[:2, 2], (0, 0)):  # Open3D writes it column by column
            matrix = matrix.T
        matrix = matrix.copy()
    if all(number is None for number in numbers):
        assert matrix is not None
        return matrix
    missing = [name for name, number in zip(("fx", "fy", "cx", "cy"), numbers, strict=True) if number is None]
    if missing and matrix is None:
        raise ValueError(f"the camera has no {', '.join(missing)}")
    if not missing:
        other = _make_matrix(*(as_number(number, "fx, fy, cx, cy") for number in numbers))
        if matrix is not None and not np.allclose(matrix, other, rtol=1e-4, atol=0.01):
            raise ValueError("the camera matrix and fx, fy, cx, cy say different things; keep what is right")
        return other
    assert matrix is not None
    return matrix


def _read_size(fields: Fields, matrix: np.ndarray) -> tuple[int, int] | None:
    sizes = []
    width, height = fields.take(WIDTH), fields.take(HEIGHT)
    if width is not None and height is not None:
        sizes.append((width, height))
    for pattern in (SIZE, SHAPE):
        pair = fields.take(pattern)
        if isinstance(pair, str):
            pair = re.findall(r"\d+", pair)
        if isinstance(pair, dict):
            inner = Fields(pair)
            pair = [inner.take(WIDTH), inner.take(HEIGHT)]
        if isinstance(pair, list) and len(pair) >= 2 and None not in pair[:2]:
            pair = pair[:2]
            if pattern is SHAPE or _is_height_first(pair, matrix):
                pair = pair[::-1]
            sizes.append(tuple(pair))
    known = []
    for pair in sizes:
        size = as_numbers(list(pair), "the image size").reshape(-1)
        if size.size == 2 and np.isfinite(size).all() and (size >= 1).all():  # ROS drivers leave 0 × 0 if unknown
            known.append((int(size[0]), int(size[1])))
    if len(set(known)) > 1:
        raise ValueError(f"it names two image sizes, {known[0][0]} × {known[0][1]} and {known[1][0]} × {known[1][1]}")
    return known[0] if known else None


def _is_height_first(pair: list, matrix: np.ndarray) -> bool:
    """Whether two numbers of a list are height and width, as arrays have them: the principal point is in the middle."""
    size = as_numbers(pair, "the image size").reshape(-1)
    if size.size != 2 or not (size > 0).all():
        return False
    as_listed, turned = (np.abs(matrix[:2, 2] / order - 0.5).max() for order in (size, size[::-1]))
    return bool(turned < 0.06 < as_listed)


def _crop_and_bin(camera: Intrinsics, fields: Fields) -> Intrinsics:
    """The camera of the published images: in ROS, K is of the whole sensor, of which they are a part (roi), binned.

    http://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html
    """
    matrix, size = camera.matrix, camera.size
    roi = fields.take(re.compile(r"^roi$"))
    if isinstance(roi, dict):
        left, top, width, height = (
            as_number(roi.get(name) or 0, "the region of interest")
            for name in ("x_offset", "y_offset", "width", "height")
        )
        if width > 0 and height > 0:
            matrix = crop(matrix, (left, top))
            size = (int(width), int(height))
        elif left or top:
            raise ValueError("the region of interest has an offset, but no size")
    elif roi is not None and is_nonzero(roi):
        raise ValueError("roi is not understood; x_offset, y_offset, width and height are expected")
    joined = []
    for name in ("binningx", "binningy"):
        value = fields.take(re.compile(f"^{name}$"))
        joined.append(max(1.0, 1.0 if value is None else as_number(value, "the binning")))  # drivers write 0 for 1
    if size is not None:
        size = (int(size[0] // joined[0]), int(size[1] // joined[1]))
    return replace(camera, matrix=resize(matrix, (joined[0], joined[1]), (1, 1)), size=size)
