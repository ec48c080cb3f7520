"""Small symmetric positive-definite systems in plain arithmetic, and roots: no call to LAPACK or cuSOLVER."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def root(square: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The square root of what is positive but for rounding; at 0, where it has none, its derivative is 0."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n"]) -> Float[Array, "n"]:
    """Solve a small symmetric positive-definite system; singular directions get a zero."""
    return _eliminate(matrix, right[:, None])[:, 0]


def _eliminate(matrix, right):
    """Gauss and Jordan's elimination, which needs no pivoting here. A loop, not unrolled, to compile fast."""
    size = matrix.shape[0]
    floor = 1e-9 * jnp.max(jnp.abs(matrix)) + 1e-30
    rows = jnp.arange(size, dtype=jnp.int32)

    def clear(step, table):
        pivot = table[step] / jnp.maximum(table[step, step], floor)
        rest = table - table[:, step, None] * pivot
        return jnp.where((rows == step)[:, None], pivot, rest)

    return lax.fori_loop(0, size, clear, jnp.concatenate([matrix, right], axis=1))[:, size:]


def invert_positive(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a small symmetric positive-definite matrix; singular directions get large finite values."""
    columns = _eliminate(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return (columns + columns.T) / 2


def invert_semidefinite(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A generalised inverse of a small symmetric matrix that is positive semidefinite but for rounding.

    Coordinates whose curvature, the earlier ones being free, is not above a 1e-5th of its own are left out: their rows
    and columns are zero. All of it is zero where the matrix is not finite.
    """
    fine = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(fine, matrix, 0)
    least = 1e-5 * jnp.abs(jnp.diagonal(matrix))
    rows = jnp.arange(matrix.shape[0], dtype=jnp.int32)

    def sweep(step, table):
        # Gauss and Jordan's elimination in place (Goodnight, "A tutorial on the SWEEP operator", 1979).
        here = rows == step
        pivot = table[step, step]
        known = pivot > least[step]
        row = table[step] / jnp.where(known, pivot, 1)
        column = table[:, step]
        swept = table - column[:, None] * row[None, :]
        swept = jnp.where(here[:, None], row[None, :], swept)
        swept = jnp.where(here[None, :], (-column / jnp.where(known, pivot, 1))[:, None], swept)
        swept = jnp.where(here[:, None] & here[None, :], 1 / jnp.where(known, pivot, 1), swept)
        return jnp.where(known, swept, jnp.where(here[:, None] | here[None, :], 0, table))

    inverse = lax.fori_loop(0, matrix.shape[0], sweep, matrix)
    return (inverse + inverse.T) / 2


def principal_axis(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """A unit eigenvector of the largest eigenvalue of a positive semidefinite matrix, and that eigenvalue.

    By squaring: 64 steps of the power iteration. Where the two largest are nearly equal it is a mixture of both.
    """
    power = matrix
    for _ in range(6):
        power = power / jnp.maximum(jnp.trace(power), 1e-30)
        power = jnp.sum(power[:, :, None] * power[None, :, :], axis=1)
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    axis = column / jnp.maximum(root(jnp.sum(column * column)), 1e-30)
    return axis, jnp.sum(axis * jnp.sum(matrix * axis, axis=1))
