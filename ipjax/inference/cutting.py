"""The crop of a frame around the object, with its depth and its camera: along the optical axis, or turned to it."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from ipjax.cameras import crop as crop_camera
from ipjax.cameras import (
    crop_pixels,
    look_at,
    mask_from_coverage,
    middle,
    project,
    resize,
    resize_pixels,
    subsample_pixels,
    turn,
    unproject,
)
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.inference.depth import drop_untrusted, sample_depth, to_metres


def cut_square(rgb, depth, mask, bounds, K, scale, resolution, pad, erosion, edge_tolerance):
    """The square around the mask's ``bounds`` (left, top, right, bottom), seen along the camera's own axes.

    Returns rgb in [0, 1], depth in metres (``scale`` metres per unit), mask, the crop's K, and the identity.
    """
    left, top, right, bottom = bounds
    side = max(int(np.ceil((1 + pad) * max(right - left, bottom - top))), 8)
    left, top = round((left + right - side) / 2), round((top + bottom - side) / 2)
    matrix = resize(crop_camera(K, (left, top)), (side, side), (resolution, resolution))
    cover = np.ascontiguousarray(_padded(mask.view(np.uint8), left, top, side))
    cut_rgb = _to_float(_resize(np.ascontiguousarray(_padded(rgb, left, top, side)), resolution))
    cut_mask = mask_from_coverage(_resize(cover.astype(np.float32), resolution))
    # Cleaning compares neighbouring pixels, which is slow on a large frame: only the square and a margin are cleaned.
    step = max(side // (2 * resolution), 1)
    margin = 2 * step
    begin, length = (left - margin, top - margin), side + 2 * margin
    sparse = lambda image: np.ascontiguousarray(_padded(image, *begin, length)[::step, ::step])
    piece = drop_untrusted(
        to_metres(sparse(depth), scale), sparse(mask.view(np.uint8)).view(bool), erosion, edge_tolerance
    )
    # Where the centre of each crop pixel lies: in the square, in the image, in the piece.
    pixels = np.repeat(np.arange(resolution, dtype=np.float64)[:, None], 2, axis=1)
    pixels = crop_pixels(resize_pixels(pixels, (resolution, resolution), (side, side)), (-left, -top))
    x, y = subsample_pixels(pixels, step, begin).T
    return cut_rgb, sample_depth(piece, x[None, :], y[:, None], edge_tolerance), cut_mask, matrix, np.eye(3)


def cut_look_at(rgb, depth, mask, bounds, K, scale, resolution, pad, erosion, edge_tolerance):
    """As `cut_square`, seen by the camera turned until the mask's centre is on its optical axis.

    Depth is along the new axis; the last value returned is the rotation ``camera_from_crop``.
    """
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
    piece = to_metres(np.ascontiguousarray(depth[y0:y1, x0:x1]), scale)
    cover = np.ascontiguousarray(mask[y0:y1, x0:x1])
    piece = drop_untrusted(piece, cover, erosion, edge_tolerance)

    image_from_crop = turn(K, camera_from_crop, matrix)
    zoom = focal / float(np.sqrt(K[0, 0] * K[1, 1]))
    many = max(int(np.ceil(1 / zoom - 0.25)), 1)  # samples per crop pixel and axis, averaged when shrinking
    size = (resolution * many, resolution * many)
    image_from_fine = image_from_crop @ resize(np.eye(3), size, (resolution, resolution))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cut_rgb = _to_float(_resize(cv2.warpPerspective(rgb, image_from_fine, size, flags=flags), resolution))
    piece_from_image = crop_camera(np.eye(3), (x0, y0))
    soft = cv2.warpPerspective(cover.astype(np.float32), piece_from_image @ image_from_fine, size, flags=flags)
    cut_mask = mask_from_coverage(_resize(soft, resolution))
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


def undistort_pixels(pixels: Float[np.ndarray, "n 2"], intrinsics: Intrinsics) -> Float[np.ndarray, "n 2"]:
    """Where pixels (x, y) of an image lie in that of the pinhole camera with the same K."""
    K, coefficients = intrinsics.matrix, np.asarray(intrinsics.distortion)
    if not coefficients.size or not len(pixels):
        return np.asarray(pixels, np.float64)
    given = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
    # OpenCV's usual five rounds stop far off at the rim.
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    change = cv2.fisheye.undistortPoints if intrinsics.lens == "equidistant" else cv2.undistortPoints
    return change(given, K, coefficients, R=np.eye(3), P=K, criteria=until).reshape(-1, 2)


def undistort_frame(rgb: np.ndarray, depth: np.ndarray, mask: np.ndarray | None, region: Any, intrinsics: Intrinsics):
    """Images as the pinhole camera with the same K would have seen them; the region is (left, top, right, bottom).

    Raises ValueError where the mask or the region does not reach the undistorted image.
    """
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


def _resize(image: np.ndarray, resolution: int) -> np.ndarray:
    shrinks = image.shape[0] > resolution
    return cv2.resize(image, (resolution, resolution), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _to_float(rgb: np.ndarray) -> np.ndarray:
    return rgb.astype(np.float32) * np.float32(1 / 255) if rgb.dtype == np.uint8 else rgb.astype(np.float32)
