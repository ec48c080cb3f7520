"""The obvious NumPy loops for `rasterize`: the oracle of the tests."""

import numpy as np
from jaxtyping import Bool, Float, Int


def splat_depth(
    points: Float[np.ndarray, "n 3"],
    valid: Bool[np.ndarray, " n"],
    focal: Float[np.ndarray, "2"],
    centre: Float[np.ndarray, "2"],
    height: int,
    width: int,
    radius: int = 1,
) -> Float[np.ndarray, "h w"]:
    """Paint one square per point, nearest on top."""
    image = np.full((height, width), np.inf)
    for (x, y, z), use in zip(points, valid, strict=True):
        if not use or z <= 0 or not np.isfinite([x, y, z]).all():
            continue
        column = int(np.round(focal[0] * x / z + centre[0]))
        row = int(np.round(focal[1] * y / z + centre[1]))
        for r in range(max(row - radius, 0), min(row + radius + 1, height)):
            for c in range(max(column - radius, 0), min(column + radius + 1, width)):
                image[r, c] = min(image[r, c], z)
    return np.where(np.isfinite(image), image, 0.0)


def rasterize(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    focal: Float[np.ndarray, "2"],
    centre: Float[np.ndarray, "2"],
    height: int,
    width: int,
    near: float = 1e-6,
) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Intersect the ray of every pixel with every face: solve a·w0 + b·w1 + c·w2 = depth · ray, weights of sum one."""
    depth, index, weights = np.zeros((height, width)), np.full((height, width), -1), np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            ray = np.array([(column - centre[0]) / focal[0], (row - centre[1]) / focal[1], 1.0])
            for f, face in enumerate(faces):
                corners = vertices[face].astype(np.float64)
                if (corners[:, 2] <= near).any() or abs(np.linalg.det(corners)) < 1e-15:
                    continue
                part = np.linalg.solve(corners.T, ray)  # weights over depth
                if (part < 0).any():
                    continue
                distance = 1 / part.sum()
                if index[row, column] < 0 or distance < depth[row, column]:
                    depth[row, column], index[row, column], weights[row, column] = distance, f, part * distance
    return depth, index, weights
