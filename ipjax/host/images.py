"""Reading what a sensor wrote: colour, depth and mask images, and the camera that took them.

Every reader raises one sentence of `ValueError` that names the file. Depth keeps the number type of its file; its unit
is settled in `frames.frame`, by ``depth_scale`` (metres per depth unit).
"""

import json
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from ipjax.types import Camera

BYTES_PER_PIXEL = 12  # of memory while an image is decoded, converted and copied

# Names that ROS and OpenCV give to the lens models that OpenCV can undistort, and the lengths of their coefficients.
_LENSES = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8, 12, 14),
    "equidistant": (0, 4),
    "opencv": (0, 4, 5, 8, 12, 14),
}
_LENS_ALIASES = {"": "opencv", "none": "opencv", "pinhole": "opencv", "radtan": "plumb_bob", "fisheye": "equidistant"}


@dataclass(frozen=True)
class Intrinsics:
    """A camera as its file describes it.

    Args:
        matrix: K, 3 × 3, pixels; the first pixel's centre is (0, 0). Skew is refused.
        distortion: coefficients in OpenCV's order; empty or all zero = a pinhole.
        lens: "opencv", "plumb_bob", "rational_polynomial" or "equidistant" (OpenCV's fisheye).
        size: (width, height) in pixels of the images it belongs to, where the file says so.
        depth_scale: metres per unit of the depth image, where the file says so.

    Raises:
        ValueError: not a usable camera, in words.
    """

    matrix: np.ndarray
    distortion: tuple[float, ...] = ()
    lens: str = "opencv"
    size: tuple[int, int] | None = None
    depth_scale: float | None = None

    def __post_init__(self):
        matrix = np.asarray(self.matrix, np.float64)
        if matrix.shape != (3, 3):
            raise ValueError(f"the camera matrix must be 3 × 3, not {' × '.join(map(str, matrix.shape)) or 'a number'}")
        if not np.isfinite(matrix).all():
            raise ValueError("the camera matrix has entries that are not finite")
        if not np.allclose(matrix[2], (0, 0, 1)) or matrix[1, 0] != 0:
            raise ValueError("the camera matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], row by row")
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise ValueError(f"the camera matrix is singular or mirrored: fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g}")
        if abs(matrix[0, 1]) > 1e-3 * matrix[0, 0]:
            raise ValueError(f"the camera matrix has a skew of {matrix[0, 1]:g}, which is not supported")
        ratio = matrix[0, 0] / matrix[1, 1]
        if not 0.1 < ratio < 10:
            raise ValueError(f"the focal lengths differ too much: fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g}")
        lens = str(self.lens).strip().lower()
        lens = _LENS_ALIASES.get(lens, lens)
        if lens not in _LENSES:
            known = ", ".join(_LENSES)
            raise ValueError(f"unknown lens model {self.lens!r}; undistort the images first, or use one of {known}")
        distortion = tuple(float(c) for c in self.distortion)
        if not np.isfinite(distortion).all():
            raise ValueError("the distortion coefficients are not all finite")
        if len(distortion) not in _LENSES[lens]:
            raise ValueError(f"{len(distortion)} distortion coefficients do not fit the lens model {lens}")
        scale = self.depth_scale
        if scale is not None and not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"the depth scale must be a positive number, not {scale}")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "lens", lens)
        object.__setattr__(self, "distortion", distortion if np.any(distortion) else ())

    @property
    def camera(self) -> Camera:
        """The pinhole, as a record of arrays; distortion is not part of it."""
        K = self.matrix
        return Camera(
            focal=jnp.asarray([K[0, 0], K[1, 1]], jnp.float32), centre=jnp.asarray([K[0, 2], K[1, 2]], jnp.float32)
        )


