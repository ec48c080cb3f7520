"""From a coarse similarity to one that fits the depth image: robust least squares on Sim(3) or SE(3).

Both directions are associated: surface points with the depth they project to, and depth points with their nearest
surface point. One direction alone lets a free scale shrink or grow the object along the rays. The object's silhouette
is fitted to the mask's border, which determines the size better than depth does; surface that projects outside the
mask costs the maximum of the loss. Neither counts where an occluder hides the object.

A mesh may be wrong. A last refinement (:func:`settle`) may change its proportions, so that the pose need not make up
for them; or, where its surface is uneven, it widens the losses, and matched pairs of patches constrain the motion that
the surface no longer does.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from ipjax_kernels.positive import invert_semidefinite, root, solve_positive
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ipjax.cameras import mask_from_coverage, project
from ipjax.config import RefineConfig
from ipjax.records import Camera, Pairs, Similarity, Surface
from ipjax.transforms import retract


class Contour(eqx.Module):
    """Points on the mask's border where nothing hides the object, in cells of the grid."""

    points: Float[Array, "b 2"]  # (column, row)
    outward: Float[Array, "b 2"]  # unit normals
    bend: Float[Array, "b"]  # curvature, 1 / cells; positive where the object is convex
    valid: Bool[Array, "b"]


def trace_contour(
    cover: Float[Array, "h w"] | Bool[Array, "h w"],
    depth: Float[Array, "h w"],
    nearer: Float[Array, ""] | float,
    count: int,
) -> Contour:
    """About ``count`` points spread over the border between an object and what lies around it.

    Args:
      cover: the share of each cell that the object covers, or a mask. The border runs where it is one half, found
        between cells: on either axis, so that its points are off to neither side whatever its direction. Where it is
        curved, they are moved by as much as the mean over a cell, and the line between two, cut off a bend.
      depth: metres, 0 = unknown. What is by ``nearer`` before the object's depth beside it cuts the object: the border
        is its own there, and left out, as is the border of the image.
      count: where the whole border is shorter, the remaining points are not valid.
    """
    height, width = cover.shape
    cover = cover.astype(depth.dtype)
    mask = mask_from_coverage(cover)
    reach = 2  # cells that the normals are smoothed over, and that occluders are looked for in

    def window(image, radius, combine, beyond):
        """Combine each cell's square neighbourhood, rows first."""
        padded = jnp.pad(image, radius, constant_values=beyond)
        rows = functools.reduce(combine, [padded[i : i + height] for i in range(2 * radius + 1)])
        return functools.reduce(combine, [rows[:, i : i + width] for i in range(2 * radius + 1)])

    of_object = window(jnp.where(mask & (depth > 0), depth, jnp.inf), reach, jnp.minimum, jnp.inf)
    before = ~mask & (depth > 0) & jnp.isfinite(of_object) & (depth < of_object - nearer)
    cut = window(before, 1, jnp.logical_or, False)

    # Edge padding: at the image's border the object goes on.
    smooth = jnp.pad(cover, reach + 1, mode="edge")
    binomial = np.array([1, 4, 6, 4, 1], depth.dtype) / 16
    smooth = jnp.sum(jnp.stack([w * smooth[i : i + height + 2] for i, w in enumerate(binomial)]), axis=0)
    smooth = jnp.sum(jnp.stack([w * smooth[:, i : i + width + 2] for i, w in enumerate(binomial)]), axis=0)
    slope = jnp.stack([smooth[1:-1, :-2] - smooth[1:-1, 2:], smooth[:-2, 1:-1] - smooth[2:, 1:-1]], axis=-1)

    # The curvature of the lines of one share is the divergence of their normals.
    across, down = jnp.moveaxis(slope / jnp.sqrt(jnp.sum(slope**2, axis=-1, keepdims=True) + 1e-12), -1, 0)
    across, down = jnp.pad(across, ((0, 0), (1, 1)), mode="edge"), jnp.pad(down, ((1, 1), (0, 0)), mode="edge")
    bend = jnp.clip((across[:, 2:] - across[:, :-2] + down[2:] - down[:-2]) / 2, -0.5, 0.5)

    row, column = np.mgrid[:height, :width]
    cell = np.stack([column, row], axis=-1)

    def crossings(axis):
        """The border between each cell and the next: where, its normal and curvature, how far in it lies for each unit
        of curvature, and a rank that is 0 where there is none."""
        here, there = (np.s_[:, :-1], np.s_[:, 1:]) if axis == 0 else (np.s_[:-1], np.s_[1:])
        crosses = mask[here] != mask[there]
        change = cover[here] - cover[there]
        even = jnp.abs(change) < 0.01  # two cells that are covered by one half
        share = jnp.where(even, 0.5, jnp.clip((cover[here] - 0.5) / jnp.where(even, 1, change), 0, 1))
        place = cell[here].astype(depth.dtype) + share[..., None] * np.eye(2, dtype=depth.dtype)[axis]
        kept = crosses & ~jnp.where(mask[here], cut[here], cut[there])
        # A fixed shuffle: neighbours lie far apart.
        spread = ((row * 7919 + column * 104729 + axis * 2011) % 4093).astype(np.int32)[here]
        # A bend of curvature k lies k v / 2 farther in where it is blurred with variance v along it. A cell blurs with
        # 1 / 12, and the line between two cells with share (1 - share), as far as it runs along the border.
        normal = slope[here] + slope[there]
        askew = 1 - normal[..., axis] ** 2 / (jnp.sum(normal**2, axis=-1) + 1e-12)
        loss = 1 / 24 + askew * share * (1 - share) / 2
        return place, normal, (bend[here] + bend[there]) / 2, loss, jnp.where(kept, spread + 1, 0)

    flat = lambda first, second: jnp.concatenate([x.reshape(-1, *x.shape[2:]) for x in (first, second)])
    *found, rank = (flat(*both) for both in zip(crossings(0), crossings(1), strict=True))
    rank, chosen = lax.top_k(rank, min(count, rank.shape[0]))
    place, normal, bend, loss = (x[chosen] for x in found)
    outward = normal / jnp.sqrt(jnp.sum(normal**2, axis=-1, keepdims=True) + 1e-12)
    return Contour(place + (bend * loss)[:, None] * outward, outward, bend, rank > 0)


