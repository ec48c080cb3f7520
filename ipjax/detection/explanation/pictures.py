"""Pictures of a search: the frame with what was found and with its proposals, and crops of them."""

from collections.abc import Sequence

import cv2
import jax
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageDraw

from ipjax.cameras import resize_pixels
from ipjax.detection.crops import Scene
from ipjax.detection.records import Detection
from ipjax.inference.cards import find_font
from ipjax.inference.drawing import PALETTE, draw_mask, draw_overlay, name_estimate, own_box
from ipjax.inference.photos.corrected_mesh import correct_info

CUT, POSED = (255, 190, 0), (64, 224, 208)  # outlines of what was cut out, and of the mask that a pose gave
_FAINT = (200, 205, 215)  # of guesses
_HEIGHT = 900  # pixels of pictures of the whole frame
_SIDE = 160  # pixels of a crop


def draw_found(scene: Scene, found: Sequence[Detection]) -> UInt8[np.ndarray, "h w 3"]:
    """The frame with outline, axes and box of every object that is present, at its pose, and of guesses only the mask;
    with names and confidences."""
    posed = [one for one in found if one.present]
    guesses = [one for one in found if not one.present]
    poses = [jax.tree.map(np.asarray, one.result.estimate.camera_from_object) for one in posed]
    colours = [PALETTE[number % len(PALETTE)] for number in range(len(posed))]
    infos = [correct_info(one.result) for one in posed]
    boxes = [own_box(one.result.estimate, info) for one, info in zip(posed, infos, strict=True)]
    about = scene.rgb, scene.matrix, poses, infos
    picture = draw_overlay(*about, boxes=boxes, colours=colours, height=_HEIGHT)
    for one, colour in zip([*guesses, *posed], [_FAINT] * len(guesses) + colours, strict=True):
        draw_mask(picture, one.mask, name_estimate(one.name, one.result.estimate), colour)
    return picture


def draw_proposals(
    rgb: UInt8[np.ndarray, "h w 3"],
    masks: Bool[np.ndarray, "n h w"],
    numbered: Sequence[int],
    clicks: Sequence[tuple[float, float]] = (),
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The frame with every proposal outlined; those of these numbers are outlined strongly and numbered, and clicks are
    crossed."""
    height, width = rgb.shape[:2]
    zoom = min(_HEIGHT / height, 1600 / width)
    size = round(width * zoom), round(height * zoom)
    picture = cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC if zoom > 1 else cv2.INTER_AREA)
    picture = (0.75 * picture).astype(np.uint8)
    marked = set(numbered)
    labels = []
    for number in sorted(range(len(masks)), key=lambda number: number in marked):
        colour = PALETTE[number % len(PALETTE)]
        outline, inside = _outline(masks[number], size)
        if number not in marked:
            cv2.drawContours(picture, outline, -1, colour, 1, cv2.LINE_AA)
            continue
        cv2.drawContours(picture, outline, -1, (10, 10, 10), 5, cv2.LINE_AA)
        cv2.drawContours(picture, outline, -1, colour, 3, cv2.LINE_AA)
        # The number stands where the mask is widest.
        depth = cv2.distanceTransform(np.pad(inside, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        y, x = map(int, np.unravel_index(int(depth.argmax()), depth.shape))
        while any(abs(x - other[0]) < 30 and abs(y - other[1]) < 22 for other, _, _ in labels):
            y += 6
        labels.append(((x, y), str(number), colour))
    canvas = Image.fromarray(picture)
    pen = ImageDraw.Draw(canvas)
    for place, text, colour in labels:
        pen.text(place, text, colour, find_font(20), "mm", stroke_width=3, stroke_fill=(10, 10, 10))
    for click in clicks:
        x, y = resize_pixels(np.asarray(click, float), (width, height), size)
        for colour, stroke in (((10, 10, 10), 7), ((255, 255, 255), 3)):
            pen.line((x - 12, y, x + 12, y), colour, stroke)
            pen.line((x, y - 12, x, y + 12), colour, stroke)
    return np.asarray(canvas)


def draw_crop(
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    posed: Bool[np.ndarray, "h w"] | None = None,
    side: int = _SIDE,
) -> UInt8[np.ndarray, "s s 3"]:
    """The square around a mask, what is beside it dimmed, its outline drawn, and that of the mask of a pose."""
    both = mask if posed is None or not posed.any() else mask | posed
    rows, columns = np.flatnonzero(both.any(1)), np.flatnonzero(both.any(0))
    length = int(1.25 * max(np.ptp(rows), np.ptp(columns))) + 9
    top, left = (int(one[0] + one[-1] - length) // 2 for one in (rows, columns))
    cut = lambda image: _cut(image, top, left, length)
    small = length > side
    picture = cv2.resize(cut(rgb), (side, side), interpolation=cv2.INTER_AREA if small else cv2.INTER_CUBIC)
    outline, inside = _outline(cut(mask), (side, side))
    picture = np.where(inside[..., None] > 0, picture, picture // 3 + 20).astype(np.uint8)
    cv2.drawContours(picture, outline, -1, CUT, 1, cv2.LINE_AA)
    if posed is not None:
        cv2.drawContours(picture, _outline(cut(posed), (side, side))[0], -1, POSED, 2, cv2.LINE_AA)
    return picture


def _outline(mask: np.ndarray, size: tuple[int, int]) -> tuple[Sequence[np.ndarray], np.ndarray]:
    """Contours of a mask at another size (width, height), and that mask, of bytes."""
    inside = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5).astype(np.uint8)
    return cv2.findContours(inside, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0], inside


def _cut(image: np.ndarray, top: int, left: int, length: int) -> np.ndarray:
    """A square of an image; zero outside of it."""
    height, width = image.shape[:2]
    square = np.zeros((length, length, *image.shape[2:]), image.dtype)
    y, x = slice(max(top, 0), min(top + length, height)), slice(max(left, 0), min(left + length, width))
    square[y.start - top : y.stop - top, x.start - left : x.stop - left] = image[y, x]
    return square
