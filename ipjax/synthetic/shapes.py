"""The shapes of synthetic objects, as charts: pieces of surface, each with its own rectangle of the texture.

Every maker draws its proportions from a generator. Units are free: what is made of a shape is normalised.
"""

import math
from collections.abc import Callable

import numpy as np

Chart = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # vertices [n 3], uv [n 2], normals [n 3], faces [m 3]
_Number = float | int
_Box = tuple[_Number, _Number, _Number, _Number]  # left, bottom, right, top in uv


def _into_box(box: _Box, uv: np.ndarray) -> np.ndarray:
    """Coordinates in the unit square, moved into a box of the texture with a narrow margin."""
    low, high = np.array(box[:2]), np.array(box[2:])
    return low + (0.01 + 0.98 * uv) * (high - low)


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles per cell of a grid of vertices, row by row."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def _extrude(outline: np.ndarray, height: float, taper: float = 1.0) -> list[Chart]:
    """A prism over a counter-clockwise outline [n 2]; the top is the outline times `taper`."""
    charts = []
    n = len(outline)
    edges = np.roll(outline, -1, 0) - outline
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(edges, axis=-1))])
    along = along / along[-1]
    for i in range(n):
        a, b = outline[i], outline[(i + 1) % n]
        corners = np.array([[*a, 0], [*b, 0], [*(b * taper), height], [*(a * taper), height]])
        uv = np.array([[along[i], 0], [along[i + 1], 0], [along[i + 1], 1], [along[i], 1]])
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        normal = np.broadcast_to(normal / np.linalg.norm(normal), (4, 3))
        charts.append((corners, _into_box((0, 0.5, 1, 1), uv), normal, np.array([[0, 1, 2], [0, 2, 3]])))
    low, high = outline.min(0), outline.max(0)
    flat = (outline - low) / (high - low).max()
    triangles = _cut_ears(outline)
    for z, sign, size, box in ((0.0, -1.0, 1.0, (0, 0, 0.5, 0.5)), (height, 1.0, taper, (0.5, 0, 1, 0.5))):
        corners = np.concatenate([outline * size, np.full((n, 1), z)], -1)
        normal = np.broadcast_to([0.0, 0, sign], (n, 3))
        charts.append((corners, _into_box(box, flat), normal, triangles if sign > 0 else triangles[:, ::-1]))
    return charts


def _cut_ears(outline: np.ndarray) -> np.ndarray:
    """Triangles of a simple counter-clockwise polygon."""

    def turn(a, b, c):
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    left, triangles = list(range(len(outline))), []
    while len(left) > 3:
        for i in range(len(left)):
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            p, q, r = outline[a], outline[b], outline[c]
            others = (outline[k] for k in left if k not in (a, b, c))
            if turn(p, q, r) > 1e-12 and not any(
                turn(p, q, o) >= 0 and turn(q, r, o) >= 0 and turn(r, p, o) >= 0 for o in others
            ):
                triangles.append((a, b, c))
                del left[i]
                break
        else:
            raise ValueError("the outline is not a simple counter-clockwise polygon")
    triangles.append(tuple(left))
    return np.array(triangles)


def _revolve(profile: np.ndarray, box: _Box = (0, 0, 1, 1), around: int = 40) -> list[Chart]:
    """A profile [n 2] of (radius, height), from the bottom to the top, turned about z."""
    steps = np.diff(profile, axis=0)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(steps, axis=-1))])
    length = length / length[-1]
    slopes = np.stack([steps[:, 1], -steps[:, 0]], -1)
    slopes = slopes / np.linalg.norm(slopes, axis=-1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    charts = []
    for i in range(len(steps)):
        ends, tilts = profile[i : i + 2], []
        for k in (i - 1, i + 1):  # soft edges share their neighbour's slope, sharp ones do not
            soft = 0 <= k < len(slopes) and slopes[i] @ slopes[k] > math.cos(math.radians(40))
            tilt = slopes[i] + slopes[k] if soft else slopes[i]
            tilts.append(tilt / np.linalg.norm(tilt))
        tilts = np.array(tilts)
        points = np.concatenate(
            [ends[:, None, :1] * circle, np.broadcast_to(ends[:, None, 1:], (2, around + 1, 1))], -1
        )
        normals = np.concatenate(
            [tilts[:, None, :1] * circle, np.broadcast_to(tilts[:, None, 1:], (2, around + 1, 1))], -1
        )
        uv = np.stack(np.meshgrid(angle / (2 * np.pi), length[i : i + 2]), -1)
        faces = _grid_faces(2, around + 1)
        charts.append((points.reshape(-1, 3), _into_box(box, uv.reshape(-1, 2)), normals.reshape(-1, 3), faces))
    return charts


def _sweep(path: np.ndarray, radius: float, box: _Box, around: int = 12) -> list[Chart]:
    """A tube about a path [n 3] in the plane y = 0."""
    ahead = np.gradient(path, axis=0)
    ahead = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    side = np.array([0.0, 1, 0])
    up = np.cross(ahead, side)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    normals = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up[:, None]
    uv = np.stack(np.meshgrid(angle / (2 * np.pi), np.linspace(0, 1, len(path))), -1)
    points = path[:, None] + radius * normals
    faces = _grid_faces(len(path), around + 1)
    return [(points.reshape(-1, 3), _into_box(box, uv.reshape(-1, 2)), normals.reshape(-1, 3), faces[:, ::-1])]


def _make_corner(rng: np.random.Generator) -> list[Chart]:
    long, short, thick = 1.0, rng.uniform(0.55, 0.85), rng.uniform(0.28, 0.4)
    outline = np.array([[0, 0], [long, 0], [long, thick], [thick, thick], [thick, short], [0, short]])
    return _extrude(outline, rng.uniform(0.35, 0.6))


def _make_tee(rng: np.random.Generator) -> list[Chart]:
    w, h, s, t = 1.0, rng.uniform(0.7, 1.1), rng.uniform(0.28, 0.4), rng.uniform(0.25, 0.35)
    off = rng.uniform(0.15, 0.45)  # the stem is off the middle, so that there is one pose only
    outline = [[off, 0], [off + s, 0], [off + s, h - t], [w, h - t], [w, h], [0, h], [0, h - t], [off, h - t]]
    return _extrude(np.array(outline), rng.uniform(0.25, 0.45))


def _make_wedge(rng: np.random.Generator) -> list[Chart]:
    outline = np.array([[0, 0], [1, 0], [1, rng.uniform(0.15, 0.3)], [rng.uniform(0.1, 0.35), rng.uniform(0.55, 0.8)]])
    return _extrude(outline, rng.uniform(0.4, 0.7))


def _make_prism(rng: np.random.Generator) -> list[Chart]:
    angle = np.arange(6) * np.pi / 3
    outline = 0.5 * np.stack([np.cos(angle), np.sin(angle) * rng.uniform(0.7, 1)], -1)
    return _extrude(outline, rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.0))


