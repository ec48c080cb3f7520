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
import optimistix as optx
from ipjax_kernels.positive import invert_semidefinite, solve_positive
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ipjax.config import RefineConfig
from ipjax.estimation.residuals import (
    Cloud,
    linearise,
    mean_cost,
    mean_square,
    nearest_visible,
    place_surface,
    total_weight,
)
from ipjax.records import Pairs, Similarity, Surface
from ipjax.transforms import retract


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
    placed, facing, visible = place_surface(camera_from_object, points, normals)
    targets = cloud.points.reshape(-1, 3)
    nearest = nearest_visible(targets, placed, visible)
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

    Free are ``rigid`` coordinates of :func:`retract` and then strains. ``unit``: as for :func:`residuals_after`.
    """
    given = surface, cloud, pairs, jnp.zeros_like(start.scale) if unit is None else unit, config
    if not config.steps:
        cost = mean_cost(start, jnp.zeros(rigid + strains, start.translation.dtype), *given, rigid=rigid)
        return start, cost, cost
    # The derivative at the minimum does not depend on the start: the graph need not hold that of the start.
    pose, _, cost, before = _search(rigid, strains, lax.stop_gradient(start), *given)
    return pose, cost, before


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _search(rigid, strains, start, surface, cloud, pairs, unit, config):
    """The pose and strain at the minimum, their cost and that of the start; differentiated as an implicit function."""
    given = surface, cloud, pairs, unit, config
    zero = jnp.zeros(rigid + strains, start.translation.dtype)

    def linear(step, _):
        point = lax.stop_gradient(step)
        value, slopes = linearise(start, point, *given, rigid=rigid)
        # The sum is zero and has the slopes as its derivative: the solver differentiates a linear function.
        return value + jnp.sum(slopes * (step - point), axis=1)

    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5, linear_solver=NormalEquations())
    solver = eqx.tree_at(lambda s: s.search, solver, _SearchWithFirstValue(optx.ClassicalTrustRegion()))
    solution = optx.least_squares(linear, solver, zero, max_steps=config.steps, throw=False)
    residuals = solution.state.f_info.residual
    before = 2 * solution.state.search_state.first / (residuals.shape[0] - strains)
    after = mean_square(residuals, strains)
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
        return mean_cost(pose, start + step, *given, rigid=rigid)

    slope = jax.grad(cost)
    hessian = jax.jacfwd(slope)(zero, given)
    (cost_change, slope_change) = jax.jvp(lambda given: jax.value_and_grad(cost)(zero, given), (given,), (changes,))[1]
    step_change = -jnp.sum(invert_semidefinite(hessian) * slope_change, axis=1)
    move = lambda step: (retract(pose, step[:rigid]), strain + step[rigid:])
    pose_change, strain_change = jax.jvp(move, (zero,), (step_change,))[1]
    return found, (pose_change, strain_change, cost_change, jnp.zeros_like(cost_change))


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


def information(
    surface: Surface, cloud: Cloud, camera_from_object: Similarity, config: RefineConfig = RefineConfig()
) -> tuple[Float[Array, "7 7"], Float[Array, ""]]:
    """JᵀJ of the residuals at a pose, over the tangent of :func:`retract`, and their sum of squares.

    Each kind of residual (surface to depth, depth to surface, silhouette) is averaged: their number does not matter.
    """
    zero = jnp.zeros(7, camera_from_object.translation.dtype)
    unit = jnp.zeros_like(camera_from_object.scale)
    values, slopes = linearise(camera_from_object, zero, surface, cloud, None, unit, config, rigid=7)
    # Its terms add up to the mean square, here to the sum.
    share = total_weight(None, zero.dtype, config) / values.shape[0]
    return jnp.sum(slopes[:, :, None] * slopes[:, None, :], axis=0) * share, jnp.sum(values**2) * share


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
