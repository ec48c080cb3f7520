"""The crops of a frame's proposals: each cut out once, described once, and shared by all objects."""

import dataclasses
from typing import Any

import numpy as np

from ipjax.detection.signatures import Signature
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.images.arrays import as_native
from ipjax.files.images.depth import remove_sentinel
from ipjax.inference.cutting import undistort_frame
from ipjax.inference.depth import check_frame_unit, find_depth_scale, to_metres
from ipjax.inference.frames import cut_object
from ipjax.records import Patches, Similarity, View


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
    rgb = as_native(np.asarray(rgb))
    rgb = np.repeat(rgb[..., None], 3, axis=-1) if rgb.ndim == 2 else rgb
    if rgb.ndim != 3 or rgb.shape[-1] not in (3, 4) or rgb.size == 0:
        raise ValueError(f"rgb must be height × width × 3, not {' × '.join(map(str, rgb.shape)) or 'a number'}")
    rgb = rgb[..., :3]
    if rgb.dtype == np.uint16:
        rgb = (rgb >> 8).astype(np.uint8)
    elif rgb.dtype.kind == "f":
        if not np.isfinite(rgb).all() or rgb.min() < -0.01 or rgb.max() > 1.01:
            raise ValueError("rgb as floats must be finite and in [0, 1]")
        rgb = (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
    elif rgb.dtype != np.uint8:
        raise ValueError(f"rgb must be uint8, uint16 or float in [0, 1], not {rgb.dtype}")
    rgb = np.ascontiguousarray(rgb)
    height, width = rgb.shape[:2]
    if depth is None:
        raise ValueError("there is no depth image: objects are sought, and masks are mended, by depth")
    depth = as_native(np.asarray(np.ma.filled(depth, 0)))
    depth = depth[..., 0] if depth.ndim == 3 and depth.shape[-1] == 1 else depth
    if depth.shape != (height, width):
        raise ValueError(f"rgb is {width} × {height}, but depth is {' × '.join(map(str, depth.shape[::-1]))}")
    if depth.dtype.kind not in "uif":
        raise ValueError(f"depth must be numbers, not {depth.dtype}")
    if intrinsics.size is not None and intrinsics.size != (width, height):
        raise ValueError(
            f"the camera is for images of {intrinsics.size[0]} × {intrinsics.size[1]}, but rgb is {width} × {height}"
        )
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
