"""How far the points of an object's surface may be off that was made from a photo, by the method that made it."""

import dataclasses

import jax.numpy as jnp

from ipjax.records import Surface


@dataclasses.dataclass(frozen=True)
class Deviations:
    """Standard deviations in diameters: along the photo's ray of what it saw and of the rest, and across it."""

    front: float
    back: float
    across: float


# By the names that `Reference.method` has; measured by ``python -m benchmarks.photo_shapes`` (seed 1). Nothing about a
# guess, neither how thick nor how flat it is, told how far it was off, so all points on one side have one value. Of
# "elsewhere" the worse of two meshes; of "triposr" none with a truth was at hand, and the same is assumed.
METHODS = {
    "depth": Deviations(0.04, 0.23, 0.01),
    "elsewhere": Deviations(0.05, 0.06, 0.03),
    "inflate": Deviations(0.135, 0.24, 0.01),
    "triposr": Deviations(0.05, 0.06, 0.03),
}


def deviations_of(method: str) -> Deviations:
    """Of objects that were made by a method of this name; one that is not known counts as "elsewhere"."""
    return METHODS.get(method, METHODS["elsewhere"])


def with_deviations(surface: Surface, method: str) -> Surface:
    """The surface of an object from a photo, each point with how far it may be off.

    Args:
        surface: ``seen`` tells what the photo showed; between the two, variances are mixed.
        method: how the object was made, as `Reference.method` has it.
    """
    off = deviations_of(method)
    seen = jnp.clip(surface.seen, 0, 1)
    along = jnp.sqrt(seen * off.front**2 + (1 - seen) * off.back**2)
    return dataclasses.replace(surface, along_std=along, across_std=jnp.full_like(along, off.across))
