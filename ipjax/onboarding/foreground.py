"""The object in a photo: reading any photo, finding the mask, cutting it out as the reconstruction model was trained.

A mask comes from, in this order: the caller; the photo's alpha channel; GrabCut from a box or a click; a background of
one colour; an installed matting package whose model is here. Where none works, `find_foreground` refuses with one
sentence, and leaves a picture of what it tried.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageOps

from ipjax.cameras import mask_from_coverage, resize_pixels
from ipjax.files.cameras.exif import ExifFocal, find_focal
from ipjax.files.images.masks import as_mask
from ipjax.files.images.opening import get_orientation, get_tags, open_image, read_size
from ipjax.files.storage.writing import writing
from ipjax.onboarding.matting import MattingError, find_matting, matte

MAX_SIDE = 2048  # pixels; larger photos are reduced
MIN_SIDE = 16  # pixels of the object's longer side
_WORK = 512  # pixels; GrabCut and the background model run at this size


class ForegroundError(ValueError):
    """No usable object in the photo; the message is one sentence for the user."""


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photo as bytes, whatever its file was."""

    rgb: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"] | None = None  # None = opaque
    scale: float = 1.0  # pixels of this image per pixel of the file's upright image
    notes: tuple[str, ...] = ()
    orientation: int = 1  # as EXIF said that the file's pixels are to be turned; done here
    full_size: tuple[int, int] | None = None  # width and height of the file's upright image; None = by the scale
    focal: ExifFocal | None = None  # as EXIF tells it; None = no file