def _make_carton(rng: np.random.Generator) -> list[Chart]:
    w, d = rng.uniform(0.5, 0.9), rng.uniform(0.2, 0.6)
    return _extrude(np.array([[0, 0], [w, 0], [w, d], [0, d]]), 1.0)


def _make_star(rng: np.random.Generator) -> list[Chart]:
    points = int(rng.integers(4, 7))
    angle = np.arange(2 * points) * np.pi / points
    radius = np.where(np.arange(2 * points) % 2 == 0, 0.5, rng.uniform(0.28, 0.38))
    return _extrude(radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1), rng.uniform(0.2, 0.4))


def _make_bottle(rng: np.random.Generator) -> list[Chart]:
    r, neck, shoulder, cap = (
        rng.uniform(0.17, 0.26),
        rng.uniform(0.06, 0.1),
        rng.uniform(0.55, 0.7),
        rng.uniform(0.08, 0.13),
    )
    curve = np.linspace(0, np.pi / 2, 6)
    dome = np.stack([neck + (r - neck) * np.cos(curve), shoulder + (0.88 - shoulder) * np.sin(curve)], -1)
    profile = [[0, 0], [r * 0.92, 0], [r, 0.04], *dome, [cap, 0.88], [cap, 1.0], [0, 1.0]]
    return _revolve(np.array(profile))


def _make_drum(rng: np.random.Generator) -> list[Chart]:
    low, high, waist = rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.5), rng.uniform(0.85, 1.1)
    return _revolve(np.array([[0, 0], [low, 0], [(low + high) / 2 * waist, 0.4], [high, 0.8], [0, 0.8]]))


def _make_mug(rng: np.random.Generator) -> list[Chart]:
    r, wall, flare = rng.uniform(0.34, 0.42), 0.04, rng.uniform(0.9, 1.1)
    profile = [[0, 0], [r * flare, 0], [r, 0.95], [r - wall, 0.95], [r * flare - wall, 0.06], [0, 0.06]]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 14)
    path = np.stack([r * 0.95 + rng.uniform(0.2, 0.28) * np.cos(angle), 0 * angle, 0.48 + 0.28 * np.sin(angle)], -1)
    return [*_revolve(np.array(profile), (0, 0.2, 1, 1)), *_sweep(path, rng.uniform(0.045, 0.065), (0, 0, 1, 0.2))]


def _make_pot(rng: np.random.Generator) -> list[Chart]:
    """A bowl with a spout-like rod at one side."""
    r = rng.uniform(0.38, 0.5)
    curve = np.linspace(0.3, np.pi / 2, 7)
    outside = np.stack([r * np.sin(curve), 0.5 - 0.5 * np.cos(curve)], -1)
    inside = outside[::-1] * [0.9, 1] + [0, 0.03]
    t = np.linspace(0, 1, 10)
    path = np.stack([r * 0.85 + 0.5 * t, 0 * t, 0.38 + rng.uniform(0, 0.25) * t**2], -1)
    profile = np.concatenate([[[0, outside[0, 1]]], outside, inside, [[0, inside[-1, 1]]]])
    return [*_revolve(profile, (0, 0.2, 1, 1)), *_sweep(path, rng.uniform(0.05, 0.08), (0, 0, 1, 0.2))]


SHAPES: dict[str, Callable[[np.random.Generator], list[Chart]]] = {
    "corner": _make_corner,
    "bottle": _make_bottle,
    "mug": _make_mug,
    "wedge": _make_wedge,
    "prism": _make_prism,
    "tee": _make_tee,
    "carton": _make_carton,
    "pot": _make_pot,
    "drum": _make_drum,
    "star": _make_star,
}