class Cloud(eqx.Module):
    """The query's depth as points on a coarse grid of the crop."""

    points: Float[Array, "g g 3"]  # metres, camera frame
    valid: Bool[Array, "g g"]
    camera: Camera  # of the grid: one pixel per cell
    mask: Bool[Array, "g g"]  # the object, with or without a depth
    depth: Float[Array, "g g"]  # metres, background included; 0 = unknown
    contour: Contour


def refine(
    surface: Surface,
    cloud: Cloud,
    camera_from_object: Similarity,
    config: RefineConfig = RefineConfig(),
    *,
    scale_known: bool = False,
) -> tuple[Similarity, Float[Array, ""]]:
    """Improve one hypothesis; the caller vmaps.

    Differentiable in both modes with respect to all but the hypothesis, by the implicit function theorem: a minimum
    does not depend on where the search for it began. Which point is compared with which is held as it is. The
    derivative is that of the minimum where ``config.steps`` reached one; elsewhere it is that of one Newton step from
    the pose returned, finite but of a pose not yet found. Without steps the pose passes through, its derivative too.

    Args:
      surface: the object's surface; its first ``config.points`` points are fitted to the depth, all to the mask.
      cloud: the masked depth, and what lies around it.
      camera_from_object: the hypothesis.
      scale_known: leave the scale as it is (SE(3) instead of Sim(3)).

    Returns:
      The refined similarity, never with a larger cost than the given one, and its mean robust cost in [0, 1].
    """
    return _fit(surface, cloud, camera_from_object, None, config, rigid=6 if scale_known else 7)[:2]


