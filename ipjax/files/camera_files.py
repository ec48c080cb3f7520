"""Cameras as their files describe them: matrix, lens, image size, unit of depth.

Files spell the same things in many ways. A name is compared without case, punctuation, and what it begins with
(``camera``, ``image``, ``rgb``). What is about a lens and is not understood is refused: a lens that is not applied
moves the object without a word.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.cameras import crop, resize
from ipjax.files.storage.parsing import parse, read_text
from ipjax.records import Camera

# The lens models that OpenCV can undistort, and how many coefficients they have.
_LENSES = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8, 12, 14),
    "equidistant": (4,),
    "opencv": (0, 4, 5, 8, 12, 14),
}
# Names of the same models elsewhere, in lower-case letters and digits. "pinhole" names the projection and leaves the
# distortion open; "none" says that there is none.
_LENS_ALIASES = {
    "": "pinhole",
    "pinhole": "pinhole",
    "perspective": "pinhole",
    "simplepinhole": "pinhole",
    "none": "none",
    "null": "none",
    "nodistortion": "none",
    "undistorted": "none",
    "rectified": "none",
    "rectilinear": "none",
    "linear": "none",
    "ideal": "none",
    "plumbbob": "plumb_bob",
    "brownconrady": "plumb_bob",
    "brown": "plumb_bob",
    "radtan": "plumb_bob",
    "radialtangential": "plumb_bob",
    "opencv": "opencv",
    "rationalpolynomial": "rational_polynomial",
    "rational": "rational_polynomial",
    "fullopencv": "rational_polynomial",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "fisheye": "equidistant",
    "opencvfisheye": "equidistant",
    "kannalabrandt": "equidistant",
    "kannalabrandt4": "equidistant",
    "kannalabrandt8": "equidistant",  # ORB-SLAM counts focal lengths and centre
    "kb4": "equidistant",
}
# Models that OpenCV does not have, and that are a pinhole where all coefficients are zero.
_ZERO_IS_PINHOLE = {"inversebrownconrady", "modifiedbrownconrady", "division", "simpleradial", "radial", "polynomial"}
# What a word about the camera must hold to be a lens model, not the name of a device.
_LENS_WORDS = re.compile(
    r"fish|kannala|equi|omni|fov|theta|unified|ucm|^mei|sphere|spheric|division|polynom|inverse|brown|conrady|rational|"
    r"radtan|radial|tangent|prism|panoram|cylind|orthograph|624|distort"
)
_SCALARS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "taux", "tauy")  # OpenCV's order

_PREFIX = re.compile(r"^(camera|cam|colou?r|rgb|image|img|im(?=size|shape|width|height)|frame)(?=.)")
_MATRIX = re.compile(r"^(k|matrix|kmatrix|matrixk|intrinsics?(matrix|parameters)?|calibrationmatrix)$")
_FX, _FY, _CX, _CY = (
    re.compile(pattern)
    for pattern in (
        r"^(fx|flx|focal(length)?x)$",
        r"^(fy|fly|focal(length)?y)$",
        r"^(cx|ppx|u0|principal(point)?x|cent(re|er)x)$",
        r"^(cy|ppy|v0|principal(point)?y|cent(re|er)y)$",
    )
)
_WIDTH = re.compile(
    r"^(px|pixels?|res|resolution|size)?(w|width|cols|columns)(px|pixels?)?$|^(res|resolution|size)x$|^x(res|resolution)$"
)
_HEIGHT = re.compile(
    r"^(px|pixels?|res|resolution|size)?(h|height|rows)(px|pixels?)?$|^(res|resolution|size)y$|^y(res|resolution)$"
)
_SIZE = re.compile(r"^(size|sizewh|resolution|res|dims?|dimensions?|widthheight|wh)(px|pixels?)?$")
_SHAPE = re.compile(r"^(shape|heightwidth|hw)$")  # height first
_COEFFICIENTS = re.compile(
    r"^(lens)?(d|dist|disto|distort|distortions?)(coefficients?|coeffs?|coefs?|params?|parameters?|vector|vec)?$"
    r"|^(coefficients?|coeffs?|coefs?|kc)$"
)
_MODEL = re.compile(r"^(dist(ortion)?(model|type|name)|projection(model|type|modeltype)?)$")
_LOOSE_MODEL = re.compile(r"^(lens|lens(model|type)|model|type|modeltype|modelname)$")  # or the name of a device
_ABOUT_LENSES = re.compile(
    r"^([kpsb][1-9]\d?|tau[xy]|cod[xy]|xi|omega|alphac|skew|shear)$"
    r"|dist(or|o$|co|par|vec|$)|coeff|^lens|radial|tangential|fisheye|projectionparam|modelparam"
)


@dataclass(frozen=True)
class Intrinsics:
    """A camera as its file describes it.

    Args:
        matrix: K, 3 × 3, pixels; the first pixel's centre is (0, 0). Skew is refused.
        distortion: coefficients in OpenCV's order; empty or all zero = a pinhole, except for "equidistant", whose
            projection is another even then. Zeros behind those that a model has are dropped.
        lens: "opencv", "plumb_bob", "rational_polynomial" or "equidistant" (OpenCV's fisheye, Kannala–Brandt), or one
            of their names elsewhere.
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
        fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        if not (fx > 0 and fy > 0):
            raise ValueError(f"the camera matrix is singular or mirrored: fx = {fx:g}, fy = {fy:g}")
        if abs(matrix[0, 1]) > 1e-3 * fx:
            raise ValueError(f"the camera matrix has a skew of {matrix[0, 1]:g}, which is not supported")
        if not 0.1 < fx / fy < 10:
            raise ValueError(f"the focal lengths differ too much: fx = {fx:g}, fy = {fy:g}")
        if max(fx, fy) < 10 and max(abs(cx), abs(cy)) <= 2:
            raise ValueError(
                f"fx = {fx:g}, cx = {cx:g}: these look like shares of the image's width and height; give pixels"
            )
        if cx == 0 and cy == 0:
            raise ValueError("the principal point is (0, 0), the image's corner: cx and cy are missing")
        lens, distortion = _check_lens(self.lens, self.distortion)
        scale = self.depth_scale
        if scale is not None and not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"the depth scale must be a positive number, not {scale}")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "lens", lens)
        object.__setattr__(self, "distortion", distortion)

    @property
    def camera(self) -> Camera:
        """The pinhole, as a record of arrays; distortion is not part of it."""
        return Camera.from_matrix(self.matrix)


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
    array = _numbers(camera, "the camera")
    if array.shape == (4,):
        return Intrinsics(_matrix_of(*array))
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
        return _from_entry(source, image)
    path = Path(source)
    text = read_text(path, "camera file")
    try:
        return _from_entry(_parse(text), image)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def list_misfits(intrinsics: Intrinsics, width: int, height: int) -> list[str]:
    """What speaks against a camera belonging to images of a size, a sentence each; empty where nothing does.

    A principal point more than a tenth of the image away from its middle, a field of view below 10° or above 120°,
    and pixels far from square are rare in cameras and usual in a matrix of another image.
    """
    K = intrinsics.matrix
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    found = []
    shares = np.array([(cx + 0.5) / width, (cy + 0.5) / height])
    if np.abs(shares - 0.5).max() > 0.1:
        said = (
            f"the principal point ({cx:.1f}, {cy:.1f}) is far from the middle of the image of {width} × {height} pixels"
        )
        ratio = 2 * shares.mean()
        turned = np.array([(cy + 0.5) / width, (cx + 0.5) / height])
        if shares.min() > 0 and abs(shares[0] / shares[1] - 1) < 0.1 and abs(ratio - 1) > 0.05:
            said += (
                f": the camera matrix seems to belong to images of about {ratio * width:.0f} × {ratio * height:.0f}; "
                f"multiply fx, fy, cx and cy by {1 / ratio:.3g}"
            )
        elif np.abs(turned - 0.5).max() < 0.05:
            said += ": cx and cy look exchanged"
        else:
            said += ": right only where the image was cut out of a larger one"
        found.append(said)
    if intrinsics.lens != "equidistant":
        angles = [2 * np.degrees(np.arctan(side / 2 / f)) for side, f in ((width, fx), (height, fy))]
        if min(angles) < 10 or max(angles) > 120:
            found.append(
                f"the field of view of {angles[0]:.0f}° × {angles[1]:.0f}° (an image of {width} × {height} pixels with "
                f"fx = {fx:g}, fy = {fy:g}) is unusual: is the camera matrix of images of another size?"
            )
    if not 0.9 < fx / fy < 1.1:
        found.append(f"fx = {fx:g} and fy = {fy:g} differ: right only where the image was stretched in one direction")
    return found


