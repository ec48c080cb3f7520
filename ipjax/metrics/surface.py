"""Errors over an object's surface, with its size: MSSD and MSPD up to symmetries; ADD, ADD-S and reprojection.

Definitions: https://github.com/thodan/bop_toolkit (pose_error.py, misc.py), Hodan et al., "BOP Challenge 2020 on 6D
Object Localization", section 2.2, and Hinterstoisser et al. 2012.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ipjax.metrics.displacements import (
    apply_matrix,
    away_from_zero,
    displacements,
    lengths,
    namespace,
    pixel_displacements,
    square_root,
)
from ipjax.metrics.poses import scale_error
from ipjax.records import Camera
from ipjax.transforms import A, Similarity


def surface_distance(points: Float[A, "n 3"], truth: Similarity[A], estimate: Similarity[A]) -> Float[A, "*b"]:
    """The farthest that a vertex is from its true place: max over vertices |P_e x − P_g x|; MSSD without symmetries.

    Convex in x, so that the vertices of the convex hull give the same as all vertices. Leading axes of the poses
    broadcast; each maps the points with its own scale. Unit: that of the poses' translations.
    """
    xp = namespace(points, truth.translation, estimate.translation)
    moved = displacements(points, truth, estimate)
    return square_root(xp.asarray(xp.max(xp.sum(moved**2, axis=-1), axis=-1)))


def projection_distance(
    points: Float[A, "n 3"],
    camera: Camera | Float[np.ndarray, "3 3"],
    truth: Similarity[A],
    estimate: Similarity[A],
) -> Float[A, "*b"]:
    """The farthest that a projected vertex is from its true place, in pixels; MSPD without symmetries. All vertices are
    needed: the distance of two perspective projections is not convex in x. The camera is K for NumPy's arrays."""
    xp = namespace(points, truth.translation, estimate.translation)
    moved = pixel_displacements(points, camera, truth, estimate)
    return square_root(xp.asarray(xp.max(xp.sum(moved**2, axis=-1), axis=-1)))


def mssd(
    points: Float[Array, "n 3"], symmetries: Similarity, truth: Similarity, estimate: Similarity
) -> Float[Array, ""]:
    """Maximum symmetry-aware surface distance: min over symmetries of max over vertices |P_e x − P_g S x|.

    ``symmetries`` has one leading axis (see ``discretise_symmetries``; scale 1). The distance is convex in x, so the
    vertices of the convex hull give the same value as all vertices. Memory: vertices × 8, whatever the symmetries.
    Each pose maps the points with its own scale: where both are 1 (a BOP file holds no size) it is BOP's, else a wrong
    size is part of the error. Unit: that of the points. BOP sets it to infinity where ``spheres_overlap`` is false.
    """
    return closest_symmetry(points, symmetries, truth, estimate)[0]


def mspd(
    points: Float[Array, "n 3"], symmetries: Similarity, camera: Camera, truth: Similarity, estimate: Similarity
) -> Float[Array, ""]:
    """Maximum symmetry-aware projection distance, in pixels: MSSD with projected points. All vertices are needed (the
    distance of two perspective projections is not convex in x). BOP multiplies it by 640 / image width.
    """
    return closest_symmetry(points, symmetries, truth, estimate, camera=camera)[0]


