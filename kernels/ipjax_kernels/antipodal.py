"""Surface on the other side: what lies along an inward ray and faces away from it."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def find_opposite(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    start: Float[Array, "a 3"],
    axis: Float[Array, "a 3"],
    reach: tuple[Float[Array, ""], Float[Array, ""]],
    aside: Float[Array, ""],
    facing: Float[Array, ""],
) -> tuple[Float[Array, " a"], Float[Array, " a"]]:
    """How far along each ray the nearest and the farthest surface is that faces along it.

    A point counts where it is within ``aside`` of the ray, its distance along it is within ``reach``, and the cosine
    between its normal and the ray is above ``facing``.

    Args:
      start, axis: of the rays; the axes are unit vectors.

    Returns:
      The nearest, inf where there is none, and the farthest, −inf where there is none.
    """
    columns, turned = points.T, normals.T
    from_start = [columns[i] - start[:, i, None] for i in range(3)]
    along = sum(axis[:, i, None] * from_start[i] for i in range(3))
    squared = sum(x * x for x in from_start) - along * along
    cosine = sum(axis[:, i, None] * turned[i] for i in range(3))
    found = (along > reach[0]) & (along < reach[1]) & (squared < aside * aside) & (cosine > facing)
    nearest = jnp.min(jnp.where(found, along, jnp.inf), axis=-1)
    return nearest, jnp.max(jnp.where(found, along, -jnp.inf), axis=-1)


def smooth_normals(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    chosen: Float[Array, "a 3"],
    own: Float[Array, "a 3"],
    radius: Float[Array, ""],
    alike: Float[Array, ""],
) -> Float[Array, "a 3"]:
    """The mean normal about each chosen point, of points within a radius whose normal is like its own; unit.

    Args:
      chosen, own: points and their normals.
      alike: least cosine between two normals of one side.
    """
    columns, turned = points.T, normals.T
    squared = sum((columns[i] - chosen[:, i, None]) ** 2 for i in range(3))
    cosine = sum(own[:, i, None] * turned[i] for i in range(3))
    near = (squared < radius * radius) & (cosine > alike)
    total = jnp.stack([jnp.sum(jnp.where(near, turned[i], 0), axis=-1) for i in range(3)], axis=-1) + 1e-6 * own
    return total / jnp.maximum(jnp.sqrt(jnp.sum(total * total, axis=-1, keepdims=True)), 1e-12)
