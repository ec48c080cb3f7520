"""The mask of a posed object: where it is drawn and the measured depth is its own."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.rasterize import splat_depth
from jax import lax
from jaxtyping import Array, Bool, Float

from ipjax.config import DetectConfig
from ipjax.records import Camera, Similarity, Templates

CLOSING = 2  # pixels: half the side, less a half, of the square that closes gaps between drawn points
MOST = 6  # the same, for objects of few points


@functools.partial(jax.jit, static_argnames="radius")
def draw_mask(
    points: Float[Array, "n 3"],
    camera_from_object: Similarity,
    camera: Camera,
    depth: Float[Array, "h w"],
    tolerance: Float[Array, ""],
    radius: int = CLOSING,
) -> tuple[Bool[Array, "h w"], Bool[Array, "h w"]]:
    """Where points are drawn at a pose, and where of that the depth agrees within ``tolerance`` (metres) or is unknown.

    Args:
      depth: of the image, metres; 0 = unknown.
      radius: gaps between points up to twice as many pixels wide are closed.
    """
    height, width = depth.shape
    placed = camera_from_object @ points
    everything = jnp.ones(points.shape[0], bool)
    drawn = functools.partial(splat_depth, placed, everything, camera.focal, camera.centre, height, width)
    # Every point enlarged and the outline shrunk again: closed, and no larger than the points.
    wide = drawn(radius=radius)
    side = 2 * radius + 1
    filled = (
        lax.reduce_window((wide > 0).astype(jnp.float32), np.float32(1), lax.min, (side, side), (1, 1), "SAME") > 0.5
    )
    # Where the surface is steep, depth changes by more than the tolerance from pixel to pixel: all that is drawn within
    # a pixel is its depth, but for what shows through gaps. Wide windows are only for those.
    near, exact = drawn(radius=1), drawn(radius=0)
    far = lax.reduce_window(exact, np.zeros((), exact.dtype), lax.max, (3, 3), (1, 1), "SAME")
    near, far = jnp.where(near > 0, near, wide), jnp.where(near > 0, jnp.minimum(far, near + tolerance), wide)
    off = (depth > 0) & ((depth < near - tolerance) | (depth > far + tolerance))
    return filled, filled & ~off


def mask_from_pose(
    templates: Templates,
    camera_from_object: Similarity,
    matrix: Float[np.ndarray, "3 3"],
    depth: Float[np.ndarray, "h w"],
    config: DetectConfig = DetectConfig(),
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The visible mask of an object at a pose in an image, and its whole outline, hidden parts included.

    A pixel of the outline whose depth is another's, nearer or farther, is not the object's; one of unknown depth is.

    Args:
      camera_from_object: in the camera of the image.
      matrix: K of the image, pixels.
      depth: metres; 0 = unknown.
    """
    drawn = templates.surface if templates.appearance is None else templates.appearance
    points, count = drawn.points, max(int(np.asarray(drawn.normals).any(axis=1).sum()), 1)  # padding has no normals
    guessed = templates.reference is not None and not templates.reference.measured
    share = config.guessed_tolerance if guessed else config.tolerance
    tolerance = max(share * float(camera_from_object.scale), config.least_tolerance)
    # Half of the points are in view, on about half of the square around the object; a point for each such square.
    area = (
        0.5
        * (float(camera_from_object.scale) * matrix[0, 0] / max(float(camera_from_object.translation[2]), 1e-3)) ** 2
    )
    radius = int(np.clip(np.ceil(np.sqrt(2 * area / count)), CLOSING, MOST))
    pose = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), camera_from_object)
    whole, visible = draw_mask(
        jnp.asarray(points, jnp.float32),
        pose,
        Camera.from_matrix(matrix),
        jnp.asarray(depth, jnp.float32),
        jnp.asarray(tolerance, jnp.float32),
        radius=radius,
    )
    return np.asarray(visible), np.asarray(whole)
