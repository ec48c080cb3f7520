"""Pinhole geometry: projecting, lifting, and what becomes of a camera when its image is cropped, resized, subsampled or
turned.

Pixel centres are integers (OpenCV, BOP). Only this module handles the half pixel that follows from it: code that
changes an image calls :func:`crop`, :func:`resize` or :func:`subsample` for its camera, and :func:`crop_pixels` and so
on for pixels; code that measures from the edges of pixels gets :func:`borders`. Sizes and places are (x, y): width
first. A camera is a :class:`Camera` in the graph, or a 3 × 3 matrix K in NumPy on the host.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ipjax.records import Camera
from ipjax.transforms import rotation_from_vector

Pinhole = TypeVar("Pinhole", Camera, np.ndarray)  # a camera in the graph, or a 3 × 3 matrix K on the host
Pixels = TypeVar("Pixels", jax.Array, np.ndarray)
Pair = tuple[int | float, int | float]  # (x, y)


def project(camera: Pinhole, points: Float[Pixels, "*b n 3"]) -> Float[Pixels, "*b n 2"]:
    """Pixel coordinates (x, y) of points in the camera frame; points at or behind the camera stay finite."""
    xp, focal, centre = _parts(camera)
    ahead = xp.maximum(points[..., 2:], 1e-6)
    return focal[..., None, :] * points[..., :2] / ahead + centre[..., None, :]


def unproject(
    camera: Pinhole, pixels: Float[Pixels, "*b n 2"], depth: Float[Pixels, "*b n"]
) -> Float[Pixels, "*b n 3"]:
    """Points in the camera frame of pixels (x, y) with depth along z (any unit; the points get the same)."""
    xp, focal, centre = _parts(camera)
    rays = (pixels - centre[..., None, :]) / focal[..., None, :]
    return xp.concatenate([rays * depth[..., None], depth[..., None]], axis=-1)


def pixel_grid(height: int, width: int) -> Float[Array, "h w 2"]:
    """Coordinates (x, y) of every pixel centre."""
    rows, columns = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    return jnp.stack([columns, rows], axis=-1).astype(jnp.float32)


def point_map(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """A depth image as one 3-D point per pixel, in the camera frame; depth 0 gives the origin."""
    height, width = depth.shape
    pixels = pixel_grid(height, width).reshape(-1, 2).astype(depth.dtype)
    return unproject(camera, pixels, depth.reshape(-1)).reshape(height, width, 3)


def crop(camera: Pinhole, first: Pair) -> Pinhole:
    """The camera of the part of an image that begins at pixel ``first``, which may lie outside."""
    return _change(camera, *_cropping(first))


def resize(camera: Pinhole, before: Pair, after: Pair) -> Pinhole:
    """The camera of an image that was resized; ``before`` and ``after``: its width and height.

    OpenCV's INTER_AREA and INTER_LINEAR resize so, and PIL: the borders of both images are the same. INTER_NEAREST does
    not: it moves the image by up to half a pixel of the smaller one.
    """
    return _change(camera, *_resizing(before, after))


def subsample(camera: Pinhole, step: Pair | int, first: Pair = (0, 0)) -> Pinhole:
    """The camera of the pixels ``first``, ``first + step``, ``first + 2 step`` …: ``image[first::step]``."""
    return _change(camera, *_subsampling(step, first))


def look_at(camera: Float[np.ndarray, "3 3"], pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3 3"]:
    """The least turn after which the camera looks along the ray of a pixel (x, y): ``camera_from_turned``."""
    axis = unproject(camera, np.asarray(pixel, np.float64)[None], np.ones(1))[0]
    axis = axis / np.linalg.norm(axis)
    about = np.cross([0.0, 0.0, 1.0], axis)
    sine = np.linalg.norm(about)
    return rotation_from_vector(about / max(sine, 1e-300) * np.arctan2(sine, axis[2]))


def turn(
    camera: Float[np.ndarray, "3 3"], camera_from_turned: Float[np.ndarray, "3 3"], turned: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """The homography from the pixels of a turned camera's image to those of the camera that see the same.

    Args:
      camera: K.
      camera_from_turned: the rotation; the cameras stand in the same place.
      turned: K of the turned camera, whose image may have another size and scale.

    Returns:
      H, with ``(x, y, 1) ~ H (x', y', 1)``; a third coordinate that is not positive is of a ray behind the camera.
    """
    return camera @ camera_from_turned @ np.linalg.inv(turned)


def middle(width: int | float, height: int | float) -> Float[np.ndarray, "2"]:
    """Where the middle of an image is: the centre of a camera that looks straight through it."""
    return np.array([(width - 1) / 2, (height - 1) / 2])


def borders(camera: Float[np.ndarray, "*b 3 3"], width: int, height: int) -> Float[np.ndarray, "*b 4"]:
    """Left, right, bottom and top of an image at depth 1, y up and looking along −z: the frustum as OpenGL wants it.

    OpenGL, and MuJoCo with it, measures from the edges of pixels: half a pixel before the first centre, half a pixel
    behind the last.
    """
    fx, fy, cx, cy = camera[..., 0, 0], camera[..., 1, 1], camera[..., 0, 2], camera[..., 1, 2]
    sides = [-(cx + 0.5) / fx, (width - 0.5 - cx) / fx, -(height - 0.5 - cy) / fy, (cy + 0.5) / fy]
    return np.stack(sides, axis=-1)


def crop_pixels(pixels: Pixels, first: Pair) -> Pixels:
    """Where pixels ``… 2`` of an image lie in its part that begins at pixel ``first``."""
    return _move(pixels, *_cropping(first))


def resize_pixels(pixels: Pixels, before: Pair, after: Pair) -> Pixels:
    """Where pixels ``… 2`` of an image lie once it was resized."""
    return _move(pixels, *_resizing(before, after))


def subsample_pixels(pixels: Pixels, step: Pair | int, first: Pair = (0, 0)) -> Pixels:
    """Where pixels ``… 2`` of an image lie in ``image[first::step]``."""
    return _move(pixels, *_subsampling(step, first))


# Each of the three moves pixels by a map that is affine on either axis: zoom · pixel + shift.


def _cropping(first):
    return np.ones(2), -np.asarray(first, np.float64)


def _resizing(before, after):
    if min(*before, *after) <= 0:
        raise ValueError(f"the sizes of images are positive, not {before} and {after}")
    zoom = np.asarray(after, np.float64) / np.asarray(before, np.float64)
    return zoom, 0.5 * zoom - 0.5  # the borders stay, at −½ and at the size less ½


def _subsampling(step, first):
    if np.min(step) <= 0:
        raise ValueError(f"the step between pixels is positive, not {step}")
    zoom = 1 / np.broadcast_to(np.asarray(step, np.float64), 2)
    return zoom, -zoom * np.asarray(first, np.float64)


def _move(pixels, zoom, shift):
    pixels = _in_floats(pixels)
    return pixels * zoom.astype(pixels.dtype) + shift.astype(pixels.dtype)


def _in_floats(values: Any) -> Any:
    """Whole numbers, such as indices of pixels, as floats: half pixels have no place in them."""
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float64 if isinstance(values, np.ndarray) else jnp.float32)
    return values


def _change(camera: Any, zoom: np.ndarray, shift: np.ndarray) -> Any:
    if isinstance(camera, Camera):
        focal = _in_floats(camera.focal)
        return Camera(focal * zoom.astype(focal.dtype), _move(camera.centre, zoom, shift))
    return np.array([[zoom[0], 0, shift[0]], [0, zoom[1], shift[1]], [0, 0, 1]]) @ camera


def _parts(camera: Any) -> tuple[Any, Any, Any]:
    """NumPy or JAX, the focal lengths, and the centre."""
    if isinstance(camera, Camera):
        return jnp, camera.focal, camera.centre
    return np, camera[..., [0, 1], [0, 1]], camera[..., :2, 2]


def mask_from_coverage(cover: Float[Array, "h w"] | Float[np.ndarray, "h w"]) -> Any:
    """The pixels that an object covers by at least half, as booleans: a mask again, after a mask was averaged.

    Many pixels are covered by exactly half where an image was halved. Every other one of them counts: if all did, the
    mask would grow by a quarter of a pixel on every side.
    """
    height, width = cover.shape
    odd = np.indices((height, width)).sum(0) % 2
    return cover > np.where(odd, 0.501, 0.499).astype(cover.dtype)
