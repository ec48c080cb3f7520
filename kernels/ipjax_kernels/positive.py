"""Small symmetric positive-definite systems in plain arithmetic: no call to LAPACK or cuSOLVER."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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


def invert_positive(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a small symmetric positive-definite matrix; singular directions get large finite values."""
    columns = jax.vmap(solve_positive, (None, 0))(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return (columns + columns.T) / 2


def principal_axis(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """A unit eigenvector of the largest eigenvalue of a positive semidefinite matrix, and that eigenvalue.

    By squaring: 64 steps of the power iteration. Where the two largest are nearly equal it is a mixture of both.
    """
    power = matrix
    for _ in range(6):
        power = power / jnp.maximum(jnp.trace(power), 1e-30)
        power = jnp.sum(power[:, :, None] * power[None, :, :], axis=1)
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    axis = column / jnp.maximum(jnp.linalg.norm(column), 1e-30)
    return axis, jnp.sum(axis * jnp.sum(matrix * axis, axis=1))
