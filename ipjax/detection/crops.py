"""The crops of a frame's proposals: each cut out once, described once, and shared by all objects."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ipjax.detection.signatures import Signature
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.images.depth import remove_sentinel
from ipjax.inference.cutting import undistort_frame
from ipjax.inference.depth import check_frame_unit, find_depth_scale, to_metres
from ipjax.inference.frames import cut_object
from ipjax.inference.images import check_images
from ipjax.records import Patches, Similarity, View

_DISC = 3  # pixels about a click that are undistorted with it


@dataclasses.dataclass(frozen=True)
class Scene:
    """An RGB-D frame, checked and without lens distortion: what proposals are cut out of."""

    rgb: np.ndarray  # uint8, height × width × 3
    depth: np.ndarray  # float32, metres; 0 = unknown
    matrix: np.ndarray  # K, pixels


@dataclasses.dataclass
class Crop:
    """A mask cut out of a frame; what is computed of it is kept."""

    mask: np.ndarray  # of the frame
    view: View
    camera_from_crop: Similarity
    patches: Patches | None = None
    signature: Signature | None = None


def read_scene(rgb: Any, depth: Any, camera: Any, depth_scale: float | None = None) -> Scene:
    """Check a frame as `ipjax.frame` does, and undistort it.

    Raises:
        ValueError: sizes differ, the unit of the depth is not known or cannot be right, or there is no depth; in words.
    """
    intrinsics = as_intrinsics(camera)
    if depth is None:
        raise ValueError("there is no depth image: objects are sought, and masks are mended, by depth")
    rgb, depth = check_images(rgb, depth, intrinsics)
    if rgb.dtype != np.uint8:  # proposals look at colours of eight bits
        rgb = (rgb * 255 + 0.5).astype(np.uint8)
    depth, _ = remove_sentinel(depth)
    scale = find_depth_scale(depth, depth_scale, intrinsics)
    check_frame_unit(depth, scale)
    metres = to_metres(depth, scale)
    metres = np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)
    if not metres.any():
        raise ValueError("the depth image is empty: objects are sought, and masks are mended, by depth")
    if intrinsics.distortion:
        rgb, metres, _, _ = undistort_frame(rgb, metres, None, None, intrinsics)
    return Scene(rgb, metres, np.asarray(intrinsics.matrix, np.float64))


def cut_crop(scene: Scene, mask: np.ndarray, **options: Any) -> Crop | None:
    """A mask cut out of the frame; None where no trustworthy depth is in it.

    ``options``: of `ipjax.inference.frames.cut_object`.
    """
    if not mask.any():
        return None
    try:
        view, camera_from_crop = cut_object(scene.rgb, scene.depth, np.ascontiguousarray(mask), scene.matrix, **options)
    except ValueError:
        return None
    return Crop(mask, view, camera_from_crop)


def undistort_mask(mask: np.ndarray, camera: Any) -> np.ndarray:
    """A mask of an image as `read_scene` has it, without the lens' distortion."""
    intrinsics = as_intrinsics(camera)
    if not intrinsics.distortion:
        return mask
    depth = np.zeros(mask.shape, np.float32)
    _, _, plain, _ = undistort_frame(np.zeros((*mask.shape, 3), np.uint8), depth, mask, None, intrinsics)
    assert plain is not None  # a mask was given
    return plain


def undistort_pixel(pixel: Sequence[int | float], camera: Any, size: tuple[int, int]) -> tuple[float, float]:
    """Where a pixel (x, y) of a height × width image is in the image without lens distortion.

    Raises:
        ValueError: these are no two numbers, or no pixel of the image; in words.
    """
    height, width = size
    place = np.asarray(pixel, np.float64)
    shown = ", ".join(f"{value:g}" for value in place.reshape(-1))
    if place.shape != (2,):
        raise ValueError(f"a click is x, y in pixels, not {shown or 'nothing'}")
    x, y = place.tolist()
    if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
        raise ValueError(f"the click ({shown}) lies outside the image of {width} × {height} pixels")
    intrinsics = as_intrinsics(camera)
    if not intrinsics.distortion:
        return x, y
    rows, columns = np.indices(size)
    disc = (rows - y) ** 2 + (columns - x) ** 2 <= _DISC**2  # pixels are moved backwards: this one alone could be lost
    try:
        found = undistort_mask(disc, camera)
    except ValueError:
        raise ValueError(f"the click ({shown}) lies outside the undistorted image") from None
    return float(np.nonzero(found)[1].mean()), float(np.nonzero(found)[0].mean())
