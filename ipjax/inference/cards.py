"""Cards next to the photo: the pairs between the query and a template, and the numbers of the estimate."""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float
from PIL import Image, ImageDraw, ImageFont

from ipjax.cameras import resize_pixels
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.reports import AMBIGUOUS_TURN
from ipjax.records import PoseEstimate

INK = (238, 240, 245)
_PAPER, _CARD, _FAINT = (18, 20, 26), (30, 33, 42), (150, 156, 170)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """The crop, the template and the pairs that led to an estimate, for its card.

    Args:
        crop: the query's crop, RGB in [0, 1] or uint8.
        template: the template whose pairs led to the answer; None = no picture was kept.
        crop_points, template_points: the pairs, in pixels of the crop, and of the template if it had a single one.
        inlier: which of the pairs agree with the pose.
        panels: of an object found through a photo: that photo, the query drawn into its view, and both.
    """

    crop: np.ndarray
    template: np.ndarray | None
    crop_points: Float[np.ndarray, "k 2"]
    template_points: Float[np.ndarray, "k 2"]
    inlier: Bool[np.ndarray, " k"]
    panels: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


_PAPER, _CARD, INK, _FAINT = (18, 20, 26), (30, 33, 42), (238, 240, 245), (150, 156, 170)


def draw_card(estimate: PoseEstimate, info: ObjectInfo, evidence: Evidence | None, colour, compact: bool) -> np.ndarray:
    """One object: crop and template with their pairs, and the numbers below."""
    side = 220 if compact else 300
    gap, margin = 24, 16
    width = 2 * side + gap + 2 * margin
    canvas = Image.new("RGB", (width, 10_000 // 10), _CARD)
    pen = ImageDraw.Draw(canvas)
    y = margin
    pen.rounded_rectangle((margin, y + 3, margin + 14, y + 17), 3, fill=colour)
    pen.text((margin + 24, y), _shorten(info.name, 34), INK, find_font(18))
    y += 34
    if evidence is not None:
        canvas.paste(Image.fromarray(_draw_pairs(evidence, side, gap)), (margin, y))
        y += side + 6
        pen = ImageDraw.Draw(canvas)
        pen.text((margin, y), "query crop", _FAINT, find_font(13))
        chosen = f"template {int(estimate.view)}"
        pen.text((margin + side + gap, y), chosen, _FAINT, find_font(13))
        y += 26
        if evidence.panels is not None:
            part = (2 * side + gap - 2 * margin) // 3
            for i, (panel, text) in enumerate(
                zip(evidence.panels, ("photo", "query in its view", "both"), strict=True)
            ):
                left = margin + i * (part + margin)
                canvas.paste(Image.fromarray(_as_picture(panel, part)), (left, y))
                pen.text((left, y + part + 6), text, _FAINT, find_font(13))
            y += part + 32
    if not bool(estimate.success):
        pen.text((margin, y), "no pose: too few pairs, or degenerate ones", (248, 113, 113), find_font(16))
        return np.asarray(canvas)[: y + 40]
    confidence = float(estimate.confidence)
    good = (74, 222, 128) if confidence >= 0.6 else (251, 191, 36) if confidence >= 0.3 else (248, 113, 113)
    if not bool(estimate.present):
        pen.text((margin, y), "not here, or not seen well enough: a guess", (248, 113, 113), find_font(16))
        y += 26
    pen.text((margin, y), "confidence", _FAINT, find_font(15))
    left, right = margin + 110, width - margin - 52
    pen.rounded_rectangle((left, y + 5, right, y + 15), 5, fill=_PAPER)
    if confidence > 0.02:
        pen.rounded_rectangle((left, y + 5, left + (right - left) * min(confidence, 1), y + 15), 5, fill=good)
    pen.text((width - margin, y), f"{confidence:.2f}", INK, find_font(15), "ra")
    y += 26
    pose = estimate.camera_from_object
    centre = ", ".join(f"{1e3 * float(x):.0f}" for x in np.asarray(pose.translation))
    pairs = 0 if evidence is None else len(evidence.inlier)
    # Of a size that was given nothing was estimated: ± 0 would say that it is exact.
    spread = f" ± {1e3 * float(estimate.scale_std):.1f} mm" if float(estimate.scale_std) > 0 else " mm (given)"
    rows = [
        ("diameter", f"{1e3 * float(estimate.diameter):.1f}{spread}"),
        ("centre in camera", f"({centre}) mm"),
        ("inliers", f"{int(estimate.inliers)} pairs, rms {1e3 * float(estimate.rmse):.1f} mm"),
    ]
    turn = np.degrees(float(np.linalg.norm(np.asarray(estimate.ambiguity))))
    if turn > AMBIGUOUS_TURN:
        rows.append(("may be turned", f"± {turn:.0f}° about one axis"))
    if pairs:
        assert evidence is not None
        rows.append(("pairs shown", f"{int(evidence.inlier.sum())} of {pairs} agree with the pose"))
    for name, value in rows:
        pen.text((margin, y), name, _FAINT, find_font(15))
        pen.text((width - margin, y), value, INK, find_font(15), "ra")
        y += 24
    return np.asarray(canvas)[: y + margin - 4]


def _shorten(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def _as_picture(image: np.ndarray, side: int) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype != np.uint8:
        image = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    zoom = side / max(image.shape[:2])
    size = (max(round(image.shape[1] * zoom), 1), max(round(image.shape[0] * zoom), 1))
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC)
    square = np.zeros((side, side, 3), np.uint8)
    square[: image.shape[0], : image.shape[1]] = image
    return square


def _draw_pairs(evidence: Evidence, side: int, gap: int, most: int = 60) -> np.ndarray:
    picture = np.full((side, 2 * side + gap, 3), _CARD, np.uint8)
    picture[:, :side] = _as_picture(evidence.crop, side)
    if evidence.template is None:
        picture[:, side + gap :] = 0
    else:
        picture[:, side + gap :] = _as_picture(evidence.template, side)
    height, width = evidence.crop.shape[:2]
    longest = max(height, width)
    a = resize_pixels(evidence.crop_points, (longest, longest), (side, side))
    b = resize_pixels(evidence.template_points, (1, 1), (side, side)) + np.array([side + gap, 0])
    # Outliers first, inliers over them, and few enough that single lines can be followed. Colours follow the place, so
    # that neighbouring lines differ.
    outliers, inliers = np.flatnonzero(~evidence.inlier), np.flatnonzero(evidence.inlier)
    for chosen, share in ((outliers, most // 4), (inliers, most)):
        if len(chosen) > share:
            chosen = chosen[np.linspace(0, len(chosen) - 1, share).round().astype(int)]
        layer = picture.copy()
        for i in chosen:
            hue = int(179 * np.clip(a[i, 1] / side, 0, 1) * 0.85)
            bright = cv2.cvtColor(np.array([[[hue, 190, 255]]], np.uint8), cv2.COLOR_HSV2RGB)[0, 0].tolist()
            stroke = bright if evidence.inlier[i] else (150, 60, 60)
            p, q = to_fixed_point(a[i]), to_fixed_point(b[i])
            cv2.line(layer, p, q, stroke, 1, cv2.LINE_AA, 4)
            for point in (p, q):
                cv2.circle(layer, point, 40, (10, 10, 10), -1, cv2.LINE_AA, 4)
                cv2.circle(layer, point, 30, stroke, -1, cv2.LINE_AA, 4)
        picture = cv2.addWeighted(layer, 0.8 if chosen is not outliers else 0.5, picture, 0.2, 0)
    return picture


def attach_cards(photo: np.ndarray, cards: list[np.ndarray]) -> np.ndarray:
    """The photo at the left, the cards in columns to the right of it."""
    if not cards:
        return photo
    gap = 14
    columns: list[list[np.ndarray]] = [[]]
    for card in cards:
        used = sum(c.shape[0] + gap for c in columns[-1])
        if columns[-1] and used + card.shape[0] > photo.shape[0]:
            columns.append([])
        columns[-1].append(card)
    tall = max(photo.shape[0], *(sum(c.shape[0] + gap for c in column) - gap for column in columns))
    wide = photo.shape[1] + sum(gap + max(c.shape[1] for c in column) for column in columns)
    page = np.full((tall + 2 * gap, wide + 2 * gap, 3), _PAPER, np.uint8)
    page[gap : gap + photo.shape[0], gap : gap + photo.shape[1]] = photo
    x = gap + photo.shape[1] + gap
    for column in columns:
        y = gap
        for card in column:
            page[y : y + card.shape[0], x : x + card.shape[1]] = card
            y += card.shape[0] + gap
        x += max(c.shape[1] for c in column) + gap
    return page


def find_font(size: int):
    """Pillow's own font at a height in pixels, where it can be scaled."""
    try:
        return ImageFont.load_default(size)
    except (TypeError, OSError):  # Pillow without FreeType has one size only
        return ImageFont.load_default()


def to_fixed_point(point: np.ndarray) -> tuple[int, int]:
    """OpenCV's fixed-point coordinates, 4 bits of fraction."""
    return round(float(point[0]) * 16), round(float(point[1]) * 16)
