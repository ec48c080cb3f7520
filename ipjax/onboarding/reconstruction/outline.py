"""The photo's mask as a grid of nodes with a smooth edge, and what is solved and looked up on it."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

GRID = 96  # cells on the outline's longer side


@dataclasses.dataclass(frozen=True)
class Outline:
    """The photo's mask on a coarser grid of nodes."""

    pixels: Float[np.ndarray, "r c 2"]  # (x, y) of the nodes, in the photo; outer ones moved onto the outline
    inside: Bool[np.ndarray, "r c"]
    cells: Bool[np.ndarray, "rr cc"]  # squares between four nodes that belong to the object
    step: float  # pixels between nodes


def trace_outline(mask: Bool[np.ndarray, "h w"], grid: int = GRID) -> Outline:
    """Nodes over the mask; those just outside move onto its edge, so that the edge is smooth and not a staircase."""
    import cv2

    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        raise ValueError("the mask is empty")
    top, left = rows.min(), columns.min()
    height, width = rows.max() - top + 1, columns.max() - left + 1
    step = max(max(height, width) / grid, 1.0)
    margin = 3 * step
    size = [int(np.ceil((length + 2 * margin) / step)) + 1 for length in (height, width)]
    y = top - margin + step * np.arange(size[0])
    x = left - margin + step * np.arange(size[1])
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    pad = int(np.ceil(margin)) + 2
    wide = np.pad(mask.astype(np.float32), pad)
    soft = cv2.GaussianBlur(wide, (0, 0), max(0.7 * step, 0.7))
    slope = np.stack(
        [cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=1 / 8)], -1
    )
    inside = look_up(soft, pixels + pad) > 0.5
    if not inside.any():
        raise ValueError("the mask is too thin to make a surface of")
    # A node takes part when a square it belongs to has two corners inside.
    corners = [inside[i : i + size[0] - 1, j : j + size[1] - 1] for i in (0, 1) for j in (0, 1)]
    cells = _join_corners(np.sum(corners, axis=0) >= 2)
    used = np.zeros_like(inside)
    for i in (0, 1):
        for j in (0, 1):
            used[i : i + size[0] - 1, j : j + size[1] - 1] |= cells
    moved = pixels.copy()
    for _ in range(3):  # Newton's steps to the level one half
        value = look_up(soft, moved + pad) - 0.5
        gradient = look_up(slope, moved + pad)
        shift = -value[..., None] * gradient / np.maximum((gradient**2).sum(-1, keepdims=True), 1e-6)
        length = np.linalg.norm(shift, axis=-1, keepdims=True)
        moved = moved + shift * np.minimum(1.0, 0.5 * step / np.maximum(length, 1e-9))
    away = np.linalg.norm(moved - pixels, axis=-1) < 0.95 * step
    pixels = np.where((used & ~inside & away)[..., None], moved, pixels)
    return Outline(pixels, inside, cells, float(step))


def _join_corners(cells: np.ndarray) -> np.ndarray:
    """Fill squares until no two touch at a corner only, where a surface would not be a manifold."""
    cells = cells.copy()
    while True:
        a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
        first, second = a & d & ~b & ~c, b & c & ~a & ~d
        if not (first.any() or second.any()):
            return cells
        cells[:-1, 1:] |= first
        cells[:-1, :-1] |= second


def look_up(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear values of an image at (x, y); beyond the border, the border's."""
    import cv2

    xy = pixels.astype(np.float32)
    return cv2.remap(image, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def solve_poisson(values: np.ndarray, known: np.ndarray, domain: np.ndarray, source: float = 0.0) -> np.ndarray:
    """Solve ∇²u = −source over ``domain`` with u given where ``known``; other edges of the domain are free."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    free = domain & ~known
    out = np.where(known, values, 0.0)
    if not free.any():
        return out
    number = np.full(domain.shape, -1)
    number[free] = np.arange(free.sum())
    padded = np.pad(number, 1, constant_values=-1)
    known_, domain_, values_ = np.pad(known & domain, 1), np.pad(domain, 1), np.pad(out, 1)
    rows, columns, entries = [], [], []
    own = number[free]
    diagonal, right = np.full(len(own), 1e-9), np.full(len(own), float(source))
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        shifted = np.roll(padded, (-dy, -dx), (0, 1))[1:-1, 1:-1][free]
        neighbours = np.roll(domain_, (-dy, -dx), (0, 1))[1:-1, 1:-1][free]
        given = np.roll(known_, (-dy, -dx), (0, 1))[1:-1, 1:-1][free]
        value = np.roll(values_, (-dy, -dx), (0, 1))[1:-1, 1:-1][free]
        diagonal += neighbours
        right += np.where(given, value, 0.0)
        linked = shifted >= 0
        rows.append(own[linked])
        columns.append(shifted[linked])
        entries.append(np.full(linked.sum(), -1.0))
    rows.append(own)
    columns.append(own)
    entries.append(diagonal)
    matrix = coo_matrix((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), (len(own),) * 2)
    out[free] = spsolve(matrix.tocsc(), right)
    return out


def find_nearest_inside(inside: Any) -> tuple[np.ndarray, np.ndarray]:
    """For every place, row and column of the nearest one that is inside."""
    from scipy.ndimage import distance_transform_edt

    row, column = np.asarray(distance_transform_edt(~inside, return_distances=False, return_indices=True))
    return row, column
