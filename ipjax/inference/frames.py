"""Query frames: one RGB-D image and the object's mask or box become a crop with depth in metres.

All of it is NumPy and OpenCV on the host, a few milliseconds for 640 × 480; the result holds JAX arrays.
"""

import logging
from typing import Any, Literal

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ipjax.cameras import crop as crop_camera
from ipjax.cameras import (
    crop_pixels,
    look_at,
    middle,
    mostly,
    project,
    resize,
    resize_pixels,
    subsample_pixels,
    turn,
    unproject,
)
from ipjax.files.cameras.intrinsics import Intrinsics, check_depth_scale, list_misfits
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.images.arrays import as_native
from ipjax.files.images.depth import remove_sentinel
from ipjax.files.images.masks import as_mask, check_mask
from ipjax.records import Camera, Similarity, View

Background = Literal["black", "grey", "keep"]
Crop = Literal["square", "look_at"]

_FILL = {"black": 0.0, "grey": 0.5}
log = logging.getLogger("ipjax")

_SMALL = 200  # pixels of a mask below which people are told
_NEAREST, _FARTHEST = 0.01, 30.0  # metres; a median depth outside is taken for a wrong unit


def frame(
    rgb: Any,
    depth: Any,
    mask: Any,
    camera: Any,
    *,
    box: Any = None,
    depth_scale: float | None = None,
    resolution: int = 224,
    crop: Crop = "square",
    background: Background = "black",
    pad: float = 0.2,
    erosion: int = 2,
    edge_tolerance: float = 0.02,
    drop_outliers: bool = True,
) -> View:
    """Cut the object out of an RGB-D frame and clean its depth.

    Args:
        rgb: height × width × 3 (grey and RGBA are taken too); uint8, uint16 or float in [0, 1].
        depth: height × width along z, aligned to the colour image; float metres, or any unit with `depth_scale`.
            0, NaN, infinite and negative = unknown.
        mask: height × width, the object's visible pixels; None = decide inside `box` by depth.
        camera: `Intrinsics`, `Camera`, 3 × 3 K, or (fx, fy, cx, cy), in pixels. Lens distortion is undistorted first.
        box: (x, y, width, height) in pixels; with a mask, the mask counts only inside it.
        depth_scale: metres per depth unit (0.001 for millimetres); default: the camera file's, else 1 for floats.
        resolution: side of the crop in pixels.
        crop: "square" keeps the camera's axes, so the result's pose is the camera's; "look_at" turns the camera until
            the mask's centre is on its axis: use `frame_turned`, which also says how it was turned.
        background: colour outside the mask: "black", "grey" or "keep".
        pad: the crop's side is (1 + pad) times the longer side of the mask's box.
        erosion: pixels of the mask's rim whose depth is not trusted.
        edge_tolerance: depth that differs by more than this share from most of its 5 × 5 neighbours is a flying pixel.
        drop_outliers: forget depth inside the mask that lies farther from its median than the object can be deep.

    Returns:
        The crop: rgb in [0, 1], depth in metres (0 = unknown; kept outside the mask, where it shows what occludes), the
        mask, and the crop's own camera.

    Raises:
        ValueError: sizes differ, mask or depth is empty, the unit or the camera cannot be right; in words.
    """
    return frame_turned(
        rgb,
        depth,
        mask,
        camera,
        box=box,
        depth_scale=depth_scale,
        resolution=resolution,
        crop=crop,
        background=background,
        pad=pad,
        erosion=erosion,
        edge_tolerance=edge_tolerance,
        drop_outliers=drop_outliers,
    )[0]


