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

CLOSING = 5  # pixels on a side of the square that closes gaps between drawn points
FEW = 20_000  # points below which each is drawn larger


@functools.partial(jax.jit, static_argnames="radius")
def draw_mask(
    points: Float[Array, "n 3"],
    camera_from_object: Similarity,
    camera: Camera,
    depth: Float[Array, "h w"],
    tolerance: Float[Array, ""],
    radius: int = 1,
) -> tuple[Bool[Array, "h w"], Bool[Array, "h w"]]:
    """Where points are drawn at a pose, and where of that the depth agrees within ``tolerance`` (metres) or is unknown.

    Args:
      depth: of the image, metres; 0 = unknown.
      radius: pixels by which each point is enlarged.
    """
    height, width = depth.shape
    placed = camera_from_object @ points
    everything = jnp.ones(points.shape[0], bool)
    predicted = splat_depth(placed, everything, camera.focal, camera.centre, height, width, radius)
    # Closed: gaps between points, but nothing of the outline, take the depth of the nearest points around them.
    near = jnp.where(predicted > 0, predicted, jnp.inf)
    window = lambda x, start, take: lax.reduce_window(x, start, take, (CLOSING, CLOSING), (1, 1), "SAME")
    around = window(near, jnp.inf, lax.min)
    filled = window(jnp.isfinite(around).astype(jnp.float32), 1.0, lax.min) > 0.5
    surface = jnp.where(predicted > 0, predicted, around)
    off = (depth > 0) & (jnp.abs(depth - surface) > tolerance)
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
    points = templates.surface.points if templates.appearance is None else templates.appearance.points
    guessed = templates.reference is not None and not templates.reference.measured
    share = config.guessed_tolerance if guessed else config.tolerance
    tolerance = max(share * float(camera_from_object.scale), config.least_tolerance)
    radius = 1 if points.shape[0] > FEW else 4
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
