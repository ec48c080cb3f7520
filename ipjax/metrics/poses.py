"""The parts of a pose's error: rotation, translation, size.

Arrays are JAX's or NumPy's; the result is of the same kind and precision.
"""

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from jaxtyping import Array, Float

from ipjax.metrics.displacements import lengths, namespace
from ipjax.transforms import A, Similarity


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


def symmetric_errors(
    symmetries: Similarity[A], truth: Similarity[A], estimate: Similarity[A]
) -> tuple[Float[A, ""], Float[A, ""]]:
    """Rotation error (radians) and translation error of one pose, to that of the object's symmetric poses
    ``truth @ symmetry`` whose rotation is nearest.

    ``symmetries`` has one leading axis (see ``discretise_symmetries``); ValueError where it has none or is empty. Of a
    continuous symmetry the rotation error is what half a step of it leaves, at most.
    """
    if symmetries.translation.ndim != 2 or not len(symmetries.translation):
        raise ValueError("symmetries must have one leading axis, and the identity at least")
    xp = namespace(symmetries.rotation, truth.rotation, estimate.rotation)
    alike = truth @ symmetries  # [s]
    # Differences, not traces: near 0 a trace hardly changes with the angle.
    nearest = xp.argmin(xp.sum((alike.rotation - estimate.rotation) ** 2, axis=(-2, -1)))
    turn = rotation_error(xp.asarray(alike.rotation[nearest]), estimate.rotation)
    return turn, translation_error(xp.asarray(alike.translation[nearest]), estimate.translation)


def scale_error(truth: Float[A, ""], estimate: Float[A, ""]) -> Float[A, ""]:
    """How far the estimated scale is off, as a share of the true one: |s_e / s_g − 1|."""
    xp = namespace(truth, estimate)
    return xp.asarray(xp.abs(estimate / truth - 1))
