"""What refinement minimises: how far surface, depth and silhouette are apart at a pose, robustly, and the slopes of it.

Both directions are associated: surface points with the depth they project to, and depth points with their nearest
surface point. The silhouette is compared with the mask's border; pairs of patches may be added.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from ipjax_kernels.positive import root
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ipjax.cameras import project
from ipjax.config import RefineConfig
from ipjax.estimation.contour import Contour
from ipjax.records import Camera, Pairs, Similarity, Surface
from ipjax.transforms import retract


class Cloud(eqx.Module):
    """The query's depth as points on a coarse grid of the crop."""

    points: Float[Array, "g g 3"]  # metres, camera frame
    valid: Bool[Array, "g g"]
    camera: Camera  # of the grid: one pixel per cell
    mask: Bool[Array, "g g"]  # the object, with or without a depth
    depth: Float[Array, "g g"]  # metres, background included; 0 = unknown
    contour: Contour


@functools.partial(jax.jit, static_argnames="rigid")  # so that it is traced once
def linearise(
    start: Similarity,
    step: Float[Array, "n"],
    surface: Surface,
    cloud: Cloud,
    pairs: Pairs | None,
    unit: Float[Array, ""],
    config: RefineConfig,
    *,
    rigid: int,
) -> tuple[Float[Array, "r"], Float[Array, "r n"]]:
    """The residuals of :func:`residuals_after` and their slopes.

    All slopes at once: left to the solver, they are a function that it carries through its loop, which takes twice as
    long to compile.
    """

    def residuals(step):
        values = residuals_after(start, step, surface, cloud, pairs, unit, config, rigid=rigid)
        return values, values

    slopes, values = jax.jacfwd(residuals, has_aux=True)(step)
    return values, slopes


def mean_cost(
    start: Similarity,
    step: Float[Array, "n"],
    surface: Surface,
    cloud: Cloud,
    pairs: Pairs | None,
    unit: Float[Array, ""],
    config: RefineConfig,
    *,
    rigid: int,
) -> Float[Array, ""]:
    """The mean square of :func:`residuals_after`, in [0, 1] where nothing is strained."""
    strains = step.shape[0] - rigid
    return mean_square(residuals_after(start, step, surface, cloud, pairs, unit, config, rigid=rigid), strains)


def mean_square(values: Float[Array, "r"], strains: int) -> Float[Array, ""]:
    """The mean square of the residuals of the image; the prior of the strains adds to it, but is none of them."""
    return jnp.sum(values**2) / (values.shape[0] - strains)


def residuals_after(
    start: Similarity,
    step: Float[Array, "n"],
    surface: Surface,
    cloud: Cloud,
    pairs: Pairs | None,
    unit: Float[Array, ""],
    config: RefineConfig,
    *,
    rigid: int,
) -> Float[Array, "r"]:
    """The residuals after a step of ``rigid`` coordinates of :func:`retract` and then strains.

    Args:
      unit: metres in a diameter of the losses' widths; 0 = that of the pose in hand.
    """
    moved, strain = retract(start, step[:rigid]), step[rigid:]
    if strain.shape[0]:
        surface = strained(surface, strain)
    if strain.shape[0] and pairs is not None:
        pairs = eqx.tree_at(lambda p: p.object, pairs, pairs.object + _stretch(pairs.object, strain))
    values = _residuals(moved, jnp.where(unit > 0, unit, moved.scale), surface, cloud, pairs, config)
    # So that the mean square is in [0, 1].
    spread = jnp.sqrt(values.shape[0] / total_weight(pairs, step.dtype, config))
    # A strain of one standard deviation costs as much as a hundredth of the surface without a match.
    return jnp.concatenate([values * spread, strain / config.strain * (0.1 * spread)])


def strained(surface: Surface, strain: Float[Array, "5"]) -> Surface:
    """The surface with its proportions changed: ``x + E x``, E small, symmetric, and without a trace (the scale).

    Args:
      strain: E11, E22, E12, E13, E23, in the object's frame.
    """
    normals = surface.normals - _stretch(surface.normals, strain)
    normals = normals / jnp.sqrt(jnp.sum(normals**2, axis=-1, keepdims=True) + 1e-12)  # padding has none
    points = surface.points + _stretch(surface.points, strain)
    return eqx.tree_at(lambda s: (s.points, s.normals), surface, (points, normals))


def _stretch(vectors: Float[Array, "n 3"], strain: Float[Array, "5"]) -> Float[Array, "n 3"]:
    a, b, ab, ac, bc = strain
    matrix = jnp.stack([jnp.stack([a, ab, ac]), jnp.stack([ab, b, bc]), jnp.stack([ac, bc, -a - b])])
    return jnp.sum(vectors[:, :, None] * matrix, axis=1)