def settle(
    surface: Surface,
    cloud: Cloud,
    camera_from_object: Similarity,
    pairs: Pairs,
    config: RefineConfig = RefineConfig(),
    *,
    scale_known: bool = False,
) -> Similarity:
    """The last refinement of the chosen hypothesis, for a mesh that is wrong in one of two ways.

    Its proportions may be wrong: then a symmetric strain is fitted with the pose. Strain can explain a wrong pose, too;
    so it is fitted in this last step only, and used only where the cost falls by the share ``config.gain``. The losses
    keep their width in metres, or the mesh would grow to widen them. Or its surface may be uneven (:func:`unevenness`):
    then the losses are ``config.forgiveness`` times as wide as that, and the wider they are, the more weight the pairs
    get, which do not depend on the shape of the surface. On an even surface of the right proportions it is one more
    :func:`refine`.

    Args:
      surface, cloud, scale_known: as for :func:`refine`.
      camera_from_object: the hypothesis, refined.
      pairs: correspondences ``k``, of whatever views; weight 0 = absent. Wrong ones hardly count, the loss is robust.
    """
    rigid = 6 if scale_known else 7
    width = jnp.maximum(config.width, config.forgiveness * unevenness(surface, cloud, camera_from_object, config))
    wider = width / config.width

    def fit(strain, wider, pair_weight, unit):
        reach = jnp.maximum(config.reach, 2 * config.width * wider)
        changed = strain, config.width * wider, reach, config.silhouette_width * wider, pair_weight
        fields = lambda c: (c.strain, c.width, c.reach, c.silhouette_width, c.pair_weight)
        allowed = eqx.tree_at(fields, config, changed)
        return _fit(surface, cloud, camera_from_object, pairs, allowed, unit, rigid=rigid, strains=STRAINS)

    # One function for both cases, so that it is compiled once: with free proportions, and with (almost) fixed ones.
    one = jnp.ones_like(width)
    ways = (
        jnp.stack([config.strain * one, 1e-3 * config.strain * one]),
        jnp.stack([one, wider]),
        jnp.stack([0 * one, config.pair_weight * (1 - wider**-2.0)]),
        jnp.stack([camera_from_object.scale, 0 * one]),
    )
    poses, after, before = jax.vmap(fit)(*ways)
    strained_enough = after[0] < before[0] * (1 - config.gain)
    return jax.tree.map(lambda both: jnp.where(strained_enough, both[0], both[1]), poses)


STRAINS = 5  # of a symmetric matrix without a trace


def unevenness(
    surface: Surface, cloud: Cloud, camera_from_object: Similarity, config: RefineConfig = RefineConfig()
) -> Float[Array, ""]:
    """The standard deviation of the surface from the measured depth, in diameters, along its normals.

    From the median, over depth points within ``_UNRELATED`` of visible surface.
    """
    points, normals = surface.points[: config.points], surface.normals[: config.points]
    placed, facing, visible = _place(camera_from_object, points, normals)
    targets = cloud.points.reshape(-1, 3)
    nearest = _nearest_visible(targets, placed, visible)
    offset = (placed[nearest] - targets) / camera_from_object.scale
    near = cloud.valid.reshape(-1) & (jnp.sum(offset * offset, axis=-1) < _UNRELATED**2) & jnp.any(visible)
    plane = jnp.where(near, jnp.abs(jnp.sum(offset * facing[nearest], axis=-1)), jnp.inf)
    median = jnp.sort(plane)[jnp.maximum(jnp.sum(near) - 1, 0) // 2]
    return 1.48 * jnp.where(jnp.any(near), median, 0)


_UNRELATED = 0.15  # diameters: depth farther from the surface than this is taken for another object's


def _fit(
    surface: Surface,
    cloud: Cloud,
    start: Similarity,
    pairs: Pairs | None,
    config: RefineConfig,
    unit: Float[Array, ""] | None = None,
    *,
    rigid: int,
    strains: int = 0,
) -> tuple[Similarity, Float[Array, ""], Float[Array, ""]]:
    """The least-squares pose, its mean robust cost and that of the start; the start itself where none is better.

    Free are ``rigid`` coordinates of :func:`retract` and then strains. ``unit``: as for :func:`_terms`.
    """
    given = surface, cloud, pairs, config, jnp.zeros_like(start.scale) if unit is None else unit
    if not config.steps:
        cost = _cost(start, jnp.zeros(rigid + strains, start.translation.dtype), *given, rigid=rigid)
        return start, cost, cost
    # The derivative at the minimum does not depend on the start: the graph need not hold that of the start.
    pose, _, cost, before = _search(rigid, strains, lax.stop_gradient(start), *given)
    return pose, cost, before


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _search(rigid, strains, start, surface, cloud, pairs, config, unit):
    """The pose and strain at the minimum, their cost and that of the start; differentiated as an implicit function."""
    given = surface, cloud, pairs, config, unit
    zero = jnp.zeros(rigid + strains, start.translation.dtype)

    def linear(step, _):
        point = lax.stop_gradient(step)
        value, slopes = _linearise(start, point, *given, rigid=rigid)
        # The sum is zero and has the slopes as its derivative: the solver differentiates a linear function.
        return value + jnp.sum(slopes * (step - point), axis=1)

    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5, linear_solver=NormalEquations())
    solver = eqx.tree_at(lambda s: s.search, solver, _SearchWithFirstValue(optx.ClassicalTrustRegion()))
    solution = optx.least_squares(linear, solver, zero, max_steps=config.steps, throw=False)
    residuals = solution.state.f_info.residual
    before = 2 * solution.state.search_state.first / (residuals.shape[0] - strains)
    after = _mean_square(residuals, strains)
    better = after < before  # false where it is not finite
    step = jnp.where(better, solution.value, 0)
    return retract(start, step[:rigid]), step[rigid:], jnp.where(better, after, before), before


