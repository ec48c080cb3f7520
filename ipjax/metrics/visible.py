"""VSD, the discrepancy of the visible surface (Hodan et al., BOP Challenge 2020, section 2.2)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ipjax.metrics.recalls import THRESHOLDS
from ipjax.records import Camera


def vsd(
    depth_seen: Float[Array, "h w"],
    depth_truth: Float[Array, "h w"],
    camera: Camera,
    depth_estimate: Float[Array, "h w"],
    diameter: float | Float[Array, ""],
    delta: float | Float[Array, ""],
    tolerances: Float[Array, "t"] | None = None,
) -> Float[Array, "t"]:
    """Visible surface discrepancy, one value in [0, 1] for each tolerance; 0 is perfect (BOP, pose_error.py:109-156).

    Args:
        depth_seen: the sensor's depth along z, 0 = missing.
        depth_truth, depth_estimate: the object alone, rendered in the true and in the estimated pose, 0 = background.
        diameter: of the object.
        delta: tolerance of the visibility test, 15 mm on YCB-V.
        tolerances: tau, as shares of the diameter; BOP's ten when None.

    The share of the union of both visible masks that is in one of them only, or whose two distances to the camera
    differ by tau diameters or more. 1 where nothing is visible. BOP sets it to 1 where
    ``projections_overlap`` is false.
    """
    if not depth_seen.shape == depth_truth.shape == depth_estimate.shape:
        raise ValueError(
            "the three depth images must have one shape, got "
            f"{depth_seen.shape}, {depth_truth.shape} and {depth_estimate.shape}"
        )
    if tolerances is None:
        tolerances = jnp.asarray(THRESHOLDS, depth_seen.dtype)
    seen, truth, estimate = (distances_from_camera(camera, d) for d in (depth_seen, depth_truth, depth_estimate))
    visible_truth, visible_estimate = visibility(seen, truth, estimate, delta)
    union = jnp.sum(visible_truth | visible_estimate)
    both = visible_truth & visible_estimate
    apart = jnp.where(both, jnp.abs(truth - estimate) / diameter, -1.0)

    def wrong(tolerance: Array) -> Array:
        return jnp.sum(apart >= tolerance)

    cost = jax.lax.map(wrong, tolerances) + union - jnp.sum(both)
    error = cost.astype(depth_seen.dtype) / jnp.maximum(union, 1).astype(depth_seen.dtype)
    return jnp.where(union > 0, error, 1.0)


def visibility(
    distances_seen: Float[Array, "h w"],
    distances_truth: Float[Array, "h w"],
    distances_estimate: Float[Array, "h w"],
    delta: float | Float[Array, ""],
) -> tuple[Bool[Array, "h w"], Bool[Array, "h w"]]:
    """Where the true object, and the estimated one, are visible (BOP's "bop19" mode, visibility.py:34-76).

    A pixel of a rendered object is visible unless something was measured more than ``delta`` in front of it; a missing
    measurement (0) hides nothing. What is visible of the true object is visible of the estimated one too.
    """
    unmeasured = ~(distances_seen > 0)  # NaN counts as missing
    truth = ((distances_truth - distances_seen <= delta) | unmeasured) & (distances_truth > 0)
    estimate = ((distances_estimate - distances_seen <= delta) | unmeasured) & (distances_estimate > 0)
    return truth, estimate | (truth & (distances_estimate > 0))


def distances_from_camera(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Distance of each pixel's point to the camera's centre, from depth along z; integer pixel centres."""
    height, width = depth.shape
    columns = (jnp.arange(width, dtype=depth.dtype) - camera.centre[0]) / camera.focal[0]
    rows = (jnp.arange(height, dtype=depth.dtype) - camera.centre[1]) / camera.focal[1]
    return jnp.sqrt((columns[None, :] * depth) ** 2 + (rows[:, None] * depth) ** 2 + depth**2)
