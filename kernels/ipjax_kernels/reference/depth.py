"""The obvious NumPy loops for the kernels of `depth`: the oracle of the tests."""

import numpy as np
from jaxtyping import Bool, Float, Int


def _bilinear(image, x, y):
    height, width = image.shape
    column, row = min(int(np.floor(x)), width - 1), min(int(np.floor(y)), height - 1)
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    a, b = x - column, y - row
    upper = (1 - a) * image[row, column] + a * image[row, right]
    return (1 - b) * upper + b * ((1 - a) * image[below, column] + a * image[below, right])


def correlate(
    reference: Float[np.ndarray, "h w"],
    neighbour: Float[np.ndarray, "h w"],
    turn: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"],
    inverse: Float[np.ndarray, "h w"],
    pixel: tuple[int, int],
    radius: int,
) -> float:
    """Zero-mean normalised cross-correlation of the window about pixel (x, y), each of its pixels moved by its own
    inverse depth; −1 where the window leaves an image, or has no texture.
    """
    height, width = reference.shape
    here, there = [], []
    for row in range(pixel[1] - radius, pixel[1] + radius + 1):
        for column in range(pixel[0] - radius, pixel[0] + radius + 1):
            if not (0 <= row < height and 0 <= column < width) or inverse[row, column] <= 0:
                return -1.0
            x, y, z = turn @ [column, row, 1] + inverse[row, column] * shift
            if z <= 1e-6 or not (0 <= x / z <= width - 1 and 0 <= y / z <= height - 1):
                return -1.0
            here.append(reference[row, column])
            there.append(_bilinear(neighbour, x / z, y / z))
    if np.var(here) <= 1e-5 or np.var(there) <= 1e-5:
        return -1.0
    return float(np.corrcoef(here, there)[0, 1])


def warp_depth(
    points: Float[np.ndarray, "r c 3"],
    valid: Bool[np.ndarray, "r c"],
    focal: Float[np.ndarray, "2"],
    centre: Float[np.ndarray, "2"],
    height: int,
    width: int,
    jump: float,
    size: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "h w"]:
    """Every triangle and every rectangle, over every pixel."""
    there = valid & (points[..., 2] > 1e-6)
    z = np.where(there, points[..., 2], 1)
    pixels = points[..., :2] / z[..., None] * focal + centre
    surface, covered = np.full((height, width), np.inf), np.full((height, width), np.inf)
    rows, columns = there.shape
    for r in range(rows - 1):
        for c in range(columns - 1):
            for corners in (((r, c), (r, c + 1), (r + 1, c)), ((r + 1, c + 1), (r + 1, c), (r, c + 1))):
                places = np.array([pixels[k] for k in corners])
                inverse = np.array([1 / z[k] for k in corners])
                matrix = np.concatenate([places.T, np.ones((1, 3))])
                if not all(there[k] for k in corners) or np.ptp(inverse) > jump * inverse.max():
                    continue
                if abs(np.linalg.det(matrix)) <= 1e-4:
                    continue
                for row in range(height):
                    for column in range(width):
                        weights = np.linalg.solve(matrix, [column, row, 1])
                        if (weights >= -1e-3).all():
                            surface[row, column] = min(surface[row, column], 1 / (weights @ inverse))
    for r, c in zip(*np.nonzero(there), strict=True):
        x, y = pixels[r, c]
        for row in range(height):
            for column in range(width):
                if abs(column - x) <= size[0] / 2 and abs(row - y) <= size[1] / 2:
                    covered[row, column] = min(covered[row, column], z[r, c])
    wins = ~np.isfinite(surface) | (covered < surface * (1 - jump))
    image = np.where(wins, covered, surface)
    return np.where(np.isfinite(image), image, 0)


def patch_cost(
    estimated: Float[np.ndarray, "h w"],
    estimated_normals: Float[np.ndarray, "h w 3"],
    captured: Float[np.ndarray, "h w"],
    captured_normals: Float[np.ndarray, "h w 3"],
    pixel: tuple[int, int],
    offset: Int[np.ndarray, "2"],
    unit: float,
    angle: float,
) -> float:
    """What `propagate_offsets` minimises, at one pixel (x, y) and offset (x, y)."""
    height, width = estimated.shape
    inside = lambda row, column: 0 <= row < height and 0 <= column < width
    costs = []
    for down in (-2, 0, 2):
        for right in (-2, 0, 2):
            row, column = pixel[1] + down, pixel[0] + right
            if not inside(row, column) or estimated[row, column] <= 0:
                continue
            there, beside = row + offset[1], column + offset[0]
            if not inside(there, beside) or captured[there, beside] <= 0:
                costs.append(1.0)
                continue
            apart = min(abs(captured[there, beside] - estimated[row, column]) / unit, 1)
            cosine = captured_normals[there, beside] @ estimated_normals[row, column]
            costs.append((apart + min((1 - cosine) / angle, 1)) / 2)
    return float(np.mean(costs)) if costs else 1.0


def fuse_depth(
    values: Float[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    gate: float,
    floor: float,
    fill: int,
    overrule: int,
) -> tuple[float, float]:
    """One pixel of `fuse_depth`: depth and confidence."""
    near = lambda centre: (values > 0) & (np.abs(values - centre) < max(gate * centre, floor))
    own, others = values[0], [(near(v)[1:].sum(), v) for v in values[1:] if v > 0]
    most, rival = max(others, key=lambda pair: (pair[0], -pair[1]), default=(0, 0.0))
    centre = own
    if (own <= 0 and most >= fill) or (own > 0 and not near(own)[1:].any() and most >= overrule):
        centre = rival
    if centre <= 0:
        return 0.0, 0.0
    agree = near(centre)
    return float(np.average(values[agree], weights=weight[agree])), float(
        weight[agree].sum() / (weight[values > 0].sum() + 1)
    )