def as_intrinsics(camera: Any) -> Intrinsics:
    """Whatever describes a camera: `Intrinsics`, a `Camera`, a 3 × 3 matrix, or (fx, fy, cx, cy).

    Raises:
        ValueError: none of these, or not a usable camera.
    """
    if isinstance(camera, Intrinsics):
        return camera
    if isinstance(camera, Camera):
        focal, centre = np.asarray(camera.focal, np.float64), np.asarray(camera.centre, np.float64)
        if focal.shape != (2,):
            raise ValueError(f"frame takes one camera, not a batch of shape {focal.shape[:-1]}")
        return _from_numbers(*focal, *centre)
    if isinstance(camera, dict):
        return read_camera(camera)
    array = np.asarray(camera, np.float64)
    if array.shape == (4,):
        return _from_numbers(*array)
    return Intrinsics(array)


def read_camera(source: str | Path | dict, image: int | None = None) -> Intrinsics:
    """A camera from BOP JSON (scene_camera.json, camera.json), plain fx fy cx cy, or ROS CameraInfo (YAML or JSON).

    Args:
        source: a file, or the dictionary it would hold. A text file may hold fx fy cx cy, or nine numbers row by row.
        image: which image of a BOP ``scene_camera.json``; not needed where it holds only one.

    Returns:
        The intrinsics. A ``depth_scale`` in BOP's or a plain JSON file multiplies depth to millimetres, as BOP defines
        it (https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md); here it becomes metres.

    Raises:
        ValueError: unreadable, or not a usable camera; names the file.
    """
    if isinstance(source, dict):
        return _from_dict(source, image)
    path = Path(source)
    text = _read_text(path, "camera file")
    try:
        return _from_dict(_parse(text), image)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_rgb(path: str | Path) -> np.ndarray:
    """A colour image as uint8, height × width × 3; EXIF orientation applied, transparency dropped.

    Raises:
        ValueError: missing, unreadable or absurd; names the file.
    """
    image = _open(path)
    image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I") or image.mode == "F":
        raise ValueError(f"{path}: a one-channel image of more than 8 bits is no colour image; is this the depth?")
    return np.array(image.convert("RGB"))


def read_depth(path: str | Path) -> np.ndarray:
    """A depth image as its file stores it: uint16 (PNG, TIFF) or float (TIFF, npy), height × width.

    Raises:
        ValueError: missing, unreadable, 8-bit or coloured; names the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        depth = _load_npy(path)
    elif path.suffix.lower() == ".exr":
        raise ValueError(f"{path}: EXR is not supported; save the depth as 16-bit PNG, float TIFF or npy")
    else:
        image = _open(path)
        if image.mode not in ("I;16", "I;16B", "I;16L", "I;16N", "I", "F"):
            raise ValueError(f"{path}: depth must be 16-bit or float with one channel, not 8-bit {image.mode}")
        depth = np.array(image)
        if image.mode == "I" and depth.min() >= 0 and depth.max() < 65536:
            depth = depth.astype(np.uint16)
    if depth.ndim == 3 and depth.shape[-1] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"{path}: depth must be height × width, not {' × '.join(map(str, depth.shape))}")
    if depth.dtype.kind not in "uif":
        raise ValueError(f"{path}: depth must be numbers, not {depth.dtype}")
    return depth


def read_mask(path: str | Path) -> np.ndarray:
    """A mask as bool, height × width: what is not black (8-bit: 128 and above where any pixel is that bright).

    Raises:
        ValueError: missing or unreadable; names the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        mask = _load_npy(path)
    else:
        image = ImageOps.exif_transpose(_open(path))
        if image.mode in ("RGBA", "LA"):
            # A cut-out photo carries its mask as transparency; an opaque one in its colours.
            alpha = np.array(image.getchannel("A"))
            mask = alpha if alpha.min() < 128 else np.array(image.convert("L"))
        elif image.mode == "P":
            mask = np.array(image)  # indices, not colours
        else:
            mask = np.array(image if image.mode in ("1", "L", "I", "I;16", "F") else image.convert("L"))
    try:
        return as_mask(mask)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def as_mask(mask: Any) -> np.ndarray:
    """Booleans from whatever masks come as: bool, 0/1, 0/255, probabilities; one channel or several.

    Raises:
        ValueError: wrong shape or not finite.
    """
    mask = np.asarray(mask)
    if mask.ndim == 3 and mask.shape[-1] in (1, 3, 4):
        mask = mask[..., :3].max(axis=-1)
    if mask.ndim != 2:
        raise ValueError(f"the mask must be height × width, not {' × '.join(map(str, mask.shape)) or 'a number'}")
    if mask.dtype == bool:
        return mask
    if mask.dtype.kind == "f":
        if not np.isfinite(mask).all():
            raise ValueError("the mask has values that are not finite")
        return mask > (0.5 if mask.max(initial=0) <= 1 else 127.5)
    if mask.dtype.kind not in "ui":
        raise ValueError(f"the mask must be numbers, not {mask.dtype}")
    return mask >= 128 if mask.dtype == np.uint8 and mask.max(initial=0) >= 128 else mask > 0