def frame_turned(
    rgb: Any,
    depth: Any,
    mask: Any,
    camera: Any,
    *,
    box: Any = None,
    depth_scale: float | None = None,
    resolution: int = 224,
    crop: Crop = "look_at",
    background: Background = "black",
    pad: float = 0.2,
    erosion: int = 2,
    edge_tolerance: float = 0.02,
    drop_outliers: bool = True,
) -> tuple[View, Similarity]:
    """`frame`, and how the crop's camera was turned.

    Returns:
        The crop and ``camera_from_crop``, a rotation: ``camera_from_crop`` after an estimated ``crop_from_object`` is
        ``camera_from_object``. It is the identity for a square crop.

    Raises:
        ValueError: as `frame`.
    """
    if crop not in ("square", "look_at"):
        raise ValueError(f"crop must be 'square' or 'look_at', not {crop!r}")
    if background not in ("black", "grey", "keep"):
        raise ValueError(f"background must be 'black', 'grey' or 'keep', not {background!r}")
    if not (isinstance(resolution, int | np.integer) and 14 <= resolution <= 4096):
        raise ValueError(f"the resolution must be a whole number of pixels from 14 to 4096, not {resolution!r}")
    if not (isinstance(erosion, int | np.integer) and erosion >= 0):
        raise ValueError(f"erosion must be a whole number of pixels from 0 on, not {erosion!r}")
    for name, value in (("pad", pad), ("edge_tolerance", edge_tolerance)):
        if not (np.ndim(value) == 0 and np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be a finite number from 0 on, not {value!r}")
    intrinsics = as_intrinsics(camera)
    rgb = _check_rgb(rgb)
    height, width = rgb.shape[:2]
    depth = as_native(np.asarray(np.ma.filled(depth, 0)))  # what a masked array masks is unknown
    depth = depth[..., 0] if depth.ndim == 3 and depth.shape[-1] == 1 else depth
    if depth.shape != (height, width):
        raise ValueError(
            f"rgb is {width} × {height} but depth is {_size_in_words(depth)}; align the depth to the colour image first"
        )
    if intrinsics.size is not None and intrinsics.size != (width, height):
        raise ValueError(
            f"the camera is for images of {intrinsics.size[0]} × {intrinsics.size[1]}, but rgb is {width} × {height}"
        )
    if depth.dtype.kind not in "uif":
        raise ValueError(f"depth must be numbers, not {depth.dtype}")
    if mask is None and box is None:
        raise ValueError("a mask or a box must say where the object is")
    region = None if box is None else _check_box(box, width, height)
    if mask is not None:
        mask = as_mask(mask)
        if mask.shape != (height, width):
            raise ValueError(f"rgb is {width} × {height} but the mask is {_size_in_words(mask)}")
        if not mask.any():
            raise ValueError("the mask is empty")
        if region is None:
            check_mask(mask)
        if 0 < mask.sum() < _SMALL:
            log.warning("the mask has fewer than %d pixels: no pose can be exact", _SMALL)
    for misfit in list_misfits(intrinsics, width, height):
        log.warning("camera: %s", misfit)
    depth, unknown = remove_sentinel(depth)
    if unknown:
        log.info("%s", unknown)
    scale = _depth_scale(depth, depth_scale, intrinsics)

    if intrinsics.distortion:
        rgb, depth, mask, region = _undistort(rgb, depth, mask, region, intrinsics)
    if mask is None:
        assert region is not None
        mask = _near_cluster(depth, scale, region, intrinsics)
    elif region is not None:
        inside = np.zeros_like(mask)
        left, top, right, bottom = region
        inside[top:bottom, left:right] = mask[top:bottom, left:right]
        mask = inside
        if not mask.any():
            raise ValueError("the mask is empty inside the box")
    mask, bounds = _without_specks(np.ascontiguousarray(mask))

    median = _check_unit(depth, mask, bounds, scale)
    cut = _cut_square if crop == "square" else _cut_look_at
    rgb, depth, mask, matrix, rotation = cut(
        rgb, depth, mask, bounds, intrinsics.matrix, scale, resolution, pad, erosion, edge_tolerance
    )
    if drop_outliers:
        # Twice the diagonal of what is seen, and six deviations for things seen end-on.
        seen = mask & (depth > 0)
        if seen.any():
            values = depth[seen]
            centre = np.median(values)
            left, top, right, bottom = bounds
            diagonal = float(np.hypot(right - left, bottom - top)) * median / float(intrinsics.matrix[0, 0])
            reach = max(2 * diagonal, 6 * 1.4826 * float(np.median(np.abs(values - centre))))
            depth[seen & (np.abs(depth - centre) > reach)] = 0
    if not (mask & (depth > 0)).any():
        raise ValueError("no trustworthy depth is left inside the mask")
    if background != "keep":
        rgb[~mask] = _FILL[background]
    view = View(
        rgb=jnp.asarray(rgb),
        depth=jnp.asarray(depth),
        mask=jnp.asarray(mask),
        camera=Camera.from_matrix(matrix),
    )
    return view, Similarity(rotation, np.zeros(3), np.ones(())).to_jax()


def clean_depth(depth: np.ndarray, edge_tolerance: float = 0.02) -> np.ndarray:
    """Set flying pixels to 0: those that few of their 5 × 5 neighbours agree with.

    Args:
        depth: height × width, float32, any unit, 0 = unknown.
        edge_tolerance: neighbours within this share of the depth agree.

    Returns:
        A copy. A pixel stays when at least 7 of its 24 neighbours agree; the corner of a box keeps 8.
    """
    height, width = depth.shape
    around = cv2.copyMakeBorder(depth, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    tolerance = depth * np.float32(edge_tolerance)
    agree = np.zeros(depth.shape, np.uint8)
    difference = np.empty_like(depth)
    for dy in range(5):
        for dx in range(5):
            cv2.absdiff(around[dy : dy + height, dx : dx + width], depth, difference)
            agree += (difference <= tolerance).view(np.uint8)
    return np.where(agree >= 8, depth, np.float32(0))  # it agrees with itself


def sample_depth(
    depth: np.ndarray, x: np.ndarray, y: np.ndarray, edge_tolerance: float = 0.02
) -> Float[np.ndarray, "*n"]:
    """Depth along z where it was not measured: between pixels.

    1 / z is interpolated between the four pixels around, which is exact on a plane. The nearest pixel's depth alone
    would be that of another place, up to half a pixel away, and where an image is halved always to the same side.

    Args:
        depth: height × width, float32, 0 = unknown.
        x, y: places in pixels, of shapes that broadcast; outside the image = the nearest border's.
        edge_tolerance: of four pixels, those within this share of the nearest one are of one surface.

    Returns:
        The depth of the surface that is nearest to the place; 0 where less than half of what is around is known.
    """
    height, width = depth.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    across, down = (x - left).astype(np.float32), (y - top).astype(np.float32)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    near = np.stack([depth[b, a] for b in (top, bottom) for a in (left, right)])
    weight = np.stack([q * p for q in (1 - down, down) for p in (1 - across, across)])
    weight[near <= 0] = 0
    known = weight.sum(0)
    # Where several are equally near, the one that hides the others, so that no side is preferred.
    foremost = np.where(weight >= weight.max(0) - 1e-4, near, np.inf).min(0)
    weight[np.abs(near - foremost) > edge_tolerance * foremost] = 0
    inverse = np.sum(weight / np.maximum(near, 1e-9), axis=0)
    found = known >= 0.5
    return np.where(found, weight.sum(0) / np.where(found, inverse, 1), 0).astype(np.float32)


def _check_rgb(rgb: Any) -> np.ndarray:
    """uint8 or float32 in [0, 1], height × width × 3."""
    rgb = as_native(np.asarray(rgb))
    if rgb.ndim == 2:
        rgb = np.repeat(rgb[..., None], 3, axis=-1)
    if rgb.ndim != 3 or rgb.shape[-1] not in (3, 4) or rgb.size == 0:
        raise ValueError(f"rgb must be height × width × 3, not {' × '.join(map(str, rgb.shape)) or 'a number'}")
    rgb = rgb[..., :3]
    if rgb.dtype == np.uint8:
        return np.ascontiguousarray(rgb)
    if rgb.dtype == np.uint16:
        return rgb.astype(np.float32) / 65535
    if rgb.dtype.kind != "f":
        raise ValueError(f"rgb must be uint8, uint16 or float in [0, 1], not {rgb.dtype}")
    rgb = rgb.astype(np.float32)
    if not np.isfinite(rgb).all():
        raise ValueError("rgb has values that are not finite")
    if rgb.min() < -0.01 or rgb.max() > 1.01:
        raise ValueError(f"rgb as floats must be in [0, 1]; it goes from {rgb.min():g} to {rgb.max():g}")
    return rgb.clip(0, 1)


def _check_box(box: Any, width: int, height: int) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) in whole pixels, inside the image."""
    try:
        values = np.asarray(box, np.float64).reshape(-1)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise ValueError(f"the box must be four numbers (x, y, width, height), not {box!r}")
    x, y, w, h = values
    if w <= 0 or h <= 0:
        raise ValueError(f"the box must be (x, y, width, height) with a positive size, not {w:g} × {h:g}")
    left, top = max(int(np.floor(x)), 0), max(int(np.floor(y)), 0)
    right, bottom = min(int(np.ceil(x + w)), width), min(int(np.ceil(y + h)), height)
    if left >= right or top >= bottom:
        raise ValueError(f"the box ({x:g}, {y:g}, {w:g}, {h:g}) lies outside the image of {width} × {height}")
    return left, top, right, bottom


def _size_in_words(image: np.ndarray) -> str:
    if image.ndim == 2:
        return f"{image.shape[1]} × {image.shape[0]}"
    return " × ".join(map(str, image.shape)) or "a number"


def _depth_scale(depth: np.ndarray, depth_scale: float | None, intrinsics: Intrinsics) -> float:
    scale = depth_scale if depth_scale is not None else intrinsics.depth_scale
    if scale is None:
        if depth.dtype.kind != "f":
            known = depth[depth > 0]
            median = float(np.median(known)) if known.size else 0.0
            raise ValueError(_unit_in_words(median, "depth of whole numbers has no unit", None))
        scale = 1.0
    return check_depth_scale(scale)


def _unit_in_words(median: float, else_say: str, scale: float | None) -> str:
    # A hand-held or table-top scene is 0.1 to 10 m away.
    units = {
        1.0: "metres",
        1e-3: "millimetres",
        1e-4: "tenths of a millimetre",
        1e-2: "centimetres",
        1e-6: "micrometres",
    }
    for unit, name in units.items():
        if 0.1 <= median * unit <= 10:
            asked = f" with depth_scale={scale:g}" if scale not in (None, 1.0) else ""
            return f"median depth {median:.4g}{asked}: this looks like {name}; pass depth_scale={unit:g}"
    return f"median depth {median:.4g}: {else_say}; pass depth_scale, the metres per depth unit"


def _check_unit(depth: np.ndarray, mask: np.ndarray, bounds: tuple[int, int, int, int], scale: float) -> float:
    """The median depth inside the mask in metres, if it can be true."""
    left, top, right, bottom = bounds
    values = depth[top:bottom, left:right][mask[top:bottom, left:right]]
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
    values = values[values > 0]
    if values.size == 0:
        raise ValueError("there is no depth inside the mask")
    raw = float(np.median(values))
    median = raw * scale
    if not _NEAREST <= median <= _FARTHEST:
        raise ValueError(_unit_in_words(raw, f"with depth_scale={scale:g} the object is {median:.3g} m away", scale))
    return median


def _metres(depth: np.ndarray, scale: float) -> np.ndarray:
    """float32 metres, 0 = unknown."""
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is as infinite
        metres = depth.astype(np.float32)
        if scale != 1.0:
            metres *= np.float32(scale)
    if depth.dtype.kind == "f":
        metres[~np.isfinite(metres)] = 0
    return np.maximum(metres, 0)


def _without_specks(mask: np.ndarray) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    """The mask without components below 2 % of the largest, which would blow up the crop; and its bounds."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    keep = np.zeros(count, bool)
    keep[1:] = areas >= 0.02 * areas.max()
    if not keep[1:].all():
        mask = keep[np.asarray(labels, np.int64)]
    boxes = stats[keep]
    left, top = boxes[:, cv2.CC_STAT_LEFT].min(), boxes[:, cv2.CC_STAT_TOP].min()
    right = (boxes[:, cv2.CC_STAT_LEFT] + boxes[:, cv2.CC_STAT_WIDTH]).max()
    bottom = (boxes[:, cv2.CC_STAT_TOP] + boxes[:, cv2.CC_STAT_HEIGHT]).max()
    return mask, (int(left), int(top), int(right), int(bottom))


def _near_cluster(depth: np.ndarray, scale: float, box: tuple[int, int, int, int], camera: Intrinsics) -> np.ndarray:
    """The object inside a box, as a mask: the nearest run of depth that a fair share of the box's middle belongs to."""
    left, top, right, bottom = box
    inside = _metres(depth[top:bottom, left:right], scale)
    known = inside > 0
    if not known.any():
        raise ValueError("there is no depth inside the box")
    height, width = inside.shape
    y = (np.arange(height) + 0.5) / height - 0.5
    x = (np.arange(width) + 0.5) / width - 0.5
    weight = np.exp(-(y[:, None] ** 2 + x[None, :] ** 2) / (2 * 0.25**2))
    order = np.argsort(inside[known], kind="stable")
    values, weights = inside[known][order], weight[known][order]
    middle = values[min(np.searchsorted(np.cumsum(weights), 0.5 * weights.sum()), len(values) - 1)]
    extent = max(width, height) * float(middle) / float(camera.matrix[0, 0])
    gap = max(0.1 * extent, 0.01 * float(middle))
    run = np.concatenate([[0], np.cumsum(np.diff(values) > gap)])
    share = np.bincount(run, weights=weights) / weights.sum()
    chosen = int(np.argmax(share >= min(0.2, share.max())))
    near, far = values[run == chosen][[0, -1]]
    # Where nothing but a table joins object and background, the object is no deeper than its box is large.
    centre = np.median(values[run == chosen])
    near, far = max(near, centre - extent), min(far, centre + extent)
    mask = np.zeros(depth.shape, bool)
    found = known & (inside >= near) & (inside <= far)
    if width > 8 and height > 8:
        opened = cv2.morphologyEx(found.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).view(bool)
        found = opened if opened.any() else found
    mask[top:bottom, left:right] = found
    return mask


def _undistort(rgb: np.ndarray, depth: np.ndarray, mask: np.ndarray | None, region: Any, intrinsics: Intrinsics):
    """Images as the pinhole camera with the same K would have seen them."""
    height, width = rgb.shape[:2]
    K, coefficients = intrinsics.matrix, np.asarray(intrinsics.distortion)
    if intrinsics.lens == "equidistant":
        maps = cv2.fisheye.initUndistortRectifyMap(K, coefficients, np.eye(3), K, (width, height), cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, (width, height), cv2.CV_32FC1)
    rgb = cv2.remap(rgb, maps[0], maps[1], cv2.INTER_LINEAR)
    # Depth is along z, which a lens does not change: it only moves. OpenCV moves no 32-bit integers or doubles.
    depth = depth if depth.dtype in (np.uint8, np.uint16, np.float32) else depth.astype(np.float32)
    depth = cv2.remap(depth, maps[0], maps[1], cv2.INTER_NEAREST)
    if mask is not None:
        mask = cv2.remap(mask.view(np.uint8), maps[0], maps[1], cv2.INTER_NEAREST).view(bool)
        if not mask.any():
            raise ValueError("the mask lies outside the undistorted image")
    if region is not None:
        left, top, right, bottom = region
        inside = np.zeros((height, width), np.uint8)
        inside[top:bottom, left:right] = 1
        rows, columns = np.nonzero(cv2.remap(inside, maps[0], maps[1], cv2.INTER_NEAREST))
        if rows.size == 0:
            raise ValueError("the box lies outside the undistorted image")
        region = (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
    return rgb, depth, mask, region


def _padded(image: np.ndarray, left: int, top: int, side: int) -> np.ndarray:
    """The square of an image whose first pixel is (left, top); zero outside the image."""
    height, width = image.shape[:2]
    right, bottom = left + side, top + side
    inner = image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    if inner.shape[:2] == (side, side):
        return inner
    return cv2.copyMakeBorder(
        inner, max(-top, 0), max(bottom - height, 0), max(-left, 0), max(right - width, 0), cv2.BORDER_CONSTANT, value=0
    )


def _trusted(depth: np.ndarray, mask: np.ndarray, erosion: int, edge_tolerance: float) -> np.ndarray:
    """Depth without flying pixels and without the rim of the mask, as long as that leaves enough."""
    cleaned = clean_depth(depth, edge_tolerance) if edge_tolerance > 0 else depth.copy()
    seen = mask & (depth > 0)
    if (cleaned[seen] > 0).sum() < 0.3 * seen.sum():
        cleaned = depth.copy()  # too noisy or too small to judge
    for pixels in range(erosion, 0, -1):
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
        core = cv2.erode(mask.view(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE).view(bool)
        # A thin object has no core: its rim must do.
        if (core & (cleaned > 0)).sum() >= 0.4 * (mask & (cleaned > 0)).sum():
            return np.where(mask & ~core, np.float32(0), cleaned)
    return cleaned


def _resize(image: np.ndarray, resolution: int) -> np.ndarray:
    shrinks = image.shape[0] > resolution
    return cv2.resize(image, (resolution, resolution), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _to_float(rgb: np.ndarray) -> np.ndarray:
    return rgb.astype(np.float32) * np.float32(1 / 255) if rgb.dtype == np.uint8 else rgb.astype(np.float32)


def _cut_square(rgb, depth, mask, bounds, K, scale, resolution, pad, erosion, edge_tolerance):
    left, top, right, bottom = bounds
    side = max(int(np.ceil((1 + pad) * max(right - left, bottom - top))), 8)
    left, top = round((left + right - side) / 2), round((top + bottom - side) / 2)
    matrix = resize(crop_camera(K, (left, top)), (side, side), (resolution, resolution))
    cover = np.ascontiguousarray(_padded(mask.view(np.uint8), left, top, side))
    cut_rgb = _to_float(_resize(np.ascontiguousarray(_padded(rgb, left, top, side)), resolution))
    cut_mask = mostly(_resize(cover.astype(np.float32), resolution))
    # A large frame has neighbours that are not worth comparing one by one. What lies around the square counts, too.
    step = max(side // (2 * resolution), 1)
    margin = 2 * step
    begin, length = (left - margin, top - margin), side + 2 * margin
    sparse = lambda image: np.ascontiguousarray(_padded(image, *begin, length)[::step, ::step])
    piece = _trusted(_metres(sparse(depth), scale), sparse(mask.view(np.uint8)).view(bool), erosion, edge_tolerance)
    # Where the centre of each crop pixel lies: in the square, in the image, in the piece.
    pixels = np.repeat(np.arange(resolution, dtype=np.float64)[:, None], 2, axis=1)
    pixels = crop_pixels(resize_pixels(pixels, (resolution, resolution), (side, side)), (-left, -top))
    x, y = subsample_pixels(pixels, step, begin).T
    return cut_rgb, sample_depth(piece, x[None, :], y[:, None], edge_tolerance), cut_mask, matrix, np.eye(3)


def _cut_look_at(rgb, depth, mask, bounds, K, scale, resolution, pad, erosion, edge_tolerance):
    left, top, right, bottom = bounds
    corners = np.array([[left, top], [right - 1, top], [left, bottom - 1], [right - 1, bottom - 1]], np.float64)
    camera_from_crop = look_at(K, corners.mean(0))
    crop_from_camera = camera_from_crop.T
    rays = unproject(K, corners, np.ones(4))
    half = (1 + pad) * np.abs(project(np.eye(3), rays @ crop_from_camera.T)).max()
    focal = resolution / 2 / half
    cx, cy = middle(resolution, resolution)
    matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])

    # Depth is cleaned where it was measured, then looked up.
    margin = max(int(0.25 * max(right - left, bottom - top)), 8)
    height, width = mask.shape
    x0, y0 = max(left - 2 * margin, 0), max(top - 2 * margin, 0)
    x1, y1 = min(right + 2 * margin, width), min(bottom + 2 * margin, height)
    piece = _metres(np.ascontiguousarray(depth[y0:y1, x0:x1]), scale)
    cover = np.ascontiguousarray(mask[y0:y1, x0:x1])
    piece = _trusted(piece, cover, erosion, edge_tolerance)

    image_from_crop = turn(K, camera_from_crop, matrix)
    zoom = focal / float(np.sqrt(K[0, 0] * K[1, 1]))
    many = max(int(np.ceil(1 / zoom - 0.25)), 1)  # samples per crop pixel and axis, averaged when shrinking
    size = (resolution * many, resolution * many)
    image_from_fine = image_from_crop @ resize(np.eye(3), size, (resolution, resolution))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cut_rgb = _to_float(_resize(cv2.warpPerspective(rgb, image_from_fine, size, flags=flags), resolution))
    piece_from_image = crop_camera(np.eye(3), (x0, y0))
    soft = cv2.warpPerspective(cover.astype(np.float32), piece_from_image @ image_from_fine, size, flags=flags)
    cut_mask = mostly(_resize(soft, resolution))
    # Depth where each crop pixel looks, and then along the new axis. Beyond the piece nothing is known.
    y, x = np.indices((resolution, resolution))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ (piece_from_image @ image_from_crop).T
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    x_middle, y_middle = middle(x1 - x0, y1 - y0)
    inside = (rays[..., 2] > 0) & (np.abs(x - x_middle) <= (x1 - x0) / 2) & (np.abs(y - y_middle) <= (y1 - y0) / 2)
    seen = unproject(crop_camera(K, (x0, y0)), np.stack([x, y], -1), np.ones_like(x))
    cut_depth = sample_depth(piece, x, y, edge_tolerance) * (seen @ crop_from_camera[2]).astype(np.float32)
    cut_depth = np.where(inside, cut_depth, np.float32(0))
    return cut_rgb, cut_depth, cut_mask, matrix, camera_from_crop
