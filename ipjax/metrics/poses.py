"""The parts of a pose's error: rotation, translation, size.

Arrays are JAX's or NumPy's; the result is of the same kind and precision.
"""

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from jaxtyping import Array, Float

from ipjax.metrics.displacements import lengths, namespace
from ipjax.transforms import A


def rotation_error(truth: Float[A, "3 3"], estimate: Float[A, "3 3"]) -> Float[A, ""]:
    """Angle between two rotations, radians in [0, π]; accurate at both ends, also in float32."""
    xp = namespace(truth, estimate)
    turn = estimate @ truth.T if xp is np else jnp.matmul(estimate, truth.T, precision="highest")
    axis = xp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return xp.asarray(xp.arctan2(lengths(axis), xp.trace(turn) - 1))


def turn_angle(trace: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The angle of rotations with these traces, radians in [0, π]; its derivative is finite at both ends, too."""
    return 2 * jnp.arctan2(root((3 - trace) / 4), root((1 + trace) / 4))


def translation_error(truth: Float[A, "3"], estimate: Float[A, "3"]) -> Float[A, ""]:
    """Distance between two translations, in their unit."""
    return lengths(truth - estimate)


def scale_error(truth: Float[A, ""], estimate: Float[A, ""]) -> Float[A, ""]:
    """How far the estimated scale is off, as a share of the true one: |s_e / s_g − 1|."""
    xp = namespace(truth, estimate)
    return xp.asarray(xp.abs(estimate / truth - 1))
