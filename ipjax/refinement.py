"""From a coarse similarity to one that fits the depth image: robust least squares on Sim(3) or SE(3).

Both directions are associated: surface points with the depth they project to, and depth points with their nearest
surface point. One direction alone lets a free scale shrink or grow the object along the rays. Surface that projects
beside the mask is drawn to its outline, unless something hides it there.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ipjax.cameras import project
from ipjax.config import RefineConfig
from ipjax.types import Camera, Similarity, Surface


class Cloud(eqx.Module):
    """The query's depth as points on a coarse grid of the crop."""

    points: Float[Array, "g g 3"]  # metres, camera frame
    valid: Bool[Array, "g g"]
    camera: Camera  # of the grid: one pixel per cell
    mask: Bool[Array, "g g"]  # the object, with or without a depth
    depth: Float[Array, "g g"]  # metres, background included; 0 = unknown
    outline: Int[Array, "g g 2"]  # (column, row) of the nearest cell of the mask


def nearest_inside(mask: Bool[Array, "h w"]) -> Int[Array, "h w 2"]:
    """For every cell the (column, row) of the nearest cell that is set, the lowest row first; itself where none is.

    Two passes, along the rows and then along the columns, give the exact Euclidean answer.
    """
    height, width = mask.shape
    across = jnp.abs(jnp.arange(width)[:, None] - jnp.arange(width)[None, :])
    far = height + width
    steps = jnp.where(mask[:, None, :], across[None], far)  # row, from, to
    column = jnp.argmin(steps, axis=-1)
    away = jnp.min(steps, axis=-1)
    down = jnp.arange(height)[:, None] - jnp.arange(height)[None, :]
    squared = (down**2)[:, :, None] + (away**2)[None, :, :]  # from row, to row, column
    row = jnp.argmin(squared, axis=1)
    found = jnp.stack([jnp.take_along_axis(column, row, axis=0), row], axis=-1)
    itself = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(height)), axis=-1)
    return jnp.where(jnp.any(mask), found, itself).astype(jnp.int32)


def refine(
    surface: Surface,
    cloud: Cloud,
    camera_from_object: Similarity,
    config: RefineConfig = RefineConfig(),
    *,
    scale_known: bool = False,
) -> tuple[Similarity, Float[Array, ""]]:
    """Improve one hypothesis; the caller vmaps.

    Args:
      surface: the object's surface; its first ``config.points`` points are used.
      cloud: the masked depth, and what lies around it.
      camera_from_object: the hypothesis.
      scale_known: leave the scale as it is (SE(3) instead of Sim(3)).

    Returns:
      The refined similarity, never with a larger cost than the given one, and its mean robust cost in [0, 1].
    """
    points = surface.points[: config.points]
    normals = surface.normals[: config.points]
    trust = 0.25 + 0.75 * surface.seen[: config.points]
    start = camera_from_object

    def residuals(step, _):
        return _residuals(retract(start, step), points, normals, trust, cloud, config)

    count = 6 if scale_known else 7
    zero = jnp.zeros(count, start.translation.dtype)
    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5, linear_solver=NormalCholesky())
    solution = optx.least_squares(residuals, solver, zero, max_steps=config.steps, throw=False)
    before = jnp.mean(residuals(zero, None) ** 2)
    after = jnp.mean(residuals(solution.value, None) ** 2)
    better = jnp.isfinite(after) & (after < before)
    step = jnp.where(better, solution.value, zero)
    return retract(start, step), jnp.where(better, after, before)


def retract(start: Similarity, step: Float[Array, "n"]) -> Similarity:
    """Move by a tangent vector (rotation in rad, translation in diameters, log scale) about the object's centre."""
    rotation = rotation_from_vector(step[:3]) @ start.rotation
    translation = start.translation + start.scale * step[3:6]
    scale = start.scale * jnp.exp(step[6]) if step.shape[0] == 7 else start.scale
    return Similarity(rotation, translation, scale)


def rotation_from_vector(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rodrigues' formula, with a series near zero so that it and its derivative stay finite."""
    squared = jnp.sum(vector * vector)
    small = squared < 1e-6
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1 - squared / 6, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 0.5 - squared / 24, (1 - jnp.cos(angle)) / safe)
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    outer = vector[:, None] * vector[None, :]
    return jnp.eye(3, dtype=vector.dtype) * (1 - cosine * squared) + sine * cross + cosine * outer


