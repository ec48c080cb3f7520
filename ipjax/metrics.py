"""Pose errors as the BOP benchmark and the YCB-V papers define them. Pure: written for one pose, the caller vmaps.

Lengths may be in any unit, as long as all of them (points, translations, depths, tolerances, diameters) share it.
Every pose is a ``camera_from_object``; ``truth`` comes before ``estimate``, what is fixed before what is new.
Definitions: https://github.com/thodan/bop_toolkit (pose_error.py, misc.py) and Hodan et al., "BOP Challenge 2020 on 6D
Object Localization", section 2.2. Comparisons are strict (error < threshold), except VSD's pixel cost (>=).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from jaxtyping import Array, Bool, Float, Int, Num

from ipjax.records import Camera, Similarity

HIGHEST = jax.lax.Precision.HIGHEST
SYMMETRY_STEP = 0.01  # BOP's max_sym_disc_step: the farthest a point may move between steps, in diameters
THRESHOLDS = 0.05 * np.arange(1, 11)  # of the diameter: MSSD's and VSD's, and VSD's tolerances tau
PIXEL_THRESHOLDS = 5.0 * np.arange(1, 11)  # MSPD, for images 640 pixels wide
SIZE_TOLERANCES = np.array([0.02, 0.05, 0.1])  # of the true size: what counts as the right size
ADD_LIMIT = 0.1  # metres: where the area under the accuracy-threshold curve of the YCB-V papers ends


# Symmetries


def discretise_symmetries(
    discrete: Sequence[Num[np.ndarray, "..."]] = (),
    continuous: Sequence[tuple[Num[np.ndarray, "..."], Num[np.ndarray, "..."]]] = (),
    step: float = SYMMETRY_STEP,
) -> tuple[Float[np.ndarray, "s 3 3"], Float[np.ndarray, "s 3"]]:
    """All symmetry transforms of an object as rotations [s, 3, 3] and translations [s, 3], float64; the first is the
    identity.

    Args:
        discrete: 4 × 4 rigid matrices, the identity not among them.
        continuous: (axis, a point on the axis) of each rotational symmetry, in the unit of the object.
        step: the farthest a point of the surface may move between two steps, as a share of the diameter.

    Every rotation is followed by every discrete symmetry's place: continuous ∘ discrete (BOP, misc.py:42-89).
    Rotations about several axes are not composed with one another, as in BOP.
    Raises ValueError for a matrix that is not 4 × 4, an axis of length 0, or a step that is not positive.
    """
    if not step > 0:
        raise ValueError(f"the step between symmetries must be positive, got {step}")
    placed = [np.eye(4)]
    for matrix in discrete:
        matrix = np.asarray(matrix, np.float64)
        if matrix.size != 16:
            raise ValueError(f"a discrete symmetry is a 4 × 4 matrix (16 numbers), got {matrix.size} numbers")
        placed.append(matrix.reshape(4, 4))
    turned = []
    count = int(np.ceil(np.pi / step))
    for axis, offset in continuous:
        axis, offset = np.asarray(axis, np.float64).reshape(3), np.asarray(offset, np.float64).reshape(3)
        length = np.linalg.norm(axis)
        if not length > 0:
            raise ValueError("the axis of a continuous symmetry has length 0")
        x, y, z = axis / length
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angles = np.arange(count)[:, None, None] * (2 * np.pi / count)
        rotations = np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * (cross @ cross)
        matrices = np.tile(np.eye(4), (count, 1, 1))
        matrices[:, :3, :3] = rotations
        matrices[:, :3, 3] = offset - rotations @ offset
        turned.append(matrices)
    discrete_matrices = np.stack(placed)
    if turned:
        matrices = (np.concatenate(turned)[None] @ discrete_matrices[:, None]).reshape(-1, 4, 4)
    else:
        matrices = discrete_matrices
    return matrices[:, :3, :3], matrices[:, :3, 3]


# BOP: MSSD, MSPD, VSD


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
    _require_axis(symmetries.translation, 1, "symmetries")
    count = symmetries.translation.shape[0]
    block = min(block, count)
    alike = truth @ symmetries  # [s]
    truth_rotation, truth_translation = alike.scale[:, None, None] * alike.rotation, alike.translation
    estimate_matrix = estimate.scale * estimate.rotation

    def error(chosen: Array, vertices: Array) -> Array:
        """Maximum over the vertices, for each chosen symmetry."""
        rotation, translation = truth_rotation[chosen], truth_translation[chosen]
        if camera is None:
            # The difference of the transforms, applied once: no cancellation of coordinates a metre away.
            rotation, translation = estimate_matrix - rotation, estimate.translation - translation
            moved = _apply(rotation, translation, vertices)
            return jnp.sqrt(jnp.max(jnp.sum(moved**2, axis=-1), axis=-1))
        seen = _flat_project(camera, _apply(rotation, translation, vertices))
        found = _flat_project(camera, _apply(estimate_matrix, estimate.translation, vertices))
        return jnp.sqrt(jnp.max(jnp.sum((seen - found) ** 2, axis=-1), axis=-1))

    everything = jnp.arange(count)
    if count <= block:
        errors = error(everything, points)
        best = jnp.argmin(errors)
        return errors[best], best
    directions = jnp.asarray(_directions(64), points.dtype)
    probes = points[jnp.argmax(jnp.matmul(points, directions.T, precision=HIGHEST), axis=0)]
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


def distances_from_camera(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Distance of each pixel's point to the camera's centre, from depth along z; integer pixel centres."""
    height, width = depth.shape
    columns = (jnp.arange(width, dtype=depth.dtype) - camera.centre[0]) / camera.focal[0]
    rows = (jnp.arange(height, dtype=depth.dtype) - camera.centre[1]) / camera.focal[1]
    return jnp.sqrt((columns[None, :] * depth) ** 2 + (rows[:, None] * depth) ** 2 + depth**2)


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


