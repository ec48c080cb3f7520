"""How well a hypothesis explains the query: its depth, its mask, and its features. No renderer in the graph.

Depth comes from splatting the object's surface points; features from the template whose viewpoint is nearest to the
hypothesis', carried on its 3-D points into the query's feature map.
"""

import jax.numpy as jnp
from ipjax_kernels.rasterize import splat_depth
from jaxtyping import Array, Bool, Float

from ipjax.cameras import project
from ipjax.config import ScoreConfig
from ipjax.types import Camera, Query, Similarity, Surface, Templates


def score(
    templates: Templates,
    query: Query,
    depth: Float[Array, "g g"],
    mask: Bool[Array, "g g"],
    camera: Camera,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),  # noqa: B008
) -> Float[Array, ""]:
    """The score in [0, 1] of one hypothesis; the caller vmaps.

    Args:
      depth, mask, camera: the query's crop on a coarse grid (metres, 0 = unknown; one pixel per cell).
    """
    geometry = depth_agreement(templates.surface, depth, mask, camera, camera_from_object, config)
    features = feature_agreement(templates, query, camera_from_object, config)
    return geometry * features**2


def depth_agreement(
    surface: Surface,
    depth: Float[Array, "g g"],
    mask: Bool[Array, "g g"],
    camera: Camera,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),  # noqa: B008
) -> Float[Array, ""]:
    """Share of what is seen of the object or its mask where predicted and measured depth agree.

    A measurement nearer than predicted and outside the mask is an occluder and counts neither way; a farther one
    says that the object is not there.
    """
    height, width = depth.shape
    placed = camera_from_object @ surface.points
    normals = jnp.sum(camera_from_object.rotation[None] * surface.normals[:, None, :], axis=-1)
    facing = jnp.sum(normals * placed, axis=-1) < 0
    predicted = splat_depth(placed, facing, camera.focal, camera.centre, height, width)
    known = depth > 0
    seen = predicted > 0
    tolerance = config.tolerance * camera_from_object.scale
    gap = depth - predicted
    agree = seen & known & mask & (jnp.abs(gap) <= tolerance)
    occluded = seen & ~mask & (~known | (gap < tolerance))
    union = (seen & ~occluded) | (mask & known)
    return jnp.sum(agree) / jnp.maximum(jnp.sum(union), 1)


def nearest_view(templates: Templates, camera_from_object: Similarity) -> Float[Array, "v"]:
    """Cosine-like closeness (trace of the relative rotation) of every template to the hypothesis.

    The hypothesis is turned to the optical axis first: what an off-axis object looks like depends on its ray.
    """
    ray = camera_from_object.translation / jnp.maximum(jnp.linalg.norm(camera_from_object.translation), 1e-9)
    turned = look_along(ray) @ camera_from_object.rotation
    return jnp.sum(templates.camera_from_object.rotation * turned, axis=(-2, -1))


def look_along(ray: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The smallest rotation that turns a unit ray onto the optical axis; rays behind the camera stay finite."""
    x, y, z = ray
    factor = 1 / jnp.maximum(1 + z, 1e-6)
    one = jnp.ones_like(x)
    return jnp.stack(
        [
            jnp.stack([one - x * x * factor, -x * y * factor, -x]),
            jnp.stack([-x * y * factor, one - y * y * factor, -y]),
            jnp.stack([x, y, z]),
        ]
    )


def feature_agreement(
    templates: Templates,
    query: Query,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),  # noqa: B008
) -> Float[Array, ""]:
    """Mean cosine between the nearest template's patches, moved by the hypothesis, and the query's features there.

    Patches behind an occluder are left out; patches outside the mask count as zero.
    """
    view = jnp.argmax(nearest_view(templates, camera_from_object))
    features = templates.patches.features[view].astype(query.patches.features.dtype)
    placed = camera_from_object @ templates.patches.points[view]
    valid = templates.patches.valid[view]
    height, width = query.view.depth.shape
    columns, rows = (jnp.max(query.patches.grid, axis=0) + 1).astype(jnp.int32)
    del rows
    side = int(round(query.patches.valid.shape[0] ** 0.5))
    size = width // side
    pixel = project(query.view.camera, placed)
    cell = (pixel + 0.5) / size - 0.5
    return _sampled_agreement(cell, placed, features, valid, pixel, query, side, config, camera_from_object.scale)


def _sampled_agreement(cell, placed, features, valid, pixel, query, side, config, scale):
    base = jnp.floor(cell)
    fraction = cell - base
    total = jnp.zeros_like(features)
    share = jnp.zeros_like(placed[:, 0])
    for dx in (0, 1):
        for dy in (0, 1):
            column = base[:, 0].astype(jnp.int32) + dx
            row = base[:, 1].astype(jnp.int32) + dy
            inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
            index = jnp.clip(row, 0, side - 1) * side + jnp.clip(column, 0, side - 1)
            weight = jnp.abs(1 - dx - fraction[:, 0]) * jnp.abs(1 - dy - fraction[:, 1])
            weight = jnp.where(inside & query.patches.valid[index], weight, 0)
            total = total + weight[:, None] * query.patches.features[index]
            share = share + weight
    norm = jnp.sqrt(jnp.sum(total * total, axis=-1) + 1e-12)
    cosine = jnp.sum(total * features, axis=-1) / norm
    height, width = query.view.depth.shape
    column = jnp.clip(jnp.round(pixel[:, 0]).astype(jnp.int32), 0, width - 1)
    row = jnp.clip(jnp.round(pixel[:, 1]).astype(jnp.int32), 0, height - 1)
    measured = query.view.depth[row, column]
    on = query.view.mask[row, column]
    occluded = ~on & (measured > 0) & (measured < placed[:, 2] - config.tolerance * scale)
    counted = valid & ~occluded
    value = jnp.where(share > 0.25, jnp.maximum(cosine, 0), 0)
    return jnp.sum(jnp.where(counted, value, 0)) / jnp.maximum(jnp.sum(counted), 1)
