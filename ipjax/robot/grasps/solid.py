"""The object that is to be grasped: its surface in metres, at the size that was estimated."""

import equinox as eqx
import jax
import jax.numpy as jnp
from ipjax_kernels.positive import root
from jaxtyping import Array, Float

from ipjax.records import PoseEstimate, Surface, Templates
from ipjax.transforms import Similarity

_PROBED, _NEIGHBOURS = 128, 8  # points whose neighbours tell how much surface a point stands for


class Solid(eqx.Module):
    """An object's surface in the metric object frame."""

    points: Float[Array, "n 3"]  # m
    normals: Float[Array, "n 3"]  # unit, outwards
    seen: Float[Array, " n"]  # 1 = measured, 0 = guessed
    area: Float[Array, ""]  # m²: of the surface that one point stands for
    rough: Float[Array, ""]  # m: by how much its points may be off, standard deviation; 0 for scans


def pose_of(estimate: PoseEstimate | Similarity) -> Similarity:
    """``camera_from_object`` of an estimate, or the pose itself."""
    return estimate.camera_from_object if isinstance(estimate, PoseEstimate) else estimate


def make_solid(templates: Templates | Surface, estimate: PoseEstimate | Similarity) -> Solid:
    """The surface in metres.

    Where the estimate measured other proportions than the templates have, as of an object from a photo without depth,
    the templates' surface is stretched to its box; a bare :class:`Surface`, which has no box, is only scaled.

    Raises:
      ValueError: the surface has fewer than 16 points.
    """
    surface = templates.surface if isinstance(templates, Templates) else templates
    if surface.points.shape[-2] < 16:
        raise ValueError(f"a surface of {surface.points.shape[-2]} points is too little to plan a grasp on")
    points, normals, scale = surface.points, surface.normals, pose_of(estimate).scale
    if isinstance(templates, Templates) and isinstance(estimate, PoseEstimate):
        stretch = (estimate.box[1] - estimate.box[0]) / jnp.maximum(templates.extents, 1e-6)
        stretch = jnp.maximum(stretch, 1e-3)
        points = (points + templates.extents / 2) * stretch + estimate.box[0]
        normals = normals / stretch
        normals = normals / jnp.maximum(root(jnp.sum(normals**2, axis=-1, keepdims=True)), 1e-9)
    points = scale * points
    along = surface.along_std
    rough = jnp.zeros_like(scale) if along is None else scale * root(jnp.mean(along**2))
    return Solid(points, normals, surface.seen, _area(points, normals), rough)


def _area(points: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Float[Array, ""]:
    """The surface that a point stands for: of the disc that holds a few neighbours on the same side, the share."""
    count = points.shape[0]
    step = max(count // _PROBED, 1)
    probes, facing = points[::step][:_PROBED], normals[::step][:_PROBED]
    squared = jnp.sum((probes[:, None] - points[None]) ** 2, axis=-1)
    same = jnp.sum(facing[:, None] * normals[None], axis=-1) > 0.5
    near = -jax.lax.top_k(-jnp.where(same, squared, jnp.inf), min(_NEIGHBOURS + 1, count))[0]  # itself and the others
    # The edge of the disc runs through the last of them, which counts half.
    return jnp.pi * jnp.nanmedian(jnp.where(jnp.isfinite(near[:, -1]), near[:, -1], jnp.nan)) / (_NEIGHBOURS + 0.5)