def _check_lens(lens: str, coefficients: Any) -> tuple[str, tuple[float, ...]]:
    """The model as OpenCV has it, and as many coefficients as it takes; () = a pinhole."""
    given = tuple(float(c) for c in coefficients)
    if not np.isfinite(given).all():
        raise ValueError("the distortion coefficients are not all finite")
    word = _word(str(lens))
    name = _LENS_ALIASES.get(word)
    if name is None:
        if word in _ZERO_IS_PINHOLE and not any(given):
            return "opencv", ()
        known = ", ".join(_LENSES)
        raise ValueError(f"unknown lens model {lens!r}; undistort the images first, or use one of {known}")
    if name == "none" and any(given):
        raise ValueError(f"the lens model {lens!r} says no distortion, but the coefficients are not all zero")
    name = "opencv" if name in ("pinhole", "none") else name
    if name == "equidistant":
        if not given:
            raise ValueError(f"the lens model {lens!r} needs four coefficients (they may be zero), and there are none")
    elif not any(given):
        return name, ()
    needed = max((i + 1 for i, value in enumerate(given) if value), default=0)
    for count in reversed(_LENSES[name]):
        if needed <= count <= len(given):
            return name, given[:count]
    raise ValueError(f"{len(given)} distortion coefficients do not fit the lens model {name}")