def total_weight(pairs: Pairs | None, dtype: Any, config: RefineConfig) -> Float[Array, ""]:
    """The largest sum of squares of all residuals: 1 for each direction of the depth association, and the weights."""
    weight = 2 + jnp.asarray(config.silhouette_weight, dtype)
    return weight if pairs is None else weight + jnp.asarray(config.pair_weight, dtype)


def _residuals(moved, unit, surface, cloud, pairs, config):
    """All terms; the squares of each kind sum to at most its weight. ``unit``: metres in a diameter of widths."""
    points, normals = surface.points[: config.points], surface.normals[: config.points]
    trust = 0.25 + 0.75 * surface.seen[: config.points]
    weight = jnp.asarray(config.silhouette_weight, moved.translation.dtype)
    silhouette = _silhouette(moved, unit, surface.points, cloud, config) * jnp.sqrt(weight)
    terms = [*_depth_terms(moved, unit, points, normals, trust, cloud, config), silhouette]
    if pairs is not None:
        terms.append(_pair_terms(moved, unit, pairs, config))
    return jnp.concatenate(terms)


def _pair_terms(moved, unit, pairs, config):
    """Geman–McClure on the distance between the two points of each pair; the squares sum to at most the weight."""
    squared = jnp.sum((moved @ pairs.object - pairs.camera) ** 2, axis=-1) / (config.pair_width * unit) ** 2
    share = pairs.weight * jnp.asarray(config.pair_weight, squared.dtype) / jnp.maximum(jnp.sum(pairs.weight), 1e-9)
    return jnp.sqrt(squared / (1 + squared) + 1e-12) * root(share)


def place_surface(
    moved: Similarity, points: Float[Array, "n 3"], normals: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Bool[Array, "n"]]:
    """Points and normals in the camera frame, and which of them show it their front."""
    placed = moved @ points
    facing = jnp.sum(moved.rotation[None] * normals[:, None, :], axis=-1)
    return placed, facing, _faces_camera(placed, facing, 0.1)


def _faces_camera(placed, normals, cosine):
    """Whether the surface shows the camera its front, at an angle to the ray of this cosine at least."""
    return lax.stop_gradient(jnp.sum(normals * placed, axis=-1) < -cosine * jnp.linalg.norm(placed, axis=-1))


# Least cosine at which a surface point must have been measured. One about to turn away projects beside the mask as soon
# as the object is a little too large, and costs the most a point can: objects would come out too small.
_GRAZING = 0.3


