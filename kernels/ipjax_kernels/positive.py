"""Small symmetric positive-definite systems in plain arithmetic: no call to LAPACK or cuSOLVER."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n"]) -> Float[Array, "n"]:
    """Solve a small symmetric positive-definite system; singular directions get a zero."""
    return _eliminate(matrix, right[:, None])[:, 0]


def _eliminate(matrix, right):
    """Gauss and Jordan's elimination, which needs no pivoting here. A loop, not unrolled, to compile fast."""
    size = matrix.shape[0]
    floor = 1e-9 * jnp.max(jnp.abs(matrix)) + 1e-30
    rows = jnp.arange(size)

    def clear(step, table):
        pivot = table[step] / jnp.maximum(table[step, step], floor)
        rest = table - table[:, step, None] * pivot
        return jnp.where((rows == step)[:, None], pivot, rest)

    return lax.fori_loop(0, size, clear, jnp.concatenate([matrix, right], axis=1))[:, size:]


def invert_positive(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a small symmetric positive-definite matrix; singular directions get large finite values."""
    columns = _eliminate(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))
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