def _residuals(moved, points, normals, trust, cloud, config):
    placed = moved @ points
    facing = jnp.sum(moved.rotation[None] * normals[:, None, :], axis=-1)
    distance = jnp.linalg.norm(placed, axis=-1)
    visible = lax.stop_gradient(jnp.sum(facing * placed, axis=-1) < -0.1 * distance)
    column, row, inside = _cells(placed, cloud)
    measured = cloud.valid[row, column] & inside
    forward = _robust(placed - cloud.points[row, column], facing, measured, moved.scale, config)
    beside = _beside(placed, cloud.outline[row, column], moved.scale, cloud.camera, config)
    on_mask = cloud.mask[row, column] & inside
    forward = jnp.where(on_mask, forward, beside) * jnp.sqrt(trust)
    # Surface that faces away, lies behind an occluder, or falls into a hole of the depth image cannot have been
    # measured and costs nothing.
    nearer = (cloud.depth[row, column] > 0) & (cloud.depth[row, column] < placed[:, 2] - config.reach * moved.scale / 2)
    counted = visible & ~lax.stop_gradient(jnp.where(on_mask, ~measured, nearer))
    forward = jnp.where(counted, forward, 0)
    targets = cloud.points[::2, ::2].reshape(-1, 3)
    known = cloud.valid[::2, ::2].reshape(-1)
    nearest = lax.stop_gradient(_nearest_visible(targets, placed, visible))
    backward = _robust(placed[nearest] - targets, facing[nearest], known, moved.scale, config)
    backward = jnp.where(known, backward * jnp.sqrt(trust[nearest]), 0)
    share = lambda count: lax.stop_gradient(jnp.sum(count))
    weigh = lambda count: jnp.sqrt(1 / jnp.maximum(count, 1)).astype(placed.dtype)
    # Hiding most of itself must not pay.
    terms = [forward * weigh(jnp.maximum(share(counted), share(visible) // 3)), backward * weigh(share(known))]
    together = jnp.concatenate(terms)
    return together * jnp.sqrt(jnp.asarray(together.shape[0], placed.dtype) / 2)


def _cells(placed, cloud):
    """The grid cell that each placed point projects to, and whether it is one."""
    height, width = cloud.valid.shape
    pixel = lax.stop_gradient(jnp.round(project(cloud.camera, placed))).astype(jnp.int32)
    inside = jnp.all((pixel >= 0) & (pixel < jnp.array([width, height], jnp.int32)), axis=-1)
    return jnp.clip(pixel[:, 0], 0, width - 1), jnp.clip(pixel[:, 1], 0, height - 1), inside


def _beside(placed, outline, scale, camera, config):
    """Geman–McClure on the sideways distance to the mask's outline, a cell's own reach of it free.

    On top of a fixed share: leaving the mask must cost more than fitting badly inside it.
    """
    offset = project(camera, placed) - outline.astype(placed.dtype)
    apart = jnp.sqrt(jnp.sum(offset**2, axis=-1) + 1e-12)
    metres = jnp.maximum(apart - 0.75, 0) * placed[:, 2] / jnp.mean(camera.focal)
    squared = (metres / (config.outline_width * scale)) ** 2
    return jnp.sqrt(0.8 + 0.2 * squared / (1 + squared))


def _robust(offset, normal, ok, scale, config):
    """Geman–McClure on the point-to-plane distance; unmatched points cost the maximum, 1, so that losing a match
    never pays."""
    plane = jnp.sum(offset * normal, axis=-1)
    tangent = jnp.sum(offset * offset, axis=-1) - plane**2
    squared = (plane**2 + 0.05 * jnp.maximum(tangent, 0)) / (config.width * scale) ** 2
    near = lax.stop_gradient(ok & (jnp.sum(offset * offset, axis=-1) < (config.reach * scale) ** 2))
    return jnp.where(near, jnp.sqrt(squared / (1 + squared) + 1e-12), 1.0)


_TOGETHER = 8  # points compared in one step on a CPU


def _nearest_visible(targets, placed, visible):
    """Index of the nearest visible point for each target; the first of equals, and the first point if none is."""

    def by_points(targets, placed, visible):
        # A CPU vectorises neither an argmin nor a minimum along the last axis. This compares a few points at a time
        # with the nearest so far of all targets.
        count = placed.shape[0]
        padding = -count % _TOGETHER
        parts = (
            jnp.pad(placed, ((0, padding), (0, 0))).reshape(-1, _TOGETHER, 3),
            jnp.pad(visible, (0, padding)).reshape(-1, _TOGETHER),
            jnp.arange(count + padding, dtype=jnp.int32).reshape(-1, _TOGETHER),
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


class NormalCholesky(lx.AbstractLinearSolver):
    """Least squares through the normal equations and an unrolled Cholesky factorisation.

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
        raise ValueError("NormalCholesky solves least squares only; it has no transpose")

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n"]) -> Float[Array, "n"]:
    """Solve a small symmetric positive-definite system by LDLᵀ, unrolled; singular directions get a zero."""
    size = matrix.shape[0]
    floor = 1e-9 * jnp.max(jnp.abs(matrix)) + 1e-30
    lower: list[list[Array]] = []
    pivots: list[Array] = []
    for row in range(size):
        entries: list[Array] = []
        for column in range(row):
            inner = sum(entries[k] * lower[column][k] * pivots[k] for k in range(column))
            entries.append((matrix[row, column] - inner) / pivots[column])
        pivots.append(jnp.maximum(matrix[row, row] - sum(entries[k] ** 2 * pivots[k] for k in range(row)), floor))
        lower.append(entries)
    forward: list[Array] = []
    for row in range(size):
        forward.append(right[row] - sum(lower[row][k] * forward[k] for k in range(row)))
    solution: list[Array] = [right[0]] * size
    for row in reversed(range(size)):
        rest = sum(lower[k][row] * solution[k] for k in range(row + 1, size))
        solution[row] = forward[row] / pivots[row] - rest
    return jnp.stack(solution)
