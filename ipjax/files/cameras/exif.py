"""The focal length of a photo as the camera wrote it into the file's EXIF.

Tags, units and their meaning: Exif 2.32 (CIPA DC-008). What camera makers write is not always so: values that no lens
has are ignored, and so is a lens whose image was cropped since.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm, of 35 mm film
DEVIATION = 0.05  # relative standard deviation: whole millimetres, focusing, the diagonal taken for the width
UNUSUAL_DEVIATION = 0.1  # of pictures whose sides are not as a sensor's: cut by the camera, or by hand
SIDES = (4 / 3, 3 / 2)  # of sensors, the longer over the shorter
# Focal lengths that are believed, in longer sides of the picture: 130° to 4° across it.
BELIEVED = (0.23, 14.0)

_FOCAL, _FOCAL_ON_FILM = 0x920A, 0xA405  # mm
_WIDTH, _HEIGHT = 0xA002, 0xA003  # pixels, as the camera made them
_PLANE_X, _PLANE_Y, _PLANE_UNIT = 0xA20E, 0xA20F, 0xA210  # pixels per unit
_ZOOM = 0xA404
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}


@dataclasses.dataclass(frozen=True)
class ExifFocal:
    """What EXIF tells of a photo's focal length.

    Args:
        pixels: of the file's image in its full size; None = nothing that can be used.
        deviation: relative standard deviation of it.
        note: a sentence: what it rests on, or why it was not used; empty where EXIF is silent.
    """

    pixels: float | None = None
    deviation: float = 0.0
    note: str = ""


def find_focal(tags: Mapping[int, Any], size: tuple[int, int]) -> ExifFocal:
    """The focal length by the tags of a photo's EXIF.

    Args:
        tags: EXIF's values by their numbers, any of them missing or absurd.
        size: width and height of the file's image, either way up.
    """
    on_film, focal = _positive(tags, _FOCAL_ON_FILM), _positive(tags, _FOCAL)
    density = _positive(tags, _PLANE_X)
    unit = _MILLIMETRES.get(int(_positive(tags, _PLANE_UNIT) or 2))
    longer, shorter = max(size), min(size)
    wide, high = _positive(tags, _WIDTH), _positive(tags, _HEIGHT)
    made = (longer, shorter) if wide is None or high is None else (max(wide, high), min(wide, high))
    if not (on_film or (focal and density and unit)):
        silent = not any(name in tags for name in (_FOCAL, _FOCAL_ON_FILM))
        return ExifFocal(note="" if silent else "EXIF tells no focal length that can be had in pixels")
    if abs(made[0] / made[1] * shorter / longer - 1) > 0.01 + 1 / shorter:  # more than rounding and a few lines
        return ExifFocal(
            note=f"EXIF's focal length was not used: it is of an image of {made[0]:.0f} × {made[1]:.0f} pixels, "
            f"of which this one ({longer} × {shorter}) is a part"
        )
    usual = min(abs(longer / shorter - side) for side in SIDES) < 0.02
    ways = []
    if on_film:
        ways.append((on_film / FILM_DIAGONAL * math.hypot(*size), f"{on_film:g} mm on 35 mm film"))
    # What a digital zoom does to the pixels per millimetre, cameras do not agree about.
    if focal and density and unit and (_positive(tags, _ZOOM) or 1.0) < 1.01 and _is_square(tags):
        ways.append((focal * density / unit * longer / made[0], f"{focal:g} mm and its pixels per millimetre"))
    for pixels, words in ways:
        if BELIEVED[0] * longer <= pixels <= BELIEVED[1] * longer:
            reduced = f", of a photo of {made[0]:.0f} × {made[1]:.0f} pixels" if made[0] != longer else ""
            return ExifFocal(
                pixels,
                DEVIATION if usual else UNUSUAL_DEVIATION,
                f"EXIF tells a focal length of {words}{reduced}: {pixels:.0f} px of the file",
            )
    told = f"{ways[0][1]} would be {ways[0][0]:.0f} px" if ways else "no pixels per millimetre fit it"
    return ExifFocal(note=f"EXIF's focal length was not used: {told}, which no usual lens has")


def _positive(tags: Mapping[int, Any], name: int) -> float | None:
    """A tag's number, where it is one, finite and positive (EXIF's 0 is "unknown"; a fraction over 0 is anything)."""
    try:
        value = float(tags[name])
    except Exception:  # missing, text, several values, a broken fraction
        return None
    return value if math.isfinite(value) and value > 0 else None


def _is_square(tags: Mapping[int, Any]) -> bool:
    """Whether the focal plane's pixels are as wide as high, as far as EXIF tells."""
    wide, high = _positive(tags, _PLANE_X), _positive(tags, _PLANE_Y)
    return wide is None or high is None or abs(wide / high - 1) < 0.1
