"""Opening images: formats, budgets and orientation.

Every reader raises one sentence of `ValueError` that names the file, and none takes more memory than
`ipjax.files.storage.budget` allows.
"""

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from ipjax.files.storage.budget import check_budget

BYTES_PER_PIXEL = 12  # of memory while an image is decoded, converted and copied
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM")  # Pillow knows more, some of which run programs
ORIENTATION = 0x0112  # EXIF
_ORIENTATION_KEPT = "ipjax orientation"  # among what Pillow knows of an image
_TAGS_KEPT = "ipjax exif"
_EXIF = 0x8769  # where the photo's own tags stand


def read_rgb(path: str | Path, content: bytes | None = None) -> np.ndarray:
    """A colour image as uint8, height × width × 3, as it is stored; transparency dropped.

    Args:
        path: of the file.
        content: of the file, where it lies in another, such as an archive; ``path`` is then its name in messages.

    Raises:
        ValueError: missing, unreadable, absurd, or to be turned according to its EXIF orientation; names the file.
    """
    image = open_image(path, content=content)
    check_upright(get_orientation(image), path)
    if image.mode.startswith("I") or image.mode == "F":
        raise ValueError(f"{path}: a one-channel image of more than 8 bits is no colour image; is this the depth?")
    return np.array(image.convert("RGB"))


def read_size(path: str | Path) -> tuple[int, int]:
    """(width, height) of an image, from its header.

    Raises:
        ValueError: missing or no image; names the file.
    """
    return open_image(path, load=False).size


def open_image(
    path: str | Path, *, load: bool = True, max_side: int | None = None, content: bytes | None = None
) -> Image.Image:
    """An image of one of the usual formats, decoded if its header promises no more pixels than memory allows.

    Args:
        path: PNG, JPEG, TIFF, BMP, WebP, GIF or PPM.
        load: decode it, too.
        max_side: a JPEG with a longer side may be decoded at a fraction of its size, not below this one.
        content: as in `read_rgb`.

    Raises:
        ValueError: missing, none of these, broken or too large; names the file.
    """
    path = Path(path)
    if content is None and not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with warnings.catch_warnings(), path.open("rb") if content is None else io.BytesIO(content) as file:
            warnings.simplefilter("ignore")
            image = Image.open(file, formats=FORMATS)
            if not load:
                return image
            width, height = image.size
            needed = 0
            if max_side is not None and image.format in ("JPEG", "MPO") and max(image.size) > max_side:
                # A progressive JPEG is decoded as a whole, whatever size is asked for.
                needed = 6 * width * height if image.info.get("progressive") else 0
                image.draft(None, (max_side, max_side))
            needed += BYTES_PER_PIXEL * image.size[0] * image.size[1]
            check_budget(needed, f"an image of {width} × {height} pixels")
            turn, tags = get_orientation(image), _read_tags(image)
            image.load()  # Pillow turns a TIFF by its orientation here, and drops the orientation
            image.info |= {_ORIENTATION_KEPT: turn, _TAGS_KEPT: tags}
    except UnidentifiedImageError:
        raise ValueError(f"{path}: not an image") from None
    except Image.DecompressionBombError:
        raise ValueError(f"{path}: more than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels; reduce it") from None
    except MemoryError:
        raise ValueError(f"{path}: out of memory") from None
    except Exception as error:  # decoders of many formats fail in many ways
        lines = str(error).strip().splitlines() or [type(error).__name__]
        known = isinstance(error, ValueError) and "allowed for one file" in lines[0]
        raise ValueError(f"{path}: {lines[0]}" if known else f"{path}: broken image ({lines[0]})") from None
    return image


def get_orientation(image: Image.Image) -> int:
    """The EXIF orientation of an image, 1 (upright) to 8; 1 where it has none."""
    if image.info.get(_ORIENTATION_KEPT, 1) != 1:
        return image.info[_ORIENTATION_KEPT]
    try:
        turn = image.getexif().get(ORIENTATION, 1)
    except Exception:  # a broken block of EXIF raises many kinds
        return 1
    return turn if isinstance(turn, int) and 1 <= turn <= 8 else 1


def get_tags(image: Image.Image) -> dict[int, Any]:
    """EXIF of an image that `open_image` decoded, by the numbers of its tags; empty where it is broken."""
    return image.info.get(_TAGS_KEPT, {})


def _read_tags(image: Image.Image) -> dict[int, Any]:
    try:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(_EXIF)}
    except Exception:  # a broken block of EXIF raises many kinds
        return {}


def check_upright(turn: int, path: str | Path) -> None:
    """Refuse an EXIF orientation other than upright. Raises ValueError that names the file."""
    if 2 <= turn <= 8:
        raise ValueError(
            f"{path}: its EXIF orientation ({turn}) says that it is to be shown turned, which depth, mask and camera "
            "know nothing of; save it without, all of them the same way up"
        )


def undo_stretching(image: Image.Image, path: Path) -> np.ndarray:
    """The numbers of a decoded image as its file has them: Pillow stretches those of a PGM to all of 8 or 16 bits."""
    values = np.array(image)
    if image.format != "PPM" or image.mode not in ("L", "I"):
        return values
    with path.open("rb") as file:
        words = re.sub(rb"#[^\r\n]*", b" ", file.read(65536)).split(None, 4)
    full = 255 if image.mode == "L" else 65535
    if words[0] not in (b"P2", b"P5") or int(words[3]) == full:
        return values
    return np.round(values * (int(words[3]) / full)).astype(values.dtype)
