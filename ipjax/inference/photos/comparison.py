"""The picture by which a person sees that a pose is right: the photo, the query drawn into its view, and both mixed."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage

from ipjax.inference.cards import INK, find_font
from ipjax.inference.photos.drawing import draw_query_into_photo, fill_from_nearest
from ipjax.records import PoseEstimate, Query, Templates

OUTLINE = (64, 224, 208)  # of the photo, over what was drawn
_PAPER, _NOTHING = (18, 20, 26), (44, 48, 58)
_SQUARES = 8  # of the checker, along a side
CAPTIONS = ("photo", "query, drawn from the photo's camera", "both, square by square")


def compare_with_photo(
    templates: Templates, query: Query, estimate: PoseEstimate, title: str = "", *, side: int = 420
) -> UInt8[np.ndarray, "h w 3"]:
    """The reference photo, the query drawn into its view, and the two in alternating squares.

    Where the pose is right, edges and print run on from square to square, and the drawing lies within the photo's
    outline, which is the line in both. Grey is what the query did not measure.

    Args:
        templates: with a reference view.
        query: the crop that was estimated.
        estimate: of it, in the crop's camera (`Estimator.Result.crop_estimate`); of no pose only the photo is shown.
        title: a line above.
        side: of each of the three images, pixels.

    Raises:
        ValueError: the object has no reference view.
    """
    gap, top, caption = 14, 34 if title else 0, 28
    panels = photo_panels(templates, query, estimate, side)
    page = Image.new("RGB", (3 * side + 4 * gap, top + side + caption + 2 * gap), _PAPER)
    pen = ImageDraw.Draw(page)
    if title:
        pen.text((gap, gap), title, INK, find_font(18))
    for index, (panel, text) in enumerate(zip(panels, CAPTIONS, strict=True)):
        left = gap + index * (side + gap)
        page.paste(Image.fromarray(panel), (left, gap + top))
        pen.text((left, gap + top + side + 8), text, INK, find_font(16))
    return np.asarray(page)


def photo_panels(
    templates: Templates, query: Query, estimate: PoseEstimate, side: int
) -> tuple[UInt8[np.ndarray, "s s 3"], UInt8[np.ndarray, "s s 3"], UInt8[np.ndarray, "s s 3"]]:
    """The three images of :func:`compare_with_photo`, without captions. Raises ValueError as it does."""
    reference = templates.reference
    if reference is None:
        raise ValueError("the object keeps no photo that it was made from: there is none to compare with")
    photo, mask = np.asarray(reference.view.rgb), np.asarray(reference.view.mask)
    if bool(estimate.success):
        drawing = draw_query_into_photo(templates, query, estimate)
        drawn, shown = drawing.rgb.astype(np.float32), drawing.shown
    else:
        drawn, shown = np.zeros_like(photo), np.zeros_like(mask)
    # Flying pixels make thin streaks, which shall not decide what is shown.
    window = _frame(mask | ndimage.binary_opening(shown, iterations=2))
    # Colours go on beyond the border of what has any, so that enlarging does not darken it.
    photo, drawn = (_enlarge(fill_from_nearest(*x), window, side) for x in ((photo, mask), (drawn, shown)))
    mask, shown = (_enlarge(x, window, side) > 0.5 for x in (mask, shown))
    photo = np.where(mask[..., None], photo, 0)
    line = max(round(side / 200), 1)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlined = lambda image: cv2.drawContours(np.array(image), contours, -1, OUTLINE, line, cv2.LINE_AA)
    field = np.arange(side) * _SQUARES // side
    other = (field[:, None] + field[None]) % 2 == 1
    alone = np.where(shown[..., None], drawn, np.array(_NOTHING) / 255)
    both = np.where((other & shown)[..., None], drawn, photo)
    first, second, third = (np.round(255 * np.clip(x, 0, 1)).astype(np.uint8) for x in (photo, alone, both))
    if not bool(estimate.success):
        canvas = Image.fromarray(second)
        ImageDraw.Draw(canvas).text((side / 2, side / 2), "no pose found", INK, find_font(16), "mm")
        second = np.asarray(canvas)
    return first, outlined(second), outlined(third)


def _frame(mask: Bool[np.ndarray, "h w"], margin: float = 0.06) -> tuple[float, float, float]:
    """Left, top (pixels) and side of the square about a mask, with a margin."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return 0.0, 0.0, float(max(mask.shape))
    low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]]) + 1
    side = float((high - low).max()) * (1 + 2 * margin)
    left, top = (low + high - side) / 2
    return float(left), float(top), side


def _enlarge(image: np.ndarray, window: tuple[float, float, float], side: int) -> np.ndarray:
    """A square of an image at another size; black beyond its border."""
    left, top, width = window
    zoom = width / side
    # The centre of the first pixel is at (0, 0): a half on both sides.
    matrix = np.array([[zoom, 0, left + zoom / 2 - 0.5], [0, zoom, top + zoom / 2 - 0.5]])
    return cv2.warpAffine(image.astype(np.float32), matrix, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
