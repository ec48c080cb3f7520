"""Pictures of an estimate: outline, axes and box over the photo, and next to it the pairs that were matched."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw

from ipjax.cameras import project, resize, resize_pixels
from ipjax.config import Config
from ipjax.estimation.matching import match
from ipjax.estimation.pipeline import comparable
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.writing import writing
from ipjax.inference.cards import INK, Evidence, attach_cards, draw_card, find_font, to_fixed_point
from ipjax.inference.photos.comparison import photo_panels
from ipjax.records import PoseEstimate, Query, Similarity, Templates

PALETTE = ((64, 224, 208), (255, 183, 77), (186, 104, 200), (129, 199, 132), (100, 181, 246), (240, 98, 146))
_AXES = ((239, 68, 68), (74, 222, 128), (96, 165, 250))  # x, y, z
_EDGES = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def gather_evidence(
    templates: Templates,
    query: Query,
    estimate: PoseEstimate,
    info: ObjectInfo,
    config: Config = Config(),
) -> Evidence:
    """Match the query once more, with the chosen template alone, and mark the pairs that agree with the pose."""
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
        panels=None if templates.reference is None else photo_panels(templates, query, estimate, 2 * width),
    )


def draw(
    rgb: UInt8[np.ndarray, "h w 3"],
    camera,
    estimates: PoseEstimate | Sequence[PoseEstimate],
    objects: ObjectInfo | Sequence[ObjectInfo],
    evidence: Evidence | Sequence[Evidence | None] | None = None,
    *,
    extents: Sequence[np.ndarray] | None = None,
    masks: Sequence[Bool[np.ndarray, "h w"] | None] | None = None,
    height: int = 900,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """A picture that shows whether an estimate is right.

    Args:
        rgb: the photo, uint8.
        camera: of the photo: `Intrinsics`, `Camera`, 3 × 3 K or (fx, fy, cx, cy); the estimates are in its frame.
        estimates, objects: one or several, in the same order.
        evidence: crop, template and pairs of each, from `gather_evidence`.
        extents: sides of the box in model units, where the object file keeps no mesh.
        masks: of each, where it was found; drawn with its name and confidence. Of the image without lens distortion.
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
        boxes=[own_box(e, info) for e, info, s in zip(estimates, objects, shown, strict=True) if s],
        colours=[PALETTE[i % len(PALETTE)] for i, s in enumerate(shown) if s],
        height=height,
    )
    for i, mask in enumerate(masks or ()):
        if mask is not None and mask.any():
            draw_mask(photo, mask, name_estimate(objects[i].name, estimates[i]), PALETTE[i % len(PALETTE)])
    cards = [
        draw_card(estimate, info, one, PALETTE[i % len(PALETTE)], compact=len(objects) > 1)
        for i, (estimate, info, one) in enumerate(zip(estimates, objects, evidence, strict=True))
    ]
    return attach_cards(photo, cards)


def own_box(estimate: PoseEstimate, info: ObjectInfo) -> np.ndarray | None:
    """The box that was estimated, of an object from a photo without depth; any other's is that of its mesh."""
    guessed = info.reference is not None and not info.reference.metric and info.reference.method != "elsewhere"
    return np.asarray(estimate.box) if guessed else None


def draw_overlay(
    rgb: UInt8[np.ndarray, "h w 3"],
    camera,
    poses: Sequence[Similarity],
    objects: Sequence[ObjectInfo],
    *,
    extents: Sequence[np.ndarray] | None = None,
    boxes: Sequence[np.ndarray | None] | None = None,
    colours: Sequence[tuple[int, int, int]] = PALETTE,
    height: int | None = None,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The photo with the outline, the axes and the 3-D box of every object at its pose (``camera_from_object``).

    ``boxes`` are lowest and highest corners in model units, of objects whose box is not that of their mesh.

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
        sides = None if extents is None else np.asarray(extents[i])
        box = None if boxes is None else boxes[i]
        _draw_object(image, K, poses[i], objects[i], sides, box, colours[i % len(colours)])
    return image


def name_estimate(name: str, estimate: PoseEstimate) -> str:
    """The label of an object in a picture, in one line: its name, its confidence, and whether it is only a guess."""
    guess = "" if bool(estimate.present) else ", a guess"
    return f"{' '.join(name.split())} {float(estimate.confidence):.2f}{guess}"


def draw_mask(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h2 w2"], label: str, colour: tuple[int, int, int]
) -> None:
    """Draw into an image a dotted outline of a mask, which may be of another size, and a label above it."""
    height, width = image.shape[:2]
    enlarged = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(enlarged, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    stroke = max(round(height / 450), 1)
    for contour in contours:
        for x, y in contour[:: 5 * stroke, 0]:
            cv2.circle(image, (int(x), int(y)), stroke, colour, -1, cv2.LINE_AA)
    x, y, _, _ = cv2.boundingRect(enlarged)
    canvas = Image.fromarray(image)
    pen = ImageDraw.Draw(canvas)
    place = (x, max(y - 4 * stroke, 12 * stroke))
    pen.text(place, label, colour, find_font(10 * stroke), "lb", stroke_width=2, stroke_fill=(10, 10, 10))
    image[:] = np.asarray(canvas)


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
    start, end = to_fixed_point(a), to_fixed_point(b)
    cv2.line(image, start, end, (10, 10, 10), width + 2, cv2.LINE_AA, 4)
    cv2.line(image, start, end, colour, width, cv2.LINE_AA, 4)


def _draw_object(image, K, pose: Similarity, info: ObjectInfo, extents, box, colour) -> None:
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
    if box is not None:
        low, high = np.asarray(box, np.float64)
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
                    _line(soft, pixels[a], pixels[b], INK, 1)
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
                    (x, y),
                    "xyz"[axis],
                    _AXES[axis],
                    find_font(8 * stroke),
                    "mm",
                    stroke_width=2,
                    stroke_fill=(10, 10, 10),
                )
        image[:] = np.asarray(canvas)
