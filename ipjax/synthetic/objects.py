"""Objects made in code: a kind and a seed decide their proportions and what is printed on them."""

import numpy as np

from ipjax.files.meshes.mesh import Mesh, make_mesh, normalise
from ipjax.synthetic.shapes import SHAPES
from ipjax.synthetic.textures import make_texture

EDGE = 0.06  # longest edge of a finished mesh, diameters: fine enough to be bent by `degrade`
KINDS = tuple(SHAPES)


def make_object(kind: str, seed: int = 0) -> Mesh:
    """A textured object of unit diameter, its box's centre at the origin; kind is one of `KINDS`.

    Proportions and texture follow from the seed. Raises ValueError for an unknown kind.
    """
    if kind not in SHAPES:
        raise ValueError(f"unknown kind of object {kind!r}: one of {', '.join(KINDS)}")
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    charts = SHAPES[kind](rng)
    starts = np.cumsum([0] + [len(chart[0]) for chart in charts])
    rows = np.concatenate([np.concatenate(chart[:3], axis=-1) for chart in charts])
    faces = np.concatenate([chart[3] + start for chart, start in zip(charts, starts[:-1], strict=True)])
    rows[:, :3] /= np.linalg.norm(np.ptp(rows[:, :3], axis=0))  # near enough to 1 for the length of edges
    rows, faces = _split_long_edges(rows, faces, EDGE)
    keep = face_areas(rows[:, :3], faces) > 1e-12
    texture = make_texture(int(rng.integers(2**31)))
    length = np.linalg.norm(rows[:, 5:8], axis=-1, keepdims=True)
    return normalise(
        make_mesh(rows[:, :3], faces[keep], uv=rows[:, 3:5], normals=rows[:, 5:8] / length, texture=texture)
    )


def face_areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The area of every face [m], of points [n 3] and triangles [m 3]."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def _split_long_edges(rows: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Split every edge longer than `longest` in half, until none is; rows are positions and whatever goes with them.

    Neighbours split a common edge at the same point, even when each has its own copies of the corners, so no gap opens.
    """
    while True:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
        unique, inverse = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        long = np.linalg.norm(rows[unique[:, 0], :3] - rows[unique[:, 1], :3], axis=-1) > longest
        if not long.any():
            return rows, faces
        middle = np.where(long, len(rows) + np.cumsum(long) - 1, -1)[inverse.reshape(-1, 3)]
        rows = np.concatenate([rows, rows[unique[long]].mean(1)])
        split = (middle >= 0).sum(1)
        parts = [faces[split == 0]]
        # Turn every face until its first edge is split (and, with two splits, its third is not).
        for count in (1, 2, 3):
            f, m = faces[split == count], middle[split == count]
            turn = {1: (m >= 0).argmax(1), 2: ((m < 0).argmax(1) + 1) % 3, 3: np.zeros(len(m), int)}[count]
            order = (np.arange(3) + turn[:, None]) % 3
            (a, b, c), (ab, bc, ca) = np.take_along_axis(f, order, 1).T, np.take_along_axis(m, order, 1).T
            pieces = {
                1: ((a, ab, c), (ab, b, c)),
                2: ((a, ab, c), (ab, b, bc), (ab, bc, c)),
                3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
            }[count]
            parts.extend(np.stack(piece, -1) for piece in pieces)
        faces = np.concatenate(parts)