def spheres_overlap(diameter: float | Float[Array, ""], truth: Similarity, estimate: Similarity) -> Bool[Array, ""]:
    """Whether the bounding spheres of the two poses meet; BOP calls MSSD, ADD and ADD-S infinite where they do not."""
    return _length(truth.translation - estimate.translation) < diameter


def projections_overlap(diameter: float | Float[Array, ""], truth: Similarity, estimate: Similarity) -> Bool[Array, ""]:
    """Whether the projections of the two bounding spheres meet; BOP calls VSD 1 where they do not (misc.py:317-339)."""
    depths = jnp.stack([_away_from_zero(truth.translation[2]), _away_from_zero(estimate.translation[2])])
    apart = truth.translation[:2] / depths[0] - estimate.translation[:2] / depths[1]
    return _length(apart) < diameter / 2 * jnp.sum(1 / depths)


# The YCB-V papers: ADD, ADD-S


def add(points: Float[Array, "n 3"], truth: Similarity, estimate: Similarity) -> Float[Array, ""]:
    """Average distance of the vertices in the true and the estimated pose (Hinterstoisser et al. 2012)."""
    difference = estimate.scale * estimate.rotation - truth.scale * truth.rotation
    moved = _apply(difference, estimate.translation - truth.translation, points)
    return jnp.mean(_length(moved))


def add_s(
    points: Float[Array, "n 3"], truth: Similarity, estimate: Similarity, *, block: int = 512
) -> Float[Array, ""]:
    """Average distance of the vertices in the true pose to the NEAREST vertex in the estimated pose: ADD-S, or ADI.

    Memory: block × n. A matrix product finds the nearest vertex, a difference measures it (the product alone cancels:
    in float32 it cannot tell 0 from 3e-4 of the object's size).
    """
    count = points.shape[0]
    # In the estimated object's frame one of the two sets is the model itself, and both are centred and small.
    rotation = jnp.matmul(estimate.rotation.T, truth.scale * truth.rotation, precision=HIGHEST) / estimate.scale
    shift = truth.translation - estimate.translation
    shift = jnp.matmul(estimate.rotation.T, shift, precision=HIGHEST) / estimate.scale
    moved = _apply(rotation, shift, points)
    centre = jnp.mean(points, axis=0)
    model, moved = points - centre, moved - centre
    model_squares = jnp.sum(model**2, axis=-1)

    def nearest(rows: Array) -> Array:
        inner = jnp.matmul(rows, model.T, precision=HIGHEST)
        closest = jnp.argmin(model_squares - 2 * inner, axis=-1)
        return _length(rows - model[closest])

    block = min(block, count)
    padded = jnp.pad(moved, ((0, -count % block), (0, 0)))
    distances = jax.lax.map(nearest, padded.reshape(-1, block, 3)).reshape(-1)[:count]
    return estimate.scale * jnp.mean(distances)