@_search.defjvp
def _differentiate_search(rigid, strains, primals, tangents):
    # At a minimum the gradient of the cost is zero, and stays so: H step' + (gradient)' = 0. With the exact Hessian H,
    # not Gauss and Newton's, which lacks the curvature of the losses and of the residuals.
    found = _search(rigid, strains, *primals)
    pose, strain, _, _ = found
    given, changes = primals[1:], tangents[1:]
    zero = jnp.zeros(rigid + strains, pose.translation.dtype)
    start = jnp.concatenate([zero[:rigid], strain])

    def cost(step, given):
        return _cost(pose, start + step, *given, rigid=rigid)

    slope = jax.grad(cost)
    hessian = jax.jacfwd(slope)(zero, given)
    (cost_change, slope_change) = jax.jvp(lambda given: jax.value_and_grad(cost)(zero, given), (given,), (changes,))[1]
    step_change = -jnp.sum(invert_semidefinite(hessian) * slope_change, axis=1)
    move = lambda step: (retract(pose, step[:rigid]), strain + step[rigid:])
    pose_change, strain_change = jax.jvp(move, (zero,), (step_change,))[1]
    return found, (pose_change, strain_change, cost_change, jnp.zeros_like(cost_change))


def _cost(start, step, surface, cloud, pairs, config, unit, *, rigid):
    strains = step.shape[0] - rigid
    return _mean_square(_terms(start, step, surface, cloud, pairs, config, unit, rigid=rigid), strains)


def _mean_square(values, strains):  # the prior adds to it but is no residual of the image
    return jnp.sum(values**2) / (values.shape[0] - strains)


class _SearchState(eqx.Module):
    """The state of a search, and the function's value at the start, so that it need not be computed again."""

    inner: Any
    first: Float[Array, ""]


class _SearchWithFirstValue(optx.AbstractSearch[Any, Any, Any, _SearchState]):
    """A search that keeps the first value, in the precision of its argument (Optimistix uses the default precision)."""

    inner: optx.AbstractSearch

    def init(self, y: Any, f_info_struct: Any) -> _SearchState:
        inner = jax.tree.map(lambda x: x.astype(y.dtype), self.inner.init(y, f_info_struct))
        return _SearchState(inner, jnp.zeros((), y.dtype))

    def step(
        self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: _SearchState
    ) -> tuple[Any, Any, optx.RESULTS, _SearchState]:
        size, accept, result, inner = self.inner.step(first_step, y, y_eval, f_info, f_eval_info, state.inner)
        first = jnp.where(first_step, f_eval_info.as_min(), state.first)
        return size, accept, result, _SearchState(inner, first)


@functools.partial(jax.jit, static_argnames="rigid")  # so that it is traced once
def _linearise(
    start: Similarity,
    step: Float[Array, "n"],
    surface: Surface,
    cloud: Cloud,
    pairs: Pairs | None,
    config: RefineConfig,
    unit: Float[Array, ""],
    *,
    rigid: int,
) -> tuple[Float[Array, "r"], Float[Array, "r n"]]:
    """The residuals of :func:`_terms` and their slopes.

    All slopes at once: left to the solver, they are a function that it carries through its loop, which takes twice as
    long to compile.
    """

    def residuals(step):
        values = _terms(start, step, surface, cloud, pairs, config, unit, rigid=rigid)
        return values, values

    slopes, values = jax.jacfwd(residuals, has_aux=True)(step)
    return values, slopes