def _from_numbers(fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    return Intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64))


def _from_dict(entry: Any, image: int | None) -> Intrinsics:
    if isinstance(entry, list):
        array = _numbers(entry, "the camera")
        if array.size == 4:
            return _from_numbers(*array.reshape(-1))
        if array.size == 9:
            return Intrinsics(array.reshape(3, 3))
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
            raise ValueError(f"it holds no camera for image {image}; it has {_some(sorted(images))}")
        if not isinstance(images[image], dict):
            raise ValueError(f"the entry of image {image} is no camera")
        return _from_dict(images[image], None)
    entry = {str(key).lower(): value for key, value in entry.items()}
    if "camera_info" in entry and isinstance(entry["camera_info"], dict):
        return _from_dict(entry["camera_info"], image)
    size = _size(entry)
    if "cam_k" in entry:
        return Intrinsics(_matrix(entry["cam_k"]), size=size, depth_scale=_bop_depth_scale(entry))
    if {"fx", "fy", "cx", "cy"} <= entry.keys():
        numbers = _numbers([entry[key] for key in ("fx", "fy", "cx", "cy")], "fx, fy, cx, cy")
        coefficients = next((entry[key] for key in ("distortion", "dist_coeffs", "coeffs", "d") if key in entry), None)
        return Intrinsics(
            _from_numbers(*numbers).matrix,
            distortion=() if coefficients is None else tuple(_numbers(coefficients, "the distortion").reshape(-1)),
            lens=str(entry.get("distortion_model", "opencv")),
            size=size,
            depth_scale=_bop_depth_scale(entry),
        )
    if "intrinsic_matrix" in entry:  # Open3D writes it column by column
        return Intrinsics(_matrix(entry["intrinsic_matrix"]).T, size=size)
    for key in ("camera_matrix", "k", "matrix"):
        if key in entry:
            coefficients = next((entry[d] for d in ("distortion_coefficients", "distortion", "d") if d in entry), ())
            if isinstance(coefficients, dict):
                coefficients = coefficients.get("data", ())
            return Intrinsics(
                _matrix(entry[key]),
                distortion=tuple(_numbers(coefficients, "the distortion").reshape(-1)),
                lens=str(entry.get("distortion_model", "opencv")),
                size=size,
            )
    raise ValueError(f"no camera among its entries ({_some(list(entry))}); cam_K, K, or fx, fy, cx and cy are expected")


def _matrix(value: Any) -> np.ndarray:
    if isinstance(value, dict):
        value = value.get("data", ())
    array = _numbers(value, "the camera matrix")
    if array.size != 9:
        raise ValueError(f"the camera matrix has {array.size} entries instead of 9")
    return array.reshape(3, 3)


def _numbers(value: Any, what: str) -> np.ndarray:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be numbers") from None