# Poses with their size


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
    """What BOP's errors do not see: its files hold no size, so that its scores move the model rigidly, and a pose whose
    size is wrong by a third is perfect. Here the estimate maps the model's points with its own scale.

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


def average_recall(errors: Float[Array, "*b n"], thresholds: Float[Array, "t"] | None = None) -> Float[Array, "*b"]:
    """Mean of the recalls at several thresholds (BOP's ten, in diameters, when None), in [0, 1]."""
    chosen = jnp.asarray(THRESHOLDS if thresholds is None else thresholds, errors.dtype)
    return jnp.mean(recall(errors, chosen), axis=-1)


def area_under_accuracy(errors: Float[Array, "n"], limit: float = ADD_LIMIT) -> Float[Array, ""]:
    """Area under the accuracy-threshold curve from 0 to ``limit``, in [0, 1]: the AUC of ADD and ADD-S.

    Errors beyond the limit, and infinite ones, are misses. As in PoseCNN's toolbox (Xiang et al. 2018), the curve
    takes its higher value between two errors. Same unit for errors and limit; 0 for no errors at all.
    """
    count = errors.shape[0]
    if count == 0:
        return jnp.zeros((), errors.dtype)
    found = jnp.sum(errors <= limit)
    clipped = jnp.sort(jnp.where(errors <= limit, errors, limit))
    steps = jnp.diff(clipped, prepend=jnp.zeros((1,), errors.dtype))
    accuracy = jnp.minimum(jnp.arange(1, count + 1), found).astype(errors.dtype) / count
    rest = (limit - clipped[-1]) * found.astype(errors.dtype) / count
    return (jnp.sum(steps * accuracy) + rest) / limit


def recall(errors: Float[Array, "*b n"], thresholds: Float[Array, "t"]) -> Float[Array, "*b t"]:
    """Share of errors strictly below each threshold; NaN and infinity are misses. 0 for no errors at all."""
    below = errors[..., None, :] < thresholds[:, None]
    return jnp.sum(below, axis=-1).astype(errors.dtype) / max(errors.shape[-1], 1)


# Parts of a pose


def rotation_error(truth: Float[Array, "3 3"], estimate: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Angle between two rotations, radians in [0, π]; accurate at both ends, also in float32."""
    turn = jnp.matmul(estimate, truth.T, precision=HIGHEST)
    axis = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return jnp.arctan2(_length(axis), jnp.trace(turn) - 1)


def turn_angle(trace: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The angle of rotations with these traces, radians in [0, π]; its derivative is finite at both ends, too."""
    return 2 * jnp.arctan2(root((3 - trace) / 4), root((1 + trace) / 4))


def translation_error(truth: Float[Array, "3"], estimate: Float[Array, "3"]) -> Float[Array, ""]:
    """Distance between two translations, in their unit."""
    return _length(truth - estimate)


def scale_error(truth: Float[Array, ""], estimate: Float[Array, ""]) -> Float[Array, ""]:
    """How far the estimated scale is off, as a share of the true one: |s_e / s_g − 1|."""
    return jnp.abs(estimate / truth - 1)


def reprojection_error(
    points: Float[Array, "n 3"], camera: Camera, truth: Similarity, estimate: Similarity
) -> Float[Array, ""]:
    """Average distance of the projected vertices, pixels (BOP's ``proj``; no symmetries)."""
    seen = _flat_project(camera, _apply(truth.scale * truth.rotation, truth.translation, points))
    found = _flat_project(camera, _apply(estimate.scale * estimate.rotation, estimate.translation, points))
    return jnp.mean(_length(seen - found))


def _apply(rotation: Array, translation: Array, points: Array) -> Array:
    """``rotation @ x + translation`` for points [n, 3], as sums of products: exact in float32 on every backend. Not a
    :class:`Similarity`, which the difference of two is not."""
    moved = sum(rotation[..., None, :, i] * points[:, i, None] for i in range(3))
    return moved + translation[..., None, :]


def _flat_project(camera: Camera, points: Array) -> Array:
    """Pixels up to the camera's centre, which differences do not need. Unlike ``cameras.project`` it does not clamp
    points behind the camera: BOP mirrors them."""
    return camera.focal * points[..., :2] / _away_from_zero(points[..., 2:])


def _away_from_zero(depth: Array) -> Array:
    tiny = jnp.asarray(1e-9, depth.dtype)
    return jnp.where(jnp.abs(depth) < tiny, tiny, depth)


def _length(vectors: Array) -> Array:
    """Euclidean length along the last axis, with a finite gradient at 0."""
    return root(jnp.sum(vectors**2, axis=-1))


def _directions(count: int) -> np.ndarray:
    """Directions spread evenly over the sphere (Fibonacci)."""
    heights = 1 - (2 * np.arange(count) + 1) / count
    turns = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(turns), radii * np.sin(turns), heights], axis=-1)


def _require_axis(array: Array, axes: int, name: str) -> None:
    if array.ndim != axes + 1:
        raise ValueError(f"{name} must have {axes} leading axis, got translations of shape {array.shape}")
