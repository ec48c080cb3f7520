"""An RGB-D image as users have it, checked: sizes that fit and values that can be; or refused in words."""

from typing import Any

import numpy as np

from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.images.arrays import as_native


def check_images(rgb: Any, depth: Any, intrinsics: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Colour as uint8 or float32 in [0, 1], height × width × 3, and depth of that size, numbers of any unit.

    Raises:
        ValueError: they are no such images, or their sizes and the camera's differ; in words.
    """
    rgb = check_rgb(rgb)
    height, width = rgb.shape[:2]
    depth = as_native(np.asarray(np.ma.filled(depth, 0)))  # what a masked array masks is unknown
    depth = depth[..., 0] if depth.ndim == 3 and depth.shape[-1] == 1 else depth
    if depth.shape != (height, width):
        raise ValueError(
            f"rgb is {width} × {height} but depth is {size_in_words(depth)}; align the depth to the colour image first"
        )
    if intrinsics.size is not None and intrinsics.size != (width, height):
        raise ValueError(
            f"the camera is for images of {intrinsics.size[0]} × {intrinsics.size[1]}, but rgb is {width} × {height}"
        )
    if depth.dtype.kind not in "uif":
        raise ValueError(f"depth must be numbers, not {depth.dtype}")
    return rgb, depth


def check_rgb(rgb: Any) -> np.ndarray:
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


def size_in_words(image: np.ndarray) -> str:
    """Width × height, as people say it."""
    if image.ndim == 2:
        return f"{image.shape[1]} × {image.shape[0]}"
    return " × ".join(map(str, image.shape)) or "a number"
