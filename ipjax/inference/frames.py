"""Query frames: one RGB-D image and the object's mask or box become a crop with depth in metres.

All of it is NumPy and OpenCV on the host, a few milliseconds for 640 × 480; the result holds JAX arrays.
"""

import logging
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from ipjax.files.cameras.intrinsics import list_misfits
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.images.depth import remove_sentinel
from ipjax.files.images.masks import as_mask, check_mask
from ipjax.inference.cutting import cut_look_at, cut_square, undistort_frame
from ipjax.inference.depth import check_depth_unit, find_depth_scale
from ipjax.inference.images import check_images, size_in_words
from ipjax.inference.masks import drop_specks, find_nearest_object
from ipjax.records import Camera, Similarity, View

Background = Literal["black", "grey", "keep"]
Crop = Literal["square", "look_at"]

log = logging.getLogger("ipjax")

_FILL = {"black": 0.0, "grey": 0.5}
_SMALL = 200  # pixels of a mask below which a warning is logged


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
            the mask's centre is on its axis: use `frame_turned`, which also returns that rotation.
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
    rgb, depth = check_images(rgb, depth, intrinsics)
    height, width = rgb.shape[:2]
    if mask is None and box is None:
        raise ValueError("a mask or a box must say where the object is")
    region = None if box is None else _check_box(box, width, height)
    if mask is not None:
        mask = as_mask(mask)
        if mask.shape != (height, width):
            raise ValueError(f"rgb is {width} × {height} but the mask is {size_in_words(mask)}")
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
    scale = find_depth_scale(depth, depth_scale, intrinsics)

    if intrinsics.distortion:
        rgb, depth, mask, region = undistort_frame(rgb, depth, mask, region, intrinsics)
    if mask is None:
        assert region is not None
        mask = find_nearest_object(depth, scale, region, intrinsics)
    elif region is not None:
        inside = np.zeros_like(mask)
        left, top, right, bottom = region
        inside[top:bottom, left:right] = mask[top:bottom, left:right]
        mask = inside
        if not mask.any():
            raise ValueError("the mask is empty inside the box")
    return cut_object(
        rgb,
        depth,
        np.ascontiguousarray(mask),
        intrinsics.matrix,
        scale,
        resolution=resolution,
        crop=crop,
        background=background,
        pad=pad,
        erosion=erosion,
        edge_tolerance=edge_tolerance,
        drop_outliers=drop_outliers,
    )


def cut_object(
    rgb: np.ndarray,
    depth: np.ndarray,
    mask: np.ndarray,
    matrix: np.ndarray,
    scale: float = 1.0,
    *,
    resolution: int = 224,
    crop: Crop = "square",
    background: Background = "black",
    pad: float = 0.2,
    erosion: int = 2,
    edge_tolerance: float = 0.02,
    drop_outliers: bool = True,
) -> tuple[View, Similarity]:
    """`frame_turned` for images that were checked and undistorted before: many masks of one frame are cut out of it.

    Args:
        rgb: uint8 or float32 in [0, 1], height × width × 3.
        depth: in units of ``scale`` metres; 0 = unknown.
        mask: bool, not empty.
        matrix: K, pixels.

    Raises:
        ValueError: there is no depth to be trusted inside the mask, or no object can be that near or far.
    """
    mask, bounds = drop_specks(mask)
    median = check_depth_unit(depth, mask, bounds, scale)
    cut = cut_square if crop == "square" else cut_look_at
    rgb, depth, mask, crop_matrix, rotation = cut(
        rgb, depth, mask, bounds, matrix, scale, resolution, pad, erosion, edge_tolerance
    )
    if drop_outliers:
        # Twice the diagonal of what is seen, and six deviations for things seen end-on.
        seen = mask & (depth > 0)
        if seen.any():
            values = depth[seen]
            centre = np.median(values)
            left, top, right, bottom = bounds
            diagonal = float(np.hypot(right - left, bottom - top)) * median / float(matrix[0, 0])
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
        camera=Camera.from_matrix(crop_matrix),
    )
    return view, Similarity(rotation, np.zeros(3), np.ones(())).to_jax()


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