@dataclasses.dataclass(frozen=True)
class Foreground:
    """The photo with the object's mask."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    alpha: UInt8[np.ndarray, "h w"]  # soft edge where the photo had one, else 0 and 255
    method: str  # given, alpha, grabcut, background or matting
    notes: tuple[str, ...] = ()


# --- reading ----------------------------------------------------------------------------------------------------------


def read_photo(path: str | Path, *, max_side: int = MAX_SIDE) -> Photo:
    """Any photo as 8-bit sRGB: upright (EXIF), CMYK, palette, grey and 16-bit converted, huge ones reduced.

    Raises ValueError in one sentence that names the file: missing, no image, broken, or float.
    """
    full = read_size(path)
    image = open_image(path, max_side=2 * max_side)  # a JPEG at a fraction: memory and time
    orientation = get_orientation(image)
    try:
        upright = ImageOps.exif_transpose(image)
        if (full[0] - full[1]) * (upright.width - upright.height) < 0:  # turned by a quarter
            full = full[1], full[0]
        photo = _from_image(upright, full, max_side)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return dataclasses.replace(photo, orientation=orientation, focal=find_focal(get_tags(image), full))


def _from_image(image: Image.Image, full: tuple[int, int], max_side: int) -> Photo:
    notes: list[str] = []
    mode = image.mode
    if mode == "F":
        raise ValueError("a photo of floating-point numbers has no known white; save it with 8 or 16 bits")
    if mode.startswith("I"):
        grey = np.asarray(image).astype(np.int64)
        if grey.min() < 0 or grey.max() > 65535:
            raise ValueError("a photo of 32-bit numbers has no known white; save it with 8 or 16 bits")
        image = Image.fromarray((grey >> 8).astype(np.uint8) if grey.max() > 255 else grey.astype(np.uint8))
        notes.append("16-bit grey was reduced to 8 bits")
    transparent = mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    if transparent:
        image = image.convert("RGBA")
    else:
        if mode in ("CMYK", "LAB", "YCbCr", "HSV", "P"):
            notes.append(f"{mode} colours were converted to RGB")
        image = image.convert("RGB")
    longest = max(image.size)
    if longest > max_side:
        wide, tall = (max(1, round(side * max_side / longest)) for side in image.size)
        # Junk colours under transparent pixels must not bleed into the object: PIL premultiplies only by hand.
        image = (
            image.convert("RGBa").resize((wide, tall), Image.Resampling.LANCZOS).convert("RGBA")
            if transparent
            else (image.resize((wide, tall), Image.Resampling.LANCZOS))
        )
    scale = max(image.size) / max(full)
    if scale < 0.999:
        notes.append(f"the photo was reduced to {image.size[0]} × {image.size[1]} pixels ({scale:.2f} of its size)")
    pixels = np.array(image)
    if pixels.shape[-1] == 4 and pixels[..., 3].min() < 255:
        return Photo(pixels[..., :3].copy(), pixels[..., 3].copy(), scale, tuple(notes), full_size=full)
    return Photo(pixels[..., :3].copy(), None, scale, tuple(notes), full_size=full)


# --- finding ----------------------------------------------------------------------------------------------------------


def find_foreground(
    photo: Photo,
    *,
    mask: np.ndarray | None = None,
    box: Sequence[int | float] | None = None,
    click: Sequence[int | float] | None = None,
    tried: str | Path | None = None,
) -> Foreground:
    """The object's mask.

    Args:
        mask: height × width as the photo, or as its file before it was reduced; wins over all else.
        box: left, top, right, bottom around the object, in pixels of the photo's file.
        click: (x, y) on the object, likewise.
        tried: where to write a picture of what was tried when no mask is found.

    Raises ForegroundError in one sentence: blank or transparent photo, no mask found, object too small, mask over the
    whole photo or touching all four borders.
    """
    attempts: list[tuple[str, np.ndarray]] = []
    try:
        return _find(photo, mask, box, click, attempts)
    except ForegroundError as error:
        if tried is None:
            raise
        draw_attempts(photo, attempts, tried)
        raise ForegroundError(f"{error} (what was tried: {tried})") from None


def _find(photo, mask, box, click, attempts) -> Foreground:
    rgb, alpha = photo.rgb, photo.alpha
    height, width = rgb.shape[:2]
    if mask is not None:
        return _accept(photo, _fit_mask(mask, photo), "given", attempts)
    if alpha is not None:
        if alpha.max() < 128:
            attempts.append(("alpha", alpha > 127))
            raise ForegroundError("the photo is transparent everywhere: there is no object in it")
        return _accept(photo, alpha > 127, "alpha", attempts)
    if int(np.ptp(rgb.reshape(-1, 3), axis=0).max()) < 8:
        raise ForegroundError("the photo is blank: all its pixels have the same colour")
    if box is not None:
        left, top, right, bottom = np.asarray(box, float) * photo.scale
        left, right = np.clip([left, right], 0, width)
        top, bottom = np.clip([top, bottom], 0, height)
        if right - left < 4 or bottom - top < 4:
            raise ForegroundError(
                f"the box {tuple(box)} does not enclose any part of the photo; give left, top, right, bottom"
            )
        return _accept(photo, _grabcut(rgb, box=(left, top, right, bottom)), "grabcut", attempts)
    if click is not None:
        x, y = resize_pixels(np.asarray(click, float), (1, 1), (photo.scale, photo.scale))
        if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
            raise ForegroundError(f"the click {tuple(click)} lies outside the photo")
        return _accept(photo, _grabcut(rgb, click=(x, y)), "grabcut", attempts)
    found, spread = _plain_background(rgb)
    if spread > 10.0:
        attempts.append(("other than the border", found))
        matting, without = find_matting()
        if matting is not None:
            try:
                found = matte(matting, rgb)
            except MattingError as error:
                raise ForegroundError(str(error)) from None
            return _accept(photo, found, "matting", attempts)
        raise ForegroundError(
            "no mask was given, the photo has no transparency, and its background is not plain: "
            f"give a mask, a box around the object, or a click on it{without}"
        )
    return _accept(photo, found, "background", attempts)


def _fit_mask(mask: np.ndarray, photo: Photo) -> np.ndarray:
    import cv2

    try:
        mask = as_mask(mask)
    except ValueError as error:
        raise ForegroundError(str(error)) from None
    height, width = photo.rgb.shape[:2]
    if mask.shape == (height, width):
        return mask
    fits = all(abs(m * photo.scale - p) <= 1.0 for m, p in zip(mask.shape, (height, width), strict=True))
    if photo.scale >= 0.999 or not fits:
        raise ForegroundError(
            f"the mask has {mask.shape[1]} × {mask.shape[0]} pixels and the photo {width} × {height}: "
            "they do not belong together"
        )
    return mask_from_coverage(cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA))


def _accept(photo: Photo, mask: np.ndarray, method: str, attempts: list) -> Foreground:
    """Check a mask and drop its specks."""
    import cv2

    attempts.append((method, mask))
    height, width = mask.shape
    if not mask.any():
        raise ForegroundError("the mask is empty: there is no object in the photo")
    if mask.all():
        raise ForegroundError("the mask covers the whole photo: nothing tells the object from its background")
    notes = list(photo.notes)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    keep = 1 + np.flatnonzero(areas >= 0.1 * areas.max())
    if len(keep) < count - 1:
        dropped = 1 - areas[keep - 1].sum() / areas.sum()
        mask = np.isin(labels, keep)
        if dropped > 0.005:
            notes.append(f"{count - 1 - len(keep)} specks of the mask ({dropped:.0%} of it) were dropped")
    if len(keep) > 1:
        notes.append(f"the mask has {len(keep)} separate parts; the object may be hidden in part")
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    tall, wide = np.ptp(rows) + 1, np.ptp(columns) + 1
    if max(tall, wide) < MIN_SIDE:
        raise ForegroundError(
            f"the object is only {wide} × {tall} pixels large; at least {MIN_SIDE} are needed on its longer side"
        )
    borders = {
        "top": rows[0] == 0,
        "bottom": rows[-1] == height - 1,
        "left": columns[0] == 0,
        "right": columns[-1] == width - 1,
    }
    touched = [name for name, hit in borders.items() if hit]
    if len(touched) == 4:
        raise ForegroundError(
            "the mask touches all four borders of the photo: "
            "either it marks the background, or the object is cut off all round"
        )
    if touched and method != "alpha":
        notes.append(f"the object touches the {' and '.join(touched)} border: it may be cut off there")
    notes.append(
        {
            "given": "the mask was given",
            "alpha": "the mask is the photo's transparency",
            "grabcut": "the mask was cut out by GrabCut from the box or click: the report shows how well",
            "background": "the mask is what differs from the plain background",
            "matting": "the mask was cut out by the package rembg: the report shows how well",
        }[method]
    )
    soft = photo.alpha if photo.alpha is not None and method == "alpha" else np.uint8(255) * mask.astype(np.uint8)
    soft = np.where(mask | (method == "alpha"), soft, 0).astype(np.uint8)
    return Foreground(photo.rgb, mask, soft, method, tuple(notes))


def _shrink(rgb: np.ndarray) -> tuple[np.ndarray, float]:
    import cv2

    factor = min(1.0, _WORK / max(rgb.shape[:2]))
    if factor == 1.0:
        return rgb, 1.0
    size = (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor)))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), factor


def _grow(mask: np.ndarray, like: np.ndarray) -> np.ndarray:
    import cv2

    height, width = like.shape[:2]
    return mask_from_coverage(cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR))


def _grabcut(rgb: np.ndarray, *, box=None, click=None) -> np.ndarray:
    """GrabCut (Rother et al., SIGGRAPH 2004) from a box, or from a disc around a click."""
    import cv2

    small, factor = _shrink(rgb)
    height, width = small.shape[:2]
    state = np.full((height, width), cv2.GC_BGD, np.uint8)
    if box is not None:
        left, top, right, bottom = (round(float(side) * factor) for side in box)
        state[max(top, 0) : max(bottom, top + 1), max(left, 0) : max(right, left + 1)] = cv2.GC_PR_FGD
        if not (state == cv2.GC_BGD).any():  # a box around everything: the border stands in for the background
            state[[0, -1]] = cv2.GC_BGD
            state[:, [0, -1]] = cv2.GC_BGD
        anchor = None
    else:
        assert click is not None
        x, y = np.rint(resize_pixels(np.asarray(click, float), (1, 1), (factor, factor))).astype(int).tolist()
        anchor = (min(max(x, 0), width - 1), min(max(y, 0), height - 1))
        state[:] = cv2.GC_PR_BGD
        state[[0, -1]] = cv2.GC_BGD
        state[:, [0, -1]] = cv2.GC_BGD
        cv2.circle(state, anchor, max(4, min(height, width) // 10), cv2.GC_PR_FGD, -1)
        cv2.circle(state, anchor, max(2, min(height, width) // 60), cv2.GC_FGD, -1)
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    try:
        cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), state, (0, 0, 0, 0), *models, 6, cv2.GC_INIT_WITH_MASK)
    except cv2.error:
        raise ForegroundError(
            "GrabCut found no difference between the object and its background; give a mask"
        ) from None
    found = (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
    found = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    if anchor is not None:
        _, labels = cv2.connectedComponents(found.astype(np.uint8))
        found = (labels == labels[anchor[1], anchor[0]]) & found
    return _grow(_fill_holes(found), rgb)


def _fill_holes(mask: np.ndarray) -> np.ndarray:
    """Fill holes of less than 1 % of the mask; larger ones are those of a handle."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] < 0.01 * mask.sum()]
    return mask | np.isin(labels, small)