def _word(text: str) -> str:
    """A name in lower-case letters and digits, without what libraries put before it."""
    text = re.sub(r"^.*[.:](?=.)", "", text.strip().lower())
    return re.sub(r"^rs2distortion", "", re.sub(r"[^a-z0-9]", "", text))


def _matrix_of(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def _matrix_from(array: np.ndarray) -> np.ndarray | None:
    """K of fx, fy, cx, cy, of nine numbers row by row, or of rows of four that move nothing; None of others."""
    if array.size == 4:
        return _matrix_of(*array.reshape(-1))
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


def _from_entry(entry: Any, image: int | None) -> Intrinsics:
    if isinstance(entry, list):
        if len(entry) == 1 and isinstance(entry[0], dict):
            return _from_entry(entry[0], image)
        array = _numbers(entry, "the camera")
        matrix = _matrix_from(array)
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
            raise ValueError(f"it holds no camera for image {image}; it has {_some(sorted(images))}")
        if not isinstance(images[image], dict):
            raise ValueError(f"the entry of image {image} is no camera")
        return _from_entry(images[image], None)
    found = _find(entry)
    if found is None:
        names = _some(list(entry))
        raise ValueError(f"no camera among its entries ({names}); cam_K, K, or fx, fy, cx and cy are expected")
    return _from_fields(found)


class _Fields:
    """The entries of a camera by their names without case, punctuation and prefix; what is read is ticked off."""

    def __init__(self, entry: dict):
        self.items: list[tuple[str, str, Any]] = []  # name, as spelled, value
        self.read: set[str] = set()
        self._add(entry)

    def _add(self, entry: dict) -> None:
        for key, value in entry.items():
            name = re.sub(r"[^a-z0-9]", "", str(key).lower())
            name = _PREFIX.sub("", name)
            parts = isinstance(value, dict) and "data" not in value
            # Dictionaries of coefficients, of focal lengths or about the model stand for their members.
            if parts and (_COEFFICIENTS.match(name) or _MATRIX.match(name) or name in _GROUPS or _is_model(name)):
                self._add(value)
            else:
                self.items.append((name, str(key), value))

    def take(self, pattern: re.Pattern) -> Any:
        """The value under a name of this kind; None where there is none, or nothing in it.

        Raises ValueError where two of them differ.
        """
        found = [(key, value) for name, key, value in self.items if pattern.match(name)]
        self.read.update(key for key, _ in found)
        found = [(key, value) for key, value in found if value is not None]
        for key, value in found[1:]:
            if not _agree(value, found[0][1]):
                raise ValueError(f"{found[0][0]} and {key} say different things; keep the one that is right")
        return found[0][1] if found else None

    def rest(self) -> Iterator[tuple[str, str, Any]]:
        """What nobody asked for."""
        return (item for item in self.items if item[1] not in self.read)


def _agree(one: Any, other: Any) -> bool:
    """Whether two values say the same: a matrix may be a list of rows, of numbers, or a dictionary with data."""
    lists = [value.get("data") if isinstance(value, dict) else value for value in (one, other)]
    if all(isinstance(value, list) for value in lists):
        try:
            lists = [np.asarray(value, np.float64).ravel().tolist() for value in lists]
        except (TypeError, ValueError, OverflowError):
            return one == other
        return lists[0] == lists[1]
    return one == other


_GROUPS = {
    "info",
    "image",
    "projectionparameters",
    "parameters",
    "params",
    "calibration",
    "focallength",
    "principalpoint",
}


def _is_model(name: str) -> bool:
    return bool(_MODEL.match(name) or _LOOSE_MODEL.match(name))


def _find(entry: dict) -> _Fields | None:
    """The entries of the one camera in nested dictionaries, with those around it; None where there is none."""
    fields = _Fields(entry)
    if any(_FX.match(name) or _MATRIX.match(name) for name, _, _ in fields.items):
        return fields
    inner: list[tuple[str, dict, _Fields]] = []
    for key, value in entry.items():
        values = value if isinstance(value, list) else [value]
        for item in values[:1000]:
            if isinstance(item, dict) and item:
                found = _find(item)
                if found is not None:
                    inner.append((str(key), item, found))
    if len(inner) > 1:
        coloured = [item for item in inner if re.search(r"colou?r|rgb", item[0].lower())]
        if len(coloured) != 1:
            raise ValueError(
                f"it holds several cameras ({_some([key for key, _, _ in inner])}); keep that of the image"
            )
        inner = coloured
    if not inner:
        return None
    _, _, found = inner[0]
    known = {name for name, _, _ in found.items}
    found.items += [item for item in fields.items if item[0] not in known]
    return found


def _from_fields(fields: _Fields) -> Intrinsics:
    matrix = _read_matrix(fields)
    lens, coefficients = _read_lens(fields)
    size = _read_size(fields, matrix)
    scale = fields.take(re.compile(r"^depthscale$"))
    skew = fields.take(re.compile(r"^skew$"))
    if skew is not None:
        matrix[0, 1] = matrix[0, 1] or _number(skew, "the skew")
    camera = Intrinsics(
        matrix,
        distortion=coefficients,
        lens=lens,
        size=size,
        depth_scale=None if scale is None else _number(scale, "the depth scale") * 1e-3,
    )
    return _cut_and_binned(camera, fields)


def _read_matrix(fields: _Fields) -> np.ndarray:
    numbers = [fields.take(pattern) for pattern in (_FX, _FY, _CX, _CY)]
    by_columns = any(name == "intrinsicmatrix" for name, _, _ in fields.items)
    given = fields.take(_MATRIX)
    matrix = None
    if given is not None:
        if isinstance(given, dict):
            given = given.get("data", ())
        array = _numbers(given, "the camera matrix")
        matrix = _matrix_from(array)
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
        other = _matrix_of(*(_number(number, "fx, fy, cx, cy") for number in numbers))
        if matrix is not None and not np.allclose(matrix, other, rtol=1e-4, atol=0.01):
            raise ValueError("the camera matrix and fx, fy, cx, cy say different things; keep what is right")
        return other
    assert matrix is not None
    return matrix


def _read_lens(fields: _Fields) -> tuple[str, tuple[float, ...]]:
    """The name of the lens model, and its coefficients in OpenCV's order."""
    vector = fields.take(_COEFFICIENTS)
    if isinstance(vector, dict):
        vector = vector.get("data", ())
    if isinstance(vector, str) and _LENS_ALIASES.get(_word(vector)) in ("none", "pinhole"):
        vector = None
    array = np.zeros(0) if vector is None or vector is False else _numbers(vector, "the distortion").reshape(-1)

    models: dict[str, str] = {}  # as OpenCV calls it: as it is spelled
    for name, key, value in fields.items:
        loose = bool(_LOOSE_MODEL.match(name))
        if not loose and not _MODEL.match(name):
            continue
        fields.read.add(key)
        if not isinstance(value, str):
            continue
        word = _word(value)
        if loose and word not in _LENS_ALIASES and not _LENS_WORDS.search(word):
            continue  # the name of a device
        models[_LENS_ALIASES.get(word, word)] = value
    more = {kind: value for kind, value in models.items() if kind != "pinhole"}
    if len(more) > 1:
        raise ValueError(f"the lens models {' and '.join(map(repr, more.values()))} exclude each other")
    lens = next(iter(more.values()), "opencv")

    scalars = {}
    for name in _SCALARS:
        value = fields.take(re.compile(f"^{name}$"))
        if isinstance(value, list | dict):  # KITTI's P1 and P2 are matrices
            continue
        scalars[name] = 0.0 if value is None else _number(value, name)
    if any(scalars.values()):
        if array.any():
            raise ValueError("the distortion is given twice, as a list and as k1, k2 …; keep one")
        fishy = next(iter(more), "") == "equidistant"
        if fishy:
            if any(value for name, value in scalars.items() if name not in ("k1", "k2", "k3", "k4")):
                raise ValueError(f"the lens model {lens!r} has the coefficients k1 to k4 only")
            array = np.array([scalars[f"k{i}"] for i in range(1, 5)])
        else:
            if not more and scalars["k4"] and not any(scalars[name] for name in ("p1", "p2", "k5", "k6")):
                raise ValueError("k1 to k4 without a lens model may be a fisheye's; add distortion_model")
            array = np.array([scalars[name] for name in _SCALARS])
            counts = [n for n in (4, 5, 8, 12, 14) if not array[n:].any()]
            array = array[: counts[0]]
    elif not array.size and next(iter(more), "") == "equidistant" and _names_scalars(fields):
        array = np.zeros(4)

    for name, key, value in fields.rest():
        if _ABOUT_LENSES.search(name) and _says_something(value):
            raise ValueError(f"{key} looks like part of a lens that is not understood; undistort the images first")
    return lens, tuple(float(c) for c in array)


def _names_scalars(fields: _Fields) -> bool:
    names = {name for name, _, _ in fields.items}
    return {"k1", "k2", "k3", "k4"} <= names


def _says_something(value: Any) -> bool:
    """Whether there is a number other than zero, or the name of a lens, in what a file says."""
    if isinstance(value, dict):
        return any(_says_something(item) for key, item in value.items() if str(key).lower() not in ("rows", "cols"))
    if isinstance(value, list):
        return any(map(_says_something, value))
    if isinstance(value, str):
        try:
            return float(value) != 0
        except ValueError:
            return _LENS_WORDS.search(_word(value)) is not None
    return isinstance(value, int | float) and not isinstance(value, bool) and value != 0


def _read_size(fields: _Fields, matrix: np.ndarray) -> tuple[int, int] | None:
    sizes = []
    width, height = fields.take(_WIDTH), fields.take(_HEIGHT)
    if width is not None and height is not None:
        sizes.append((width, height))
    for pattern in (_SIZE, _SHAPE):
        pair = fields.take(pattern)
        if isinstance(pair, str):
            pair = re.findall(r"\d+", pair)
        if isinstance(pair, dict):
            inner = _Fields(pair)
            pair = [inner.take(_WIDTH), inner.take(_HEIGHT)]
        if isinstance(pair, list) and len(pair) >= 2 and None not in pair[:2]:
            pair = pair[:2]
            if pattern is _SHAPE or _is_height_first(pair, matrix):
                pair = pair[::-1]
            sizes.append(tuple(pair))
    known = []
    for pair in sizes:
        size = _numbers(list(pair), "the image size").reshape(-1)
        if size.size == 2 and np.isfinite(size).all() and (size >= 1).all():  # ROS drivers leave 0 × 0 if unknown
            known.append((int(size[0]), int(size[1])))
    if len(set(known)) > 1:
        raise ValueError(f"it names two image sizes, {known[0][0]} × {known[0][1]} and {known[1][0]} × {known[1][1]}")
    return known[0] if known else None


def _is_height_first(pair: list, matrix: np.ndarray) -> bool:
    """Whether two numbers of a list are height and width, as arrays have them: the principal point is in the middle."""
    size = _numbers(pair, "the image size").reshape(-1)
    if size.size != 2 or not (size > 0).all():
        return False
    as_listed, turned = (np.abs(matrix[:2, 2] / order - 0.5).max() for order in (size, size[::-1]))
    return bool(turned < 0.06 < as_listed)


def _cut_and_binned(camera: Intrinsics, fields: _Fields) -> Intrinsics:
    """ROS says K of the whole sensor: the images are a part of it (roi), with pixels joined (binning).

    http://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html
    """
    matrix, size = camera.matrix, camera.size
    roi = fields.take(re.compile(r"^roi$"))
    if isinstance(roi, dict):
        left, top, width, height = (
            _number(roi.get(name) or 0, "the region of interest")
            for name in ("x_offset", "y_offset", "width", "height")
        )
        if width > 0 and height > 0:
            matrix = crop(matrix, (left, top))
            size = (int(width), int(height))
        elif left or top:
            raise ValueError("the region of interest has an offset, but no size")
    elif roi is not None and _says_something(roi):
        raise ValueError("roi is not understood; x_offset, y_offset, width and height are expected")
    joined = []
    for name in ("binningx", "binningy"):
        value = fields.take(re.compile(f"^{name}$"))
        joined.append(max(1.0, 1.0 if value is None else _number(value, "the binning")))  # 0 is said for 1, too
    if size is not None:
        size = (int(size[0] // joined[0]), int(size[1] // joined[1]))
    return replace(camera, matrix=resize(matrix, (joined[0], joined[1]), (1, 1)), size=size)


def _number(value: Any, what: str) -> float:
    array = _numbers(value, what)
    if array.size != 1:
        raise ValueError(f"{what} must be one number, not {array.size}")
    return float(array.reshape(()))


def _numbers(value: Any, what: str) -> np.ndarray:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be numbers") from None


def _some(items: list) -> str:
    shown = ", ".join(str(item) for item in items[:6])
    return shown + (" …" if len(items) > 6 else "")
