"""Small motions of a camera: turns, what they do elsewhere, and descending along them (Levenberg–Marquardt)."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ipjax_kernels.positive import root, solve_positive


def descend(
    evaluate: Callable[..., tuple[Any, ...]],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    *,
    longest: float,
    steps: int,
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], tuple[Any, ...]]:
    """``steps`` of damped Gauss–Newton. One that does not lower the loss is not taken, and the next is damped more.

    Args:
      evaluate: from rotation and translation to the loss, half its Hessian (6 × 6) and half its slope (6) in (turn,
        shift), and whatever else.
      longest: turn of one step, rad.

    Returns:
      The pose, and what ``evaluate`` says of it.
    """

    def step(state, _):
        rotation, translation, here, damping = state
        loss, hessian, slope = here[:3]
        diagonal = jnp.diagonal(hessian)
        largest = jnp.max(diagonal)
        # Where nothing tells the pose it stays, and its derivative, in which the inverse is squared, is finite.
        floor = jnp.where(largest > 1e-12, 1e-9 * largest, 1)
        damped = hessian + jnp.diag(damping * diagonal + floor)
        move = -solve_positive(damped, slope)
        length = root(jnp.sum(move[:3] ** 2))
        move = move * jnp.minimum(1, longest / jnp.maximum(length, 1e-6))
        new_rotation = jnp.matmul(exponential(move[:3]), rotation, precision="highest")
        new_translation = translation + move[3:]
        new = evaluate(new_rotation, new_translation)
        better = new[0] < loss
        choose = lambda fresh, old: jax.tree.map(lambda a, b: jnp.where(better, a, b), fresh, old)
        state = choose((new_rotation, new_translation, new), (rotation, translation, here))
        return (*state, jnp.clip(jnp.where(better, damping / 5, damping * 5), 1e-6, 1e6)), None

    start = rotation, translation, evaluate(rotation, translation), jnp.asarray(1e-2, translation.dtype)
    (rotation, translation, here, _), _ = lax.scan(step, start, None, length=steps)
    return rotation, translation, here


def exponential(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation by |turn| about it (Rodrigues), exact at zero, too."""
    squared = jnp.sum(turn**2)
    small = squared < 1e-8
    angle = root(jnp.where(small, 1, squared))
    sine = jnp.where(small, 1 - squared / 6, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - squared / 24, (1 - jnp.cos(angle)) / jnp.where(small, 1, squared))
    cross = cross_matrix(turn)
    return jnp.eye(3, dtype=turn.dtype) + sine * cross + versine * jnp.matmul(cross, cross, precision="highest")


def cross_matrix(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix that takes w to ``vector`` × w."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def carry(arm: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """From (turn about a point, shift of it) to those of a point ``arm`` away: its shift is more by turn × arm.

    To the first order; the adjoint of a translation.
    """
    return jnp.eye(6, dtype=arm.dtype).at[3:, :3].set(-cross_matrix(arm))