def _size(entry: dict) -> tuple[int, int] | None:
    for width, height in (("width", "height"), ("image_width", "image_height")):
        if width in entry and height in entry:
            size = _numbers([entry[width], entry[height]], "the image size")
            if np.isfinite(size).all() and (size > 0).all():  # ROS drivers leave 0 × 0 where they do not know
                return int(size[0]), int(size[1])
    return None


def _bop_depth_scale(entry: dict) -> float | None:
    if "depth_scale" not in entry:
        return None
    return float(_numbers(entry["depth_scale"], "the depth scale").reshape(())) * 1e-3


def _some(items: list) -> str:
    shown = ", ".join(str(item) for item in items[:6])
    return shown + (" …" if len(items) > 6 else "")


def _parse(text: str) -> Any:
    stripped = text.strip()
    if not stripped:
        raise ValueError("the file is empty")
    if stripped[0] in "{[":
        try:
            return json.loads(stripped)
        except json.JSONDecodeError as error:
            raise ValueError(f"broken JSON: {error}") from None
    words = re.split(r"[\s,;]+", stripped)
    try:
        return [float(word) for word in words if word]
    except ValueError:
        return _parse_yaml(stripped)


def _parse_yaml(text: str) -> dict:
    """The small part of YAML in which ROS writes CameraInfo: nested keys, [lists] and lists of '- number' lines."""
    lines: list[str] = []
    for raw in text.splitlines():
        line = raw.split("#", 1)[0].rstrip()
        if not line.strip() or line.strip() in ("---", "...") or line.startswith("%"):
            continue
        if lines and lines[-1].count("[") > lines[-1].count("]"):
            lines[-1] += " " + line.strip()  # a [list] that goes on over several lines
        else:
            lines.append(line)

    def block(start: int, indent: int) -> tuple[Any, int]:
        mapping: dict[str, Any] = {}
        items: list[Any] = []
        i = start
        while i < len(lines):
            line, depth = lines[i].strip(), len(lines[i]) - len(lines[i].lstrip())
            if depth < indent or (depth == indent and items and not line.startswith("-")):
                break
            if line.startswith("- "):
                items.append(_scalar(line[2:]))
                i += 1
                continue
            match = re.match(r"([\w/\-]+)\s*:(.*)", line)
            if not match:
                raise ValueError(f"neither JSON, numbers nor CameraInfo YAML: {line[:40]!r}")
            name, value = match[1], match[2].strip()
            i += 1
            if value:
                mapping[name] = _scalar(value)
            elif i < len(lines):
                following = len(lines[i]) - len(lines[i].lstrip())
                # YAML lets the items of a list stand as far left as its key.
                if following > depth or (following == depth and lines[i].strip().startswith("- ")):
                    mapping[name], i = block(i, following)
        return (items if items else mapping), i

    parsed, _ = block(0, 0)
    if not isinstance(parsed, dict):
        raise ValueError("neither JSON, numbers nor CameraInfo YAML")
    return parsed


def _scalar(text: str) -> Any:
    text = text.strip()
    if text.startswith("[") and text.endswith("]"):
        return [_scalar(word) for word in text[1:-1].split(",") if word.strip()]
    text = text.strip("\"'")
    try:
        return float(text)
    except ValueError:
        return text


def _read_text(path: Path, what: str) -> str:
    if not path.is_file():
        raise ValueError(f"{path}: no such {what}")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file") from None
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None


def _load_npy(path: Path) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path}: not a readable npy file ({str(error).splitlines()[0]})") from None


def _open(path: str | Path) -> Image.Image:
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(file)
            image.load()
    except UnidentifiedImageError:
        raise ValueError(f"{path}: not an image") from None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise ValueError(f"{path}: more than {Image.MAX_IMAGE_PIXELS or 0:,} pixels") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        why = str(error).splitlines()[0] if str(error) else "unreadable"
        raise ValueError(f"{path}: broken image ({why})") from None
    return image