def _terms(
    start: Similarity,
    step: Float[Array, "n"],
    surface: Surface,
    cloud: Cloud,
    pairs: Pairs | None,
    config: RefineConfig,
    unit: Float[Array, ""],
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
    spread = jnp.sqrt(values.shape[0] / _weight(config, pairs, step.dtype))
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


def _weight(config: RefineConfig, pairs: Pairs | None, dtype: Any) -> Float[Array, ""]:
    """The largest sum of squares of all residuals: 1 for each direction of the depth association, and the weights."""
    weight = 2 + jnp.asarray(config.silhouette_weight, dtype)
    return weight if pairs is None else weight + jnp.asarray(config.pair_weight, dtype)


def information(
    surface: Surface, cloud: Cloud, camera_from_object: Similarity, config: RefineConfig = RefineConfig()
) -> tuple[Float[Array, "7 7"], Float[Array, ""]]:
    """JᵀJ of the residuals at a pose, over the tangent of :func:`retract`, and their sum of squares.

    Each kind of residual (surface to depth, depth to surface, silhouette) is averaged: their number does not matter.
    """
    zero = jnp.zeros(7, camera_from_object.translation.dtype)
    unit = jnp.zeros_like(camera_from_object.scale)
    values, slopes = _linearise(camera_from_object, zero, surface, cloud, None, config, unit, rigid=7)
    # Its terms add up to the mean square, here to the sum.
    share = _weight(config, None, zero.dtype) / values.shape[0]
    return jnp.sum(slopes[:, :, None] * slopes[:, None, :], axis=0) * share, jnp.sum(values**2) * share


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


def _place(moved, points, normals):
    """Points and normals in the camera frame, and which of them show it their front."""
    placed = moved @ points
    facing = jnp.sum(moved.rotation[None] * normals[:, None, :], axis=-1)
    seen = lax.stop_gradient(jnp.sum(facing * placed, axis=-1) < -_GRAZING * jnp.linalg.norm(placed, axis=-1))
    return placed, facing, seen


# Least cosine at which surface is seen to be compared. What is about to turn away projects beside the mask as soon as
# the object is a little too large, where a point costs the most it can: objects would come out too small.
_GRAZING = 0.3


def _depth_terms(moved, unit, points, normals, trust, cloud, config):
    """Surface to depth and depth to surface; the squares of each sum to at most 1."""
    placed, facing, visible = _place(moved, points, normals)
    column, row, inside = _cells(placed, cloud)
    measured = cloud.valid[row, column] & inside
    forward = _robust(placed - cloud.points[row, column], facing, measured, unit, config)
    forward = forward * jnp.sqrt(trust)
    on_mask = cloud.mask[row, column] & inside
    # Surface that faces away, lies behind an occluder, or falls into a hole of the depth image cannot have been
    # measured and costs nothing.
    nearer = (cloud.depth[row, column] > 0) & (cloud.depth[row, column] < placed[:, 2] - config.reach * unit / 2)
    counted = visible & ~lax.stop_gradient(jnp.where(on_mask, ~measured, nearer))
    forward = jnp.where(counted, forward, 0)
    targets = cloud.points[::2, ::2].reshape(-1, 3)
    known = cloud.valid[::2, ::2].reshape(-1)
    nearest = lax.stop_gradient(_nearest_visible(targets, placed, visible))
    backward = _robust(placed[nearest] - targets, facing[nearest], known, unit, config)
    backward = jnp.where(known, backward * jnp.sqrt(trust[nearest]), 0)
    # At least a third of the visible points count: else a pose whose points are mostly occluded would cost little.
    count = jnp.maximum(jnp.sum(counted), jnp.sum(visible) // 3)
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


def _nearest_visible(targets, placed, visible):
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


class NormalEquations(lx.AbstractLinearSolver):
    """Least squares through the normal equations.

    For a handful of unknowns. Unlike lineax's solvers it lowers to plain arithmetic: no LAPACK or cuSOLVER call, so
    the graph can be exported and vmapped freely.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        del options
        matrix = operator.as_matrix()
        normal = jnp.sum(matrix[:, :, None] * matrix[:, None, :], axis=0)
        return matrix, normal

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> Any:
        del options
        matrix, normal = state
        flat, _ = ravel_pytree(vector)
        right = jnp.sum(matrix * flat[:, None], axis=0)
        return solve_positive(normal, right), lx.RESULTS.successful, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        raise ValueError("NormalEquations solves least squares only; it has no transpose")

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        return state, options

    def assume_full_rank(self) -> bool:
        return True
