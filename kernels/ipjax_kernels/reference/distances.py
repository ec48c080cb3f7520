"""The obvious NumPy loop for `ipjax_kernels.distances`: the oracle of the tests."""

import numpy as np
from jaxtyping import Float


def add_frame(
    sums: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    points: Float[np.ndarray, "n 3"],
    depth: Float[np.ndarray, "h w"],
    weight: Float[np.ndarray, "h w"],
    lean: Float[np.ndarray, "h w"],
    rgb: Float[np.ndarray, "h w 3"],
    focal: Float[np.ndarray, "2"],
    centre: Float[np.ndarray, "2"],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
    reach: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Look up every point's pixel, and add what it says."""
    distance, total, colour, colour_weight = (np.array(x, float) for x in sums)
    height, width = depth.shape
    for k, point in enumerate(points):
        x, y, z = rotation @ point + translation
        if z <= 1e-3:
            continue
        x, y = focal[0] * x / z + centre[0], focal[1] * y / z + centre[1]
        if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
            continue
        column, row = min(max(int(np.round(x)), 0), width - 1), min(max(int(np.round(y)), 0), height - 1)
        left, top = min(max(int(np.floor(x)), 0), width - 2), min(max(int(np.floor(y)), 0), height - 2)
        a, b = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
        four = depth[top : top + 2, left : left + 2]
        surface = depth[row, column]
        if (weight[top : top + 2, left : left + 2] > 0).all():
            surface = np.array([1 - b, b]) @ four @ np.array([1 - a, a])
        signed = lean[row, column] * (surface - z)
        if signed <= -reach:
            continue
        used = weight[row, column]
        distance[k] += used * min(signed, reach)
        total[k] += used
        if abs(signed) < reach:
            colour[k] += used * rgb[row, column]
            colour_weight[k] += used
    return distance, total, colour, colour_weight