def _depth_terms(moved, unit, points, normals, trust, cloud, config):
    """Surface to depth and depth to surface; the squares of each sum to at most 1."""
    placed, facing, visible = place_surface(moved, points, normals)
    column, row, inside = _cells(placed, cloud)
    measured = cloud.valid[row, column] & inside
    forward = _robust(placed - cloud.points[row, column], facing, measured, unit, config)
    forward = forward * jnp.sqrt(trust)
    on_mask = cloud.mask[row, column] & inside
    # Surface that faces away, lies behind an occluder, or falls into a hole of the depth image cannot have been
    # measured and costs nothing.
    nearer = (cloud.depth[row, column] > 0) & (cloud.depth[row, column] < placed[:, 2] - config.reach * unit / 2)
    steady = _faces_camera(placed, facing, _GRAZING)
    counted = steady & ~lax.stop_gradient(jnp.where(on_mask, ~measured, nearer))
    forward = jnp.where(counted, forward, 0)
    targets = cloud.points[::2, ::2].reshape(-1, 3)
    known = cloud.valid[::2, ::2].reshape(-1)
    nearest = lax.stop_gradient(nearest_visible(targets, placed, visible))
    backward = _robust(placed[nearest] - targets, facing[nearest], known, unit, config)
    backward = jnp.where(known, backward * jnp.sqrt(trust[nearest]), 0)
    # At least a third of the points count: else a pose whose points are mostly occluded would cost little.
    count = jnp.maximum(jnp.sum(counted), jnp.sum(steady) // 3)
    return _averaged(forward, lax.stop_gradient(count)), _averaged(backward, jnp.sum(known))


def _averaged(values, count):
    return values * jnp.sqrt(1 / jnp.maximum(count.astype(values.dtype), 1))


def _silhouette(moved, unit, points, cloud, config):
    """Geman–McClure on how far the object's silhouette is from the mask's border, along the border's normal.

    The silhouette there is the surface point that reaches farthest out in a strip across the border, so that no mesh
    is needed, and where it lies beside the strip's middle, by as much farther as the border bends until there; where
    the strip is empty the cost is the maximum.
    """
    contour, camera = cloud.contour, cloud.camera
    focal = jnp.mean(camera.focal)
    offset = project(camera, lax.stop_gradient(moved @ points))[None] - contour.points[:, None]
    normal = contour.outward[:, None]
    along = jnp.sum(offset * normal, axis=-1)
    across = offset[..., 0] * normal[..., 1] - offset[..., 1] * normal[..., 0]
    along = along + contour.bend[:, None] * across**2 / 2
    reach = lax.stop_gradient(config.silhouette_reach * unit * focal / jnp.maximum(moved.translation[2], 1e-6))
    strip = (jnp.abs(across) < 1) & (jnp.abs(along) < reach)
    farthest = lax.argmax(jnp.where(strip, along, -jnp.inf), 1, jnp.int32)
    placed = moved @ points[farthest]
    offset, normal = project(camera, placed) - contour.points, contour.outward
    beside = offset[:, 0] * normal[:, 1] - offset[:, 1] * normal[:, 0]
    gap = jnp.sum(offset * normal, axis=-1) + contour.bend * beside**2 / 2
    squared = (gap * placed[:, 2] / focal / (config.silhouette_width * unit)) ** 2
    cost = jnp.where(jnp.any(strip, axis=1), jnp.sqrt(squared / (1 + squared) + 1e-12), 1.0)
    return _averaged(jnp.where(contour.valid, cost, 0), jnp.sum(contour.valid))


def _cells(placed, cloud):
    """The grid cell that each placed point projects to, and whether it is one."""
    height, width = cloud.valid.shape
    pixel = lax.stop_gradient(jnp.round(project(cloud.camera, placed))).astype(jnp.int32)
    inside = jnp.all((pixel >= 0) & (pixel < jnp.array([width, height], jnp.int32)), axis=-1)
    return jnp.clip(pixel[:, 0], 0, width - 1), jnp.clip(pixel[:, 1], 0, height - 1), inside


def _robust(offset, normal, ok, unit, config):
    """Geman–McClure on the point-to-plane distance; points without a match cost the maximum, 1, so that no pose gains
    by losing matches."""
    plane = jnp.sum(offset * normal, axis=-1)
    tangent = jnp.sum(offset * offset, axis=-1) - plane**2
    squared = (plane**2 + 0.05 * jnp.maximum(tangent, 0)) / (config.width * unit) ** 2
    near = lax.stop_gradient(ok & (jnp.sum(offset * offset, axis=-1) < (config.reach * unit) ** 2))
    return jnp.where(near, jnp.sqrt(squared / (1 + squared) + 1e-12), 1.0)


_POINTS_PER_STEP = 8  # that are compared in one step on a CPU


def nearest_visible(
    targets: Float[Array, "t 3"], placed: Float[Array, "n 3"], visible: Bool[Array, "n"]
) -> Int[Array, "t"]:
    """Index of the nearest visible point for each target; the first of equals, and the first point if none is."""

    def by_points(targets, placed, visible):
        # A CPU vectorises neither an argmin nor a minimum along the last axis. This compares a few points at a time
        # with the nearest so far of all targets.
        count = placed.shape[0]
        padding = -count % _POINTS_PER_STEP
        parts = (
            jnp.pad(placed, ((0, padding), (0, 0))).reshape(-1, _POINTS_PER_STEP, 3),
            jnp.pad(visible, (0, padding)).reshape(-1, _POINTS_PER_STEP),
            jnp.arange(count + padding, dtype=jnp.int32).reshape(-1, _POINTS_PER_STEP),
        )

        def compare(best, part):
            least, nearest = best
            for point, seen, index in zip(*part, strict=True):
                squared = sum((targets[:, axis] - point[axis]) ** 2 for axis in range(3))
                nearer = seen & (squared < least)
                least, nearest = jnp.where(nearer, squared, least), jnp.where(nearer, index, nearest)
            return (least, nearest), None

        start = jnp.full(targets.shape[0], jnp.inf, placed.dtype), jnp.zeros(targets.shape[0], jnp.int32)
        return lax.scan(compare, start, parts)[0][1]

    def at_once(targets, placed, visible):
        squared = jnp.zeros((targets.shape[0], placed.shape[0]), placed.dtype)
        for axis in range(3):  # three fused outer differences: faster and more exact than the expanded product
            squared = squared + (targets[:, None, axis] - placed[None, :, axis]) ** 2
        return lax.argmin(jnp.where(visible[None, :], squared, jnp.inf), 1, jnp.int32)

    arguments = lax.stop_gradient((targets, placed, visible))
    return lax.platform_dependent(*arguments, cpu=by_points, default=at_once)
