"""The entries of a camera file by name in any spelling: case, punctuation and prefixes such as ``camera``, ``image``
and ``rgb`` are ignored.
"""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from ipjax.files.wording import abbreviate

PREFIX = re.compile(r"^(camera|cam|colou?r|rgb|image|img|im(?=size|shape|width|height)|frame)(?=.)")
MATRIX = re.compile(r"^(k|matrix|kmatrix|matrixk|intrinsics?(matrix|parameters)?|calibrationmatrix)$")
FX, FY, CX, CY = (
    re.compile(pattern)
    for pattern in (
        r"^(fx|flx|focal(length)?x)$",
        r"^(fy|fly|focal(length)?y)$",
        r"^(cx|ppx|u0|principal(point)?x|cent(re|er)x)$",
        r"^(cy|ppy|v0|principal(point)?y|cent(re|er)y)$",
    )
)
WIDTH = re.compile(
    r"^(px|pixels?|res|resolution|size)?(w|width|cols|columns)(px|pixels?)?$|^(res|resolution|size)x$|^x(res|resolution)$"
)
HEIGHT = re.compile(
    r"^(px|pixels?|res|resolution|size)?(h|height|rows)(px|pixels?)?$|^(res|resolution|size)y$|^y(res|resolution)$"
)
SIZE = re.compile(r"^(size|sizewh|resolution|res|dims?|dimensions?|widthheight|wh)(px|pixels?)?$")
SHAPE = re.compile(r"^(shape|heightwidth|hw)$")  # height first
COEFFICIENTS = re.compile(
    r"^(lens)?(d|dist|disto|distort|distortions?)(coefficients?|coeffs?|coefs?|params?|parameters?|vector|vec)?$"
    r"|^(coefficients?|coeffs?|coefs?|kc)$"
)
MODEL = re.compile(r"^(dist(ortion)?(model|type|name)|projection(model|type|modeltype)?)$")
MODEL_OR_DEVICE = re.compile(r"^(lens|lens(model|type)|model|type|modeltype|modelname)$")  # or the name of a device
# Nested dictionaries whose members are read as if they stood in the camera itself.
GROUPS = {
    "info",
    "image",
    "projectionparameters",
    "parameters",
    "params",
    "calibration",
    "focallength",
    "principalpoint",
}


class Fields:
    """The entries of a camera by their names without case, punctuation and prefix; knows which were read."""

    def __init__(self, entry: dict):
        self.items: list[tuple[str, str, Any]] = []  # name, as spelled, value
        self.taken: set[str] = set()
        self._add(entry)

    def _add(self, entry: dict) -> None:
        for key, value in entry.items():
            name = re.sub(r"[^a-z0-9]", "", str(key).lower())
            name = PREFIX.sub("", name)
            parts = isinstance(value, dict) and "data" not in value
            # Members of a dictionary of coefficients, focal lengths or the model are entries of the camera.
            if parts and (COEFFICIENTS.match(name) or MATRIX.match(name) or name in GROUPS or _names_a_model(name)):
                self._add(value)
            else:
                self.items.append((name, str(key), value))

    def take(self, pattern: re.Pattern) -> Any:
        """The value under a name of this kind; None where there is none, or nothing in it.

        Raises ValueError where two of them differ.
        """
        found = [(key, value) for name, key, value in self.items if pattern.match(name)]
        self.taken.update(key for key, _ in found)
        found = [(key, value) for key, value in found if value is not None]
        for key, value in found[1:]:
            if not _agree(value, found[0][1]):
                raise ValueError(f"{found[0][0]} and {key} say different things; keep the one that is right")
        return found[0][1] if found else None

    def rest(self) -> Iterator[tuple[str, str, Any]]:
        """The entries that `take` did not find."""
        return (item for item in self.items if item[1] not in self.taken)


def _agree(one: Any, other: Any) -> bool:
    """Whether two values are equal: a matrix may be a list of rows, of numbers, or a dictionary with data."""
    lists = [value.get("data") if isinstance(value, dict) else value for value in (one, other)]
    if all(isinstance(value, list) for value in lists):
        try:
            lists = [np.asarray(value, np.float64).ravel().tolist() for value in lists]
        except (TypeError, ValueError, OverflowError):
            return one == other
        return lists[0] == lists[1]
    return one == other


def _names_a_model(name: str) -> bool:
    return bool(MODEL.match(name) or MODEL_OR_DEVICE.match(name))


def find_camera(entry: dict) -> Fields | None:
    """The entries of the one camera in nested dictionaries, with those around it; None where there is none."""
    fields = Fields(entry)
    if any(FX.match(name) or MATRIX.match(name) for name, _, _ in fields.items):
        return fields
    inner: list[tuple[str, dict, Fields]] = []
    for key, value in entry.items():
        values = value if isinstance(value, list) else [value]
        for item in values[:1000]:
            if isinstance(item, dict) and item:
                found = find_camera(item)
                if found is not None:
                    inner.append((str(key), item, found))
    if len(inner) > 1:
        coloured = [item for item in inner if re.search(r"colou?r|rgb", item[0].lower())]
        if len(coloured) != 1:
            raise ValueError(
                f"it holds several cameras ({abbreviate([key for key, _, _ in inner], 6)}); keep that of the image"
            )
        inner = coloured
    if not inner:
        return None
    _, _, found = inner[0]
    known = {name for name, _, _ in found.items}
    found.items += [item for item in fields.items if item[0] not in known]
    return found


def as_number(value: Any, what: str) -> float:
    """One number. Raises ValueError that begins with ``what``."""
    array = as_numbers(value, what)
    if array.size != 1:
        raise ValueError(f"{what} must be one number, not {array.size}")
    return float(array.reshape(()))


def as_numbers(value: Any, what: str) -> np.ndarray:
    """An array of float64. Raises ValueError that begins with ``what``."""
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be numbers") from None
