"""The symmetries of an object as BOP writes them, as a list of transforms."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Num

SYMMETRY_STEP = 0.01  # BOP's max_sym_disc_step: the farthest a point may move between steps, in diameters


def discretise_symmetries(
    discrete: Sequence[Num[np.ndarray, "..."]] = (),
    continuous: Sequence[tuple[Num[np.ndarray, "..."], Num[np.ndarray, "..."]]] = (),
    step: float = SYMMETRY_STEP,
) -> tuple[Float[np.ndarray, "s 3 3"], Float[np.ndarray, "s 3"]]:
    """All symmetry transforms of an object as rotations [s, 3, 3] and translations [s, 3], float64; the first is the
    identity.

    Args:
        discrete: 4 × 4 rigid matrices, the identity not among them.
        continuous: (axis, a point on the axis) of each rotational symmetry, in the unit of the object.
        step: the farthest a point of the surface may move between two steps, as a share of the diameter.

    Every rotation is followed by every discrete symmetry's place: continuous ∘ discrete (BOP, misc.py:42-89).
    Rotations about several axes are not composed with one another, as in BOP.
    Raises ValueError for a matrix that is not 4 × 4, an axis of length 0, or a step that is not positive.
    """
    if not step > 0:
        raise ValueError(f"the step between symmetries must be positive, got {step}")
    placed = [np.eye(4)]
    for matrix in discrete:
        matrix = np.asarray(matrix, np.float64)
        if matrix.size != 16:
            raise ValueError(f"a discrete symmetry is a 4 × 4 matrix (16 numbers), got {matrix.size} numbers")
        placed.append(matrix.reshape(4, 4))
    turned = []
    count = int(np.ceil(np.pi / step))
    for axis, offset in continuous:
        axis, offset = np.asarray(axis, np.float64).reshape(3), np.asarray(offset, np.float64).reshape(3)
        length = np.linalg.norm(axis)
        if not length > 0:
            raise ValueError("the axis of a continuous symmetry has length 0")
        x, y, z = axis / length
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angles = np.arange(count)[:, None, None] * (2 * np.pi / count)
        rotations = np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * (cross @ cross)
        matrices = np.tile(np.eye(4), (count, 1, 1))
        matrices[:, :3, :3] = rotations
        matrices[:, :3, 3] = offset - rotations @ offset
        turned.append(matrices)
    discrete_matrices = np.stack(placed)
    if turned:
        matrices = (np.concatenate(turned)[None] @ discrete_matrices[:, None]).reshape(-1, 4, 4)
    else:
        matrices = discrete_matrices
    return matrices[:, :3, :3], matrices[:, :3, 3]