def _plain_background(rgb: np.ndarray) -> tuple[np.ndarray, float]:
    """Pixels that differ from the border's colour, and the 90 % quantile of the border's own deviations (CIELAB units).

    The border's colour may change slowly across the photo (a quadratic in x and y); shadows count half.
    """
    import cv2

    small, _ = _shrink(rgb)
    lab = cv2.cvtColor(cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    lab = lab * np.array([0.5, 1.0, 1.0], np.float32)
    height, width = lab.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], -1)
    ring = np.zeros((height, width), bool)
    band = max(2, min(height, width) // 25)
    ring[:band], ring[-band:], ring[:, :band], ring[:, -band:] = True, True, True, True
    kept = ring.copy()
    distance = np.zeros((height, width))
    for _ in range(4):  # the object may cross the border: fit to the calmer part of it
        model = np.linalg.lstsq(terms[kept], lab[kept], rcond=None)[0]
        distance = np.linalg.norm(lab - terms @ model, axis=-1)
        kept = ring & (distance <= max(np.percentile(distance[ring], 75), 1.0))
    spread = float(np.percentile(distance[ring], 90))
    found = distance > max(8.0, 3.0 * float(np.percentile(distance[kept], 95)))
    kernel = np.ones((3, 3), np.uint8)
    found = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    found = cv2.morphologyEx(found, cv2.MORPH_CLOSE, kernel, iterations=2) > 0
    return _grow(_fill_holes(found), rgb), spread


def draw_attempts(photo: Photo, attempts: list[tuple[str, np.ndarray]], path: str | Path) -> None:
    """Write the photo, and beside it each mask that was tried (outside darkened)."""
    import cv2

    small, _ = _shrink(photo.rgb)
    height, width = small.shape[:2]
    tiles = [("photo", small)]
    for name, mask in attempts:
        shape = mask_from_coverage(cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA))
        tiles.append((name, np.where(shape[..., None], small, small // 4)))
    sheet = []
    for name, tile in tiles:
        label = np.full((24, width, 3), 255, np.uint8)
        cv2.putText(label, name, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        sheet.append(np.concatenate([label, tile]))
    with writing(path) as temporary:
        Image.fromarray(np.concatenate(sheet, axis=1)).save(temporary)


# --- the input of the reconstruction model ----------------------------------------------------------------------------


def crop_foreground(
    rgba: UInt8[np.ndarray, "h w 4"], ratio: float = 0.85
) -> tuple[UInt8[np.ndarray, "n n 4"], tuple[int, int]]:
    """A transparent square around the object, which fills ``ratio`` of it; and its corner in the photo (x, y).

    Exactly what the published model was trained with (tsr/utils.py, resize_foreground): foreground is alpha > 0,
    the last row and column of it are dropped, paddings are rounded down, nothing is resampled.
    """
    rows, columns = np.nonzero(rgba[..., 3] > 0)
    if len(rows) == 0 or np.ptp(rows) == 0 or np.ptp(columns) == 0:
        raise ForegroundError("the mask is empty: there is no object in the photo")
    if not 0 < ratio <= 1:
        raise ValueError(f"the foreground's share of the square must lie in (0, 1], not {ratio}")
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    crop = rgba[top:bottom, left:right]
    height, width = crop.shape[:2]
    size = max(height, width)
    first = ((size - height) // 2, (size - width) // 2)
    total = int(size / ratio)
    more = (total - size) // 2
    square = np.zeros((total, total, 4), np.uint8)
    y, x = first[0] + more, first[1] + more
    square[y : y + height, x : x + width] = crop
    return square, (int(left) - x, int(top) - y)


def composite_grey(rgba: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """The object on mid grey, truncated to bytes as the published model was trained (run.py): the background is 127."""
    return (_composite(rgba) * 255.0).astype(np.uint8)


def _composite(rgba: UInt8[np.ndarray, "h w 4"]) -> Float[np.ndarray, "h w 3"]:
    image = rgba.astype(np.float32) / 255.0
    return image[..., :3] * image[..., 3:] + np.float32(0.5) * (1 - image[..., 3:])
