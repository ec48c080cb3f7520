"""How far a trajectory is from the true one, where the world, and maybe a constant offset of the camera, are free."""

import numpy as np
from jaxtyping import Bool, Float

from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation


def compare(
    found: Similarity[np.ndarray], truth: Similarity[np.ndarray], known: Bool[np.ndarray, " n"], *, offset: bool = False
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Of each known frame, how far its place (metres) and its rotation (degrees) are off.

    Args:
      known: the frames that are compared.
      offset: solve one rigid motion between the camera that was found and the one that the truth is of, for all frames
        alike: what a robot's hand-eye calibration, or a marker on the camera, leaves.
    """
    from scipy.optimize import least_squares

    mine, true = (poses.take(known) for poses in (found, truth))
    turn = np.linalg.svd(np.einsum("nij,nkj->ik", true.rotation, mine.rotation))
    turn = turn[0] @ turn[2]
    start = np.concatenate([vector_from_rotation(turn), true.translation.mean(0) - turn @ mine.translation.mean(0)])

    def apart(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        world, camera = (Similarity(rotation_from_vector(x[i : i + 3]), x[i + 3 : i + 6], np.ones(())) for i in (0, 6))
        moved = world @ mine @ camera
        turned = vector_from_rotation(np.swapaxes(true.rotation, -1, -2) @ moved.rotation)
        return moved.translation - true.translation, turned

    def residuals(x: np.ndarray) -> np.ndarray:
        x = np.concatenate([x, np.zeros(12 - len(x))])
        places, turned = apart(x)
        # A millimetre counts as much as a tenth of a degree; the offset is small unless the poses say so.
        return np.concatenate([places.ravel() / 1e-3, turned.ravel() / 1.7e-3, x[6:9] / 0.02, x[9:] / 0.02])

    begin = np.concatenate([start, np.zeros(6)]) if offset else start
    solved = least_squares(residuals, begin, loss="soft_l1", f_scale=5.0).x
    places, turned = apart(np.concatenate([solved, np.zeros(12 - len(solved))]))
    return np.linalg.norm(places, axis=1), np.degrees(np.linalg.norm(turned, axis=1))


def compare_scale(found: Similarity[np.ndarray], truth: Similarity[np.ndarray], known: Bool[np.ndarray, " n"]) -> float:
    """How much too large the trajectory is, as a share (the scale that fits its places to the true ones best)."""
    mine, true = (poses.take(known).translation for poses in (found, truth))
    mine, true = mine - mine.mean(0), true - true.mean(0)
    left, values, right = np.linalg.svd(true.T @ mine)
    values[-1] *= np.sign(np.linalg.det(left @ right))
    return float((mine**2).sum() / values.sum() - 1)