def closest_symmetry(
    points: Float[Array, "n 3"],
    symmetries: Similarity,
    truth: Similarity,
    estimate: Similarity,
    camera: Camera | None = None,
    *,
    block: int = 8,
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """MSSD (or MSPD, given a camera) and the index of the symmetry that attains it.

    Exact branch and bound: the maximum over a few extreme vertices bounds each symmetry from below; symmetries are
    then tried, ``block`` at a time and most promising first, until the next bound is no better than the best value.
    """
    # NumPy's arrays cannot be indexed inside the loop.
    points, symmetries, truth, estimate, camera = jax.tree.map(
        jnp.asarray, (points, symmetries, truth, estimate, camera)
    )
    _require_axis(symmetries.translation, 1, "symmetries")
    count = symmetries.translation.shape[0]
    if count == 0:
        raise ValueError("symmetries must have one at least, the identity")
    block = min(block, count)
    alike = truth @ symmetries  # [s]

    def error(chosen: Array, vertices: Array) -> Array:
        """Maximum over the vertices, for each chosen symmetry."""
        turned = jax.tree.map(lambda x: x[chosen], alike)
        if camera is None:
            return surface_distance(vertices, turned, estimate)
        return projection_distance(vertices, camera, turned, estimate)

    everything = jnp.arange(count)
    if count <= block:
        errors = error(everything, points)
        best = jnp.argmin(errors)
        return errors[best], best
    directions = jnp.asarray(_directions(64), points.dtype)
    probes = points[jnp.argmax(jnp.matmul(points, directions.T, precision="highest"), axis=0)]
    bounds = error(everything, probes)
    order = jnp.argsort(bounds)

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        tried, best, _ = state
        return (tried < count) & (bounds[order[jnp.minimum(tried, count - 1)]] < best)

    def advance(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        tried, best, index = state
        chosen = order[jnp.minimum(tried + jnp.arange(block), count - 1)]
        errors = error(chosen, points)
        winner = jnp.argmin(errors)
        better = errors[winner] < best
        return tried + block, jnp.where(better, errors[winner], best), jnp.where(better, chosen[winner], index)

    start = (jnp.zeros((), order.dtype), jnp.full((), jnp.inf, bounds.dtype), jnp.zeros((), order.dtype))
    _, best, index = jax.lax.while_loop(unfinished, advance, start)
    return best, index


def spheres_overlap(diameter: float | Float[A, ""], truth: Similarity[A], estimate: Similarity[A]) -> Bool[A, "*b"]:
    """Whether the bounding spheres of the two poses meet; BOP calls MSSD, ADD and ADD-S infinite where they do not."""
    xp = namespace(truth.translation, estimate.translation)
    return xp.asarray(lengths(truth.translation - estimate.translation) < diameter)


def projections_overlap(diameter: float | Float[A, ""], truth: Similarity[A], estimate: Similarity[A]) -> Bool[A, ""]:
    """Whether the projections of the two bounding spheres meet; BOP calls VSD 1 where they do not (misc.py:317-339), or
    where one is in the plane of the camera."""
    xp = namespace(truth.translation, estimate.translation)
    (p, q), depths = (truth.translation, estimate.translation), (truth.translation[2], estimate.translation[2])
    safe = [away_from_zero(depth) for depth in depths]
    apart = lengths(p[:2] / safe[0] - q[:2] / safe[1])
    return xp.asarray((depths[0] != 0) & (depths[1] != 0) & (apart < diameter / 2 * (1 / safe[0] + 1 / safe[1])))


def add(points: Float[A, "n 3"], truth: Similarity[A], estimate: Similarity[A]) -> Float[A, "*b"]:
    """Average distance of the vertices in the true and the estimated pose (Hinterstoisser et al. 2012). Leading axes of
    the poses broadcast."""
    xp = namespace(points, truth.translation, estimate.translation)
    return xp.asarray(xp.mean(lengths(displacements(points, truth, estimate)), axis=-1))


def add_s(
    points: Float[A, "n 3"],
    truth: Similarity[A],
    estimate: Similarity[A],
    nearest: Callable[[Any], Any] | None = None,
    *,
    block: int = 512,
) -> Float[A, ""]:
    """Average distance of the vertices in the true pose to the NEAREST vertex in the estimated pose: ADD-S, or ADI.

    Args:
        points: of the model.
        truth, estimate: ``camera_from_object``; each maps the points with its own scale.
        block: vertices that are compared with all at a time; memory: block × n.
        nearest: the distances of points [n, 3] to the nearest vertex, where something is faster than comparing all: on
            the host the query of a k-d tree of ``points``.
    """
    xp = namespace(points, truth.translation, estimate.translation)
    if truth.translation.ndim != 1 or estimate.translation.ndim != 1:
        raise ValueError("ADD-S compares one pose with one: jax.vmap does many")
    # In the estimated object's frame one of the two sets is the model itself, and equal poses give exactly x.
    back = xp.swapaxes(estimate.rotation, -1, -2)
    inside = points + apply_matrix(back, displacements(points, estimate, truth)) / estimate.scale
    found = _nearest_distances(points, inside, block) if nearest is None else nearest(inside)
    return xp.asarray(estimate.scale * xp.mean(found))


def reprojection_error(
    points: Float[A, "n 3"],
    camera: Camera | Float[np.ndarray, "3 3"],
    truth: Similarity[A],
    estimate: Similarity[A],
) -> Float[A, "*b"]:
    """Average distance of the projected vertices, pixels (BOP's ``proj``; no symmetries). Leading axes broadcast."""
    xp = namespace(points, truth.translation, estimate.translation)
    return xp.asarray(xp.mean(lengths(pixel_displacements(points, camera, truth, estimate)), axis=-1))


class SizedErrors(eqx.Module):
    """Errors of a pose with the model at its estimated size; a size that is wrong is an error like any other."""

    mssd: Float[Array, "*b"]  # in true diameters; min over symmetries
    add: Float[Array, "*b"]  # in true diameters
    add_s: Float[Array, "*b"]  # in true diameters
    size: Float[Array, "*b"]  # |estimated / true − 1|


def sized_errors(
    diameter: float | Float[Array, ""],
    points: Float[Array, "n 3"],
    symmetries: Similarity,
    truth: Similarity,
    estimate: Similarity,
) -> SizedErrors:
    """Errors of a pose with the model at its estimated size, which BOP's errors ignore: its files hold no size, and a
    pose whose size is wrong by a third can be perfect. Here the estimate maps the model's points with its own scale.

    Args:
        diameter: of the points, in their unit; the truth's scale makes it the true diameter.
        points: of the model.
        symmetries: one leading axis, see ``discretise_symmetries``.
        truth, estimate: ``camera_from_object``; only the ratio of their scales counts as size.

    For the true rotation and a size wrong by a factor f about the point c, MSSD is |f − 1| · max |x − c| and ADD
    |f − 1| · mean |x − c|, over the true diameter (by symmetries that keep c). BOP's thresholds (``THRESHOLDS``) and
    ``SIZE_TOLERANCES`` go with it; BOP's pre-check of spheres does not.
    """
    unit = truth.scale * diameter
    return SizedErrors(
        mssd(points, symmetries, truth, estimate) / unit,
        add(points, truth, estimate) / unit,
        add_s(points, truth, estimate) / unit,
        scale_error(truth.scale, estimate.scale),
    )


def _nearest_distances(points: Any, others: Any, block: int) -> Any:
    """The distance of each of the others to its nearest point. A matrix product finds it, a difference measures it (the
    product alone cancels: in float32 it cannot tell 0 from 3e-4 of the object's size)."""
    xp = namespace(points, others)
    centre = xp.mean(points, axis=0)
    points, others = points - centre, others - centre  # small numbers
    squares = xp.sum(points**2, axis=-1)

    def nearest(rows: Any) -> Any:
        inner = rows @ points.T if xp is np else jnp.matmul(rows, points.T, precision="highest")
        return lengths(rows - points[xp.argmin(squares - 2 * inner, axis=-1)])

    count = len(others)
    block = min(block, count)
    if xp is np:
        return np.concatenate([nearest(others[start : start + block]) for start in range(0, count, block)])
    padded = jnp.pad(others, ((0, -count % block), (0, 0)))
    return jax.lax.map(nearest, padded.reshape(-1, block, 3)).reshape(-1)[:count]


def _directions(count: int) -> np.ndarray:
    """Directions spread evenly over the sphere (Fibonacci)."""
    heights = 1 - (2 * np.arange(count) + 1) / count
    turns = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(turns), radii * np.sin(turns), heights], axis=-1)


def _require_axis(array: Array, axes: int, name: str) -> None:
    if array.ndim != axes + 1:
        raise ValueError(f"{name} must have {axes} leading axis, got translations of shape {array.shape}")
