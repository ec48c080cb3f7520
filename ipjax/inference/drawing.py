"""Pictures of an estimate: outline, axes and box over the photo, and beside it what was matched with what."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from ipjax.cameras import project, resize, resize_pixels
from ipjax.config import Config
from ipjax.estimation.matching import match
from ipjax.estimation.pipeline import comparable
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.writing import writing
from ipjax.inference.reports import UNSURE_TURN
from ipjax.records import PoseEstimate, Query, Similarity, Templates

_PALETTE = ((64, 224, 208), (255, 183, 77), (186, 104, 200), (129, 199, 132), (100, 181, 246), (240, 98, 146))
_AXES = ((239, 68, 68), (74, 222, 128), (96, 165, 250))  # x, y, z
_PAPER, _CARD, _INK, _FAINT = (18, 20, 26), (30, 33, 42), (238, 240, 245), (150, 156, 170)
_EDGES = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What an estimate rests on, for the panel beside the photo.

    Args:
        crop: the query's crop, RGB in [0, 1] or uint8.
        template: the template whose pairs led to the answer; None = no picture was kept.
        crop_points, template_points: the pairs, in pixels of the crop, and of the template if it had a single one.
        inlier: which of the pairs agree with the pose.
    """

    crop: np.ndarray
    template: np.ndarray | None
    crop_points: Float[np.ndarray, "k 2"]
    template_points: Float[np.ndarray, "k 2"]
    inlier: Bool[np.ndarray, " k"]


def gather_evidence(
    templates: Templates,
    query: Query,
    estimate: PoseEstimate,
    info: ObjectInfo,
    config: Config = Config(),
) -> Evidence:
    """Match the query once more with the chosen template alone, and see which pairs the pose explains."""
    view = int(estimate.view)
    one = dataclasses.replace(
        templates,
        **{
            name: jax.tree.map(lambda x: x[view : view + 1], getattr(templates, name))
            for name in ("patches", "norm", "seen", "camera_from_object", "camera")
        },
    )
    settings = dataclasses.replace(config.match, views=1)
    matches = jax.tree.map(np.asarray, jax.jit(match)(*comparable(one, query.patches, config), settings))
    kept = np.isfinite(matches.distance[0]) & (matches.distance[0] <= config.match.cycle)
    q, t = matches.query[0][kept], matches.template[0][kept]
    height, width = query.view.mask.shape
    crop_grid, template_grid = np.asarray(query.patches.grid), np.asarray(one.patches.grid[0])
    columns, rows = (int(side) + 1 for side in crop_grid.max(axis=0))
    cells = (int(template_grid[:, 0].max()) + 1, int(template_grid[:, 1].max()) + 1)
    moved = estimate.camera_from_object.to_numpy() @ np.asarray(one.patches.points[0], np.float64)[t]
    residual = np.linalg.norm(moved - np.asarray(query.patches.points)[q], axis=-1)
    return Evidence(
        crop=np.asarray(query.view.rgb),
        template=info.picture(view),
        crop_points=resize_pixels(crop_grid[q], (columns, rows), (width, height)),
        template_points=resize_pixels(template_grid[t], cells, (1, 1)),
        inlier=residual <= float(config.align.threshold) * float(estimate.camera_from_object.scale),
    )


