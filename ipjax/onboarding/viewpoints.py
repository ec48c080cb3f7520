"""The viewpoints of templates: evenly spread directions, each with a full turn of in-plane rolls."""

import jax.numpy as jnp
import numpy as np

from ipjax.config import OnboardConfig
from ipjax.records import Similarity

DISTANCE = OnboardConfig().distance  # model units (diameters) from the camera to the object's centre


def directions_on_sphere(count: int) -> np.ndarray:
    """Unit vectors spread evenly over the sphere, [count 3]: the Fibonacci lattice.

    Source: A. Gonzalez, "Measurement of areas on a sphere using Fibonacci and latitude-longitude lattices", 2010.
    """
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    around = np.sqrt(1 - height**2)
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)


def viewpoints(directions: int = 40, rolls: int = 10, *, distance: float = DISTANCE) -> Similarity:
    """Poses ``camera_from_object`` [v = directions × rolls] of a normalised object, direction-major, roll-minor.

    The camera looks at the origin from `distance` model units, with OpenCV axes; the rolls turn it evenly about its
    optical axis. The scale is 1: translations are in model units. Raises ValueError unless both counts are positive
    and the camera is outside the unit-diameter sphere.
    """
    if directions < 1 or rolls < 1:
        raise ValueError(f"viewpoints needs at least one direction and one roll, got {directions} and {rolls}")
    if not distance > 0.5:
        raise ValueError(f"the camera must be outside the object: distance {distance} is not above 0.5 model units")
    ahead = -directions_on_sphere(directions)
    # The image's up is the object's z, except at the poles of the lattice, where z and the optical axis meet.
    up = np.where(np.abs(ahead[:, 2:]) < 0.999, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    upright = np.stack([right, np.cross(ahead, right), ahead], axis=-2)
    angle = 2 * np.pi * np.arange(rolls) / rolls
    zero, one = np.zeros(rolls), np.ones(rolls)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), zero], [np.sin(angle), np.cos(angle), zero], [zero, zero, one]]
    ).transpose(2, 0, 1)
    rotation = (turn[None] @ upright[:, None]).reshape(-1, 3, 3)
    translation = np.broadcast_to([0.0, 0.0, distance], (len(rotation), 3))
    return Similarity(
        rotation=jnp.asarray(rotation, jnp.float32),
        translation=jnp.asarray(translation, jnp.float32),
        scale=jnp.ones(len(rotation), jnp.float32),
    )
