"""Lens models: those that OpenCV can undistort, their names elsewhere, and how files spell their coefficients.

An entry that seems to describe a lens and is not understood is refused: ignoring a lens would move every pose silently.
"""

import re
from typing import Any

import numpy as np

from ipjax.files.cameras.fields import COEFFICIENTS, MODEL, MODEL_OR_DEVICE, Fields, as_number, as_numbers

# The lens models that OpenCV can undistort, and how many coefficients they have.
MODELS = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8, 12, 14),
    "equidistant": (4,),
    "opencv": (0, 4, 5, 8, 12, 14),
}
# Names of the same models elsewhere, in lower-case letters and digits. "pinhole" names the projection and leaves the
# distortion open; "none" excludes it.
ALIASES = {
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
PINHOLE_WHERE_ZERO = {"inversebrownconrady", "modifiedbrownconrady", "division", "simpleradial", "radial", "polynomial"}
# What a word about the camera must hold to be a lens model, not the name of a device.
WORDS_OF_LENSES = re.compile(
    r"fish|kannala|equi|omni|fov|theta|unified|ucm|^mei|sphere|spheric|division|polynom|inverse|brown|conrady|rational|"
    r"radtan|radial|tangent|prism|panoram|cylind|orthograph|624|distort"
)
COEFFICIENT_NAMES = (
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "k5",
    "k6",
    "s1",
    "s2",
    "s3",
    "s4",
    "taux",
    "tauy",
)  # OpenCV's order
ABOUT_LENSES = re.compile(
    r"^([kpsb][1-9]\d?|tau[xy]|cod[xy]|xi|omega|alphac|skew|shear)$"
    r"|dist(or|o$|co|par|vec|$)|coeff|^lens|radial|tangential|fisheye|projectionparam|modelparam"
)


def check_lens(lens: str, coefficients: Any) -> tuple[str, tuple[float, ...]]:
    """The model as OpenCV has it, and as many coefficients as it takes; () = a pinhole."""
    given = tuple(float(c) for c in coefficients)
    if not np.isfinite(given).all():
        raise ValueError("the distortion coefficients are not all finite")
    word = simplify_name(str(lens))
    name = ALIASES.get(word)
    if name is None:
        if word in PINHOLE_WHERE_ZERO and not any(given):
            return "opencv", ()
        known = ", ".join(MODELS)
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
    for count in reversed(MODELS[name]):
        if needed <= count <= len(given):
            return name, given[:count]
    raise ValueError(f"{len(given)} distortion coefficients do not fit the lens model {name}")


def simplify_name(text: str) -> str:
    """A name in lower-case letters and digits, without what libraries put before it."""
    text = re.sub(r"^.*[.:](?=.)", "", text.strip().lower())
    return re.sub(r"^rs2distortion", "", re.sub(r"[^a-z0-9]", "", text))


def read_lens(fields: Fields) -> tuple[str, tuple[float, ...]]:
    """The name of the lens model, and its coefficients in OpenCV's order."""
    vector = fields.take(COEFFICIENTS)
    if isinstance(vector, dict):
        vector = vector.get("data", ())
    if isinstance(vector, str) and ALIASES.get(simplify_name(vector)) in ("none", "pinhole"):
        vector = None
    array = np.zeros(0) if vector is None or vector is False else as_numbers(vector, "the distortion").reshape(-1)

    models: dict[str, str] = {}  # as OpenCV calls it: as it is spelled
    for name, key, value in fields.items:
        loose = bool(MODEL_OR_DEVICE.match(name))
        if not loose and not MODEL.match(name):
            continue
        fields.taken.add(key)
        if not isinstance(value, str):
            continue
        word = simplify_name(value)
        if loose and word not in ALIASES and not WORDS_OF_LENSES.search(word):
            continue  # the name of a device
        models[ALIASES.get(word, word)] = value
    more = {kind: value for kind, value in models.items() if kind != "pinhole"}
    if len(more) > 1:
        raise ValueError(f"the lens models {' and '.join(map(repr, more.values()))} exclude each other")
    lens = next(iter(more.values()), "opencv")

    scalars = {}
    for name in COEFFICIENT_NAMES:
        value = fields.take(re.compile(f"^{name}$"))
        if isinstance(value, list | dict):  # KITTI's P1 and P2 are matrices
            continue
        scalars[name] = 0.0 if value is None else as_number(value, name)
    if any(scalars.values()):
        if array.any():
            raise ValueError("the distortion is given twice, as a list and as k1, k2 …; keep one")
        is_fisheye = next(iter(more), "") == "equidistant"
        if is_fisheye:
            if any(value for name, value in scalars.items() if name not in ("k1", "k2", "k3", "k4")):
                raise ValueError(f"the lens model {lens!r} has the coefficients k1 to k4 only")
            array = np.array([scalars[f"k{i}"] for i in range(1, 5)])
        else:
            if not more and scalars["k4"] and not any(scalars[name] for name in ("p1", "p2", "k5", "k6")):
                raise ValueError("k1 to k4 without a lens model may be a fisheye's; add distortion_model")
            array = np.array([scalars[name] for name in COEFFICIENT_NAMES])
            counts = [n for n in (4, 5, 8, 12, 14) if not array[n:].any()]
            array = array[: counts[0]]
    elif not array.size and next(iter(more), "") == "equidistant" and _names_four_coefficients(fields):
        array = np.zeros(4)

    for name, key, value in fields.rest():
        if ABOUT_LENSES.search(name) and is_nonzero(value):
            raise ValueError(f"{key} looks like part of a lens that is not understood; undistort the images first")
    return lens, tuple(float(c) for c in array)


def _names_four_coefficients(fields: Fields) -> bool:
    names = {name for name, _, _ in fields.items}
    return {"k1", "k2", "k3", "k4"} <= names


def is_nonzero(value: Any) -> bool:
    """Whether a value of a camera file holds a number other than zero, or the name of a lens."""
    if isinstance(value, dict):
        return any(is_nonzero(item) for key, item in value.items() if str(key).lower() not in ("rows", "cols"))
    if isinstance(value, list):
        return any(map(is_nonzero, value))
    if isinstance(value, str):
        try:
            return float(value) != 0
        except ValueError:
            return WORDS_OF_LENSES.search(simplify_name(value)) is not None
    return isinstance(value, int | float) and not isinstance(value, bool) and value != 0