def draw(
    rgb: UInt8[np.ndarray, "h w 3"],
    camera,
    estimates: PoseEstimate | Sequence[PoseEstimate],
    objects: ObjectInfo | Sequence[ObjectInfo],
    evidence: Evidence | Sequence[Evidence | None] | None = None,
    *,
    extents: Sequence[np.ndarray] | None = None,
    height: int = 900,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """A picture that shows whether an estimate is right.

    Args:
        rgb: the photo, uint8.
        camera: of the photo: `Intrinsics`, `Camera`, 3 × 3 K or (fx, fy, cx, cy); the estimates are in its frame.
        estimates, objects: one or several, in the same order.
        evidence: crop, template and pairs of each, from `gather_evidence`.
        extents: sides of the box in model units, where the object file keeps no mesh.
        height: of the picture in pixels.

    Returns:
        The photo with outline, axes and box of each object; beside it a card for each with the crop, the chosen
        template, the pairs between them, and the numbers.

    Raises:
        ValueError: the lists differ in length, or rgb is no uint8 image.
    """
    estimates = [estimates] if isinstance(estimates, PoseEstimate) else list(estimates)
    objects = [objects] if isinstance(objects, ObjectInfo) else list(objects)
    if evidence is None or isinstance(evidence, Evidence):
        evidence = [evidence] * len(objects) if evidence is None else [evidence]
    if not len(estimates) == len(objects) == len(evidence):
        raise ValueError(f"{len(estimates)} estimates, {len(objects)} objects and {len(evidence)} pieces of evidence")
    poses = [jax.tree.map(np.asarray, estimate.camera_from_object) for estimate in estimates]
    shown = [bool(estimate.success) for estimate in estimates]
    photo = draw_overlay(
        rgb,
        camera,
        [pose for pose, s in zip(poses, shown, strict=True) if s],
        [info for info, s in zip(objects, shown, strict=True) if s],
        extents=None if extents is None else [e for e, s in zip(extents, shown, strict=True) if s],
        colours=[_PALETTE[i % len(_PALETTE)] for i, s in enumerate(shown) if s],
        height=height,
    )
    cards = [
        _card(estimate, info, proof, _PALETTE[i % len(_PALETTE)], compact=len(objects) > 1)
        for i, (estimate, info, proof) in enumerate(zip(estimates, objects, evidence, strict=True))
    ]
    return _compose(photo, cards)


def draw_overlay(
    rgb: UInt8[np.ndarray, "h w 3"],
    camera,
    poses: Sequence[Similarity],
    objects: Sequence[ObjectInfo],
    *,
    extents: Sequence[np.ndarray] | None = None,
    colours: Sequence[tuple[int, int, int]] = _PALETTE,
    height: int | None = None,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The photo with the outline, the axes and the 3-D box of every object at its pose (``camera_from_object``).

    Raises:
        ValueError: rgb is no uint8 image.
    """
    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[-1] != 3 or rgb.dtype != np.uint8:
        raise ValueError(f"rgb must be uint8 [height, width, 3], not {rgb.dtype} {list(rgb.shape)}")
    intrinsics = as_intrinsics(camera)
    K = intrinsics.matrix.copy()
    zoom = 1.0 if height is None else min(height / rgb.shape[0], 1600 / rgb.shape[1])
    if intrinsics.distortion:
        if intrinsics.lens == "equidistant":
            rgb = cv2.fisheye.undistortImage(rgb, K, np.asarray(intrinsics.distortion), Knew=K)
        else:
            rgb = cv2.undistort(rgb, K, np.asarray(intrinsics.distortion))
    if zoom != 1.0:
        before, size = rgb.shape[1::-1], (round(rgb.shape[1] * zoom), round(rgb.shape[0] * zoom))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC)
        K = resize(K, before, size)
    image = np.array(rgb)
    # Far objects first, so that near ones are drawn over them.
    for i in sorted(range(len(poses)), key=lambda i: -float(np.asarray(poses[i].translation)[2])):
        box = None if extents is None else np.asarray(extents[i])
        _draw_object(image, K, poses[i], objects[i], box, colours[i % len(colours)])
    return image


def silhouette(
    vertices: Float[np.ndarray, "n 3"], faces: np.ndarray, matrix: Float[np.ndarray, "3 3"], height: int, width: int
) -> Bool[np.ndarray, "h w"]:
    """Where a mesh covers the image; vertices in the camera frame, faces that reach behind the camera left out."""
    cover = np.zeros((height, width), np.uint8)
    ahead = vertices[:, 2] > 1e-4
    pixels = project(matrix, vertices)
    pixels = np.clip(pixels, -4 * max(height, width), 5 * max(height, width))
    faces = faces[ahead[faces].all(axis=1)]
    corners = np.round(pixels[faces] * 16).astype(np.int32)
    for corner in corners:
        cv2.fillConvexPoly(cover, corner, 1, lineType=cv2.LINE_8, shift=4)
    return cover.view(bool)


def write_image(path: str | Path, image: np.ndarray) -> None:
    """Save RGB or grey (as PNG also of 16 bits) as PNG or JPEG by the name's ending; it appears whole or not at all.

    Raises:
        ValueError: the ending is neither.
        OSError: the file cannot be written.
    """
    path = Path(path)
    kind = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}.get(path.suffix.lower())
    if kind is None:
        raise ValueError(f"{path}: pictures are written as .png or .jpg")
    with writing(path) as temporary:
        Image.fromarray(image).save(temporary, kind, **({"quality": 92} if kind == "JPEG" else {}))


def _line(image: np.ndarray, a: np.ndarray, b: np.ndarray, colour, width: int, reach: float = 1e5) -> None:
    if np.abs([a, b]).max() > reach:
        return
    start, end = _sixteenths(a), _sixteenths(b)
    cv2.line(image, start, end, (10, 10, 10), width + 2, cv2.LINE_AA, 4)
    cv2.line(image, start, end, colour, width, cv2.LINE_AA, 4)


def _sixteenths(point: np.ndarray) -> tuple[int, int]:
    """OpenCV's fixed-point coordinates, 4 bits of fraction."""
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


def _draw_object(image, K, pose: Similarity, info: ObjectInfo, extents, colour) -> None:
    camera_from_object = pose.to_numpy()
    height, width = image.shape[:2]
    stroke = max(round(height / 450), 1)
    if info.vertices is not None and info.faces is not None and len(info.faces):
        vertices = np.asarray(info.vertices, np.float64)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        cover = silhouette(camera_from_object @ vertices, info.faces, K, height, width)
        contours, _ = cv2.findContours(cover.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        glow = np.zeros_like(cover, np.uint8)
        cv2.drawContours(glow, contours, -1, 255, 3 * stroke + 2)
        shade = (glow > 0) & ~cover
        image[shade] = (image[shade] * 0.45).astype(np.uint8)  # a dark rim: the outline shows on any photo
        tint = cover & True
        image[tint] = (image[tint] * 0.86 + np.array(colour) * 0.14).astype(np.uint8)
        cv2.drawContours(image, contours, -1, colour, stroke, cv2.LINE_AA)
    elif extents is not None:
        low, high = -np.asarray(extents) / 2, np.asarray(extents) / 2
    else:
        low = high = None
    if low is not None and high is not None:
        corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])
        placed = camera_from_object @ corners
        if (placed[:, 2] > 1e-3).all():
            pixels, hidden = project(K, placed), int(np.argmax(placed[:, 2]))
            # Edges of the farthest corner lie behind the object: faint, and first.
            for a, b in sorted(_EDGES, key=lambda edge: hidden not in edge):
                if hidden in (a, b):
                    faint = image.copy()
                    _line(faint, pixels[a], pixels[b], colour, 1)
                    cv2.addWeighted(faint, 0.4, image, 0.6, 0, image)
                else:
                    soft = image.copy()
                    _line(soft, pixels[a], pixels[b], _INK, 1)
                    cv2.addWeighted(soft, 0.75, image, 0.25, 0, image)
    placed = camera_from_object @ np.concatenate([np.zeros((1, 3)), 0.45 * np.eye(3)])
    if (placed[:, 2] > 1e-3).all():
        pixels = project(K, placed)
        for axis in np.argsort(-placed[1:, 2]):
            _line(image, pixels[0], pixels[axis + 1], _AXES[axis], stroke + 1)
        canvas = Image.fromarray(image)
        pen = ImageDraw.Draw(canvas)
        for axis in range(3):
            step = pixels[axis + 1] - pixels[0]
            length = float(np.linalg.norm(step))
            if length > 8 and np.abs(pixels[axis + 1]).max() < 1e5:
                x, y = pixels[axis + 1] + step / length * 7 * stroke
                pen.text(
                    (x, y), "xyz"[axis], _AXES[axis], _font(8 * stroke), "mm", stroke_width=2, stroke_fill=(10, 10, 10)
                )
        image[:] = np.asarray(canvas)


def _font(size: int):
    try:
        return ImageFont.load_default(size)
    except (TypeError, OSError):  # Pillow without FreeType has one size only
        return ImageFont.load_default()


def _card(estimate: PoseEstimate, info: ObjectInfo, proof: Evidence | None, colour, compact: bool) -> np.ndarray:
    """One object: crop and template with their pairs, and the numbers below."""
    side = 220 if compact else 300
    gap, margin = 24, 16
    width = 2 * side + gap + 2 * margin
    canvas = Image.new("RGB", (width, 10_000 // 10), _CARD)
    pen = ImageDraw.Draw(canvas)
    y = margin
    pen.rounded_rectangle((margin, y + 3, margin + 14, y + 17), 3, fill=colour)
    pen.text((margin + 24, y), _shorten(info.name, 34), _INK, _font(18))
    y += 34
    if proof is not None:
        canvas.paste(Image.fromarray(_pairs_picture(proof, side, gap)), (margin, y))
        y += side + 6
        pen = ImageDraw.Draw(canvas)
        pen.text((margin, y), "query crop", _FAINT, _font(13))
        chosen = f"template {int(estimate.view)}"
        pen.text((margin + side + gap, y), chosen, _FAINT, _font(13))
        y += 26
    if not bool(estimate.success):
        pen.text((margin, y), "no pose: too few pairs, or degenerate ones", (248, 113, 113), _font(16))
        return np.asarray(canvas)[: y + 40]
    confidence = float(estimate.confidence)
    good = (74, 222, 128) if confidence >= 0.6 else (251, 191, 36) if confidence >= 0.3 else (248, 113, 113)
    if not bool(estimate.present):
        pen.text((margin, y), "not here, or not seen well enough: a guess", (248, 113, 113), _font(16))
        y += 26
    pen.text((margin, y), "confidence", _FAINT, _font(15))
    left, right = margin + 110, width - margin - 52
    pen.rounded_rectangle((left, y + 5, right, y + 15), 5, fill=_PAPER)
    if confidence > 0.02:
        pen.rounded_rectangle((left, y + 5, left + (right - left) * min(confidence, 1), y + 15), 5, fill=good)
    pen.text((width - margin, y), f"{confidence:.2f}", _INK, _font(15), "ra")
    y += 26
    pose = estimate.camera_from_object
    x, height_, z = (1e3 * float(v) for v in np.asarray(pose.translation))
    pairs = 0 if proof is None else len(proof.inlier)
    rows = [
        ("diameter", f"{1e3 * float(pose.scale):.1f} ± {1e3 * float(estimate.scale_std):.1f} mm"),
        ("centre in camera", f"({x:.0f}, {height_:.0f}, {z:.0f}) mm"),
        ("inliers", f"{int(estimate.inliers)} pairs, rms {1e3 * float(estimate.rmse):.1f} mm"),
    ]
    turn = np.degrees(float(np.linalg.norm(np.asarray(estimate.ambiguity))))
    if turn > UNSURE_TURN:
        rows.append(("may be turned", f"± {turn:.0f}° about one axis"))
    if pairs:
        assert proof is not None
        rows.append(("pairs shown", f"{int(proof.inlier.sum())} of {pairs} agree with the pose"))
    for name, value in rows:
        pen.text((margin, y), name, _FAINT, _font(15))
        pen.text((width - margin, y), value, _INK, _font(15), "ra")
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


def _pairs_picture(proof: Evidence, side: int, gap: int, most: int = 60) -> np.ndarray:
    picture = np.full((side, 2 * side + gap, 3), _CARD, np.uint8)
    picture[:, :side] = _as_picture(proof.crop, side)
    if proof.template is None:
        picture[:, side + gap :] = 0
    else:
        picture[:, side + gap :] = _as_picture(proof.template, side)
    height, width = proof.crop.shape[:2]
    longest = max(height, width)
    a = resize_pixels(proof.crop_points, (longest, longest), (side, side))
    b = resize_pixels(proof.template_points, (1, 1), (side, side)) + np.array([side + gap, 0])
    # All outliers behind, inliers in front; few enough that single lines can be followed. Colour by place, so that
    # lines which run together can be told apart.
    outliers, inliers = np.flatnonzero(~proof.inlier), np.flatnonzero(proof.inlier)
    for chosen, share in ((outliers, most // 4), (inliers, most)):
        if len(chosen) > share:
            chosen = chosen[np.linspace(0, len(chosen) - 1, share).round().astype(int)]
        layer = picture.copy()
        for i in chosen:
            hue = int(179 * np.clip(a[i, 1] / side, 0, 1) * 0.85)
            bright = cv2.cvtColor(np.array([[[hue, 190, 255]]], np.uint8), cv2.COLOR_HSV2RGB)[0, 0].tolist()
            ink = bright if proof.inlier[i] else (150, 60, 60)
            p, q = _sixteenths(a[i]), _sixteenths(b[i])
            cv2.line(layer, p, q, ink, 1, cv2.LINE_AA, 4)
            for point in (p, q):
                cv2.circle(layer, point, 40, (10, 10, 10), -1, cv2.LINE_AA, 4)
                cv2.circle(layer, point, 30, ink, -1, cv2.LINE_AA, 4)
        picture = cv2.addWeighted(layer, 0.8 if chosen is not outliers else 0.5, picture, 0.2, 0)
    return picture


def _compose(photo: np.ndarray, cards: list[np.ndarray]) -> np.ndarray:
    """The photo at the left, the cards in columns beside it."""
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
