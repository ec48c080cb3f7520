"""Pinhole geometry: projecting, lifting, and the cameras of crops. Pixel centres are integers (OpenCV, BOP)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ipjax.types import Camera


def project(camera: Camera, points: Float[Array, "*b n 3"]) -> Float[Array, "*b n 2"]:
    """Pixel coordinates (x, y) of points in the camera frame; points at or behind the camera stay finite."""
    ahead = jnp.maximum(points[..., 2:], 1e-6)
    return camera.focal[..., None, :] * points[..., :2] / ahead + camera.centre[..., None, :]


def unproject(camera: Camera, pixels: Float[Array, "*b n 2"], depth: Float[Array, "*b n"]) -> Float[Array, "*b n 3"]:
    """Points in the camera frame of pixels (x, y) with depth along z (any unit; the points get the same)."""
    rays = (pixels - camera.centre[..., None, :]) / camera.focal[..., None, :]
    return jnp.concatenate([rays * depth[..., None], depth[..., None]], axis=-1)


def pixel_grid(height: int, width: int) -> Float[Array, "h w 2"]:
    """Coordinates (x, y) of every pixel centre."""
    rows, columns = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    return jnp.stack([columns, rows], axis=-1).astype(jnp.float32)


def point_map(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """A depth image as one 3-D point per pixel, in the camera frame; depth 0 gives the origin."""
    height, width = depth.shape
    pixels = pixel_grid(height, width).reshape(-1, 2)
    return unproject(camera, pixels, depth.reshape(-1)).reshape(height, width, 3)


def patch_centres(grid: Float[Array, "*b p 2"], patch: int) -> Float[Array, "*b p 2"]:
    """Pixel coordinates of the centres of patches at (column, row); the first patch's is ((patch − 1) / 2, same)."""
    return (grid + 0.5) * patch - 0.5
