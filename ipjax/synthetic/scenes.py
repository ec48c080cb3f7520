"""Objects and scenes made in code, with their true poses: what the demo shows and what confidence is fitted on.

Everything follows from a kind and a seed, so two people with the same version see the same scene. Objects have unit
diameter, like every normalised mesh; a scene gives each a size in metres.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import ConvexHull

from ipjax.cameras import middle, project, resize_pixels, unproject
from ipjax.files.meshes.mesh import Mesh, make_mesh, normalise
from ipjax.records import Camera, Similarity
from ipjax.rendering.render import render_scene
from ipjax.transforms import rotation_from_vector

WIDTH, HEIGHT = 640, 480
TEXTURE = 512  # texels on a side
EDGE = 0.06  # longest edge of a finished mesh, diameters: fine enough to be bent by `degrade`


@dataclasses.dataclass(frozen=True)
class Sensor:
    """How a depth camera of the structured-light kind departs from the truth; all zero = a perfect one.

    The axial noise is Nguyen et al. 2012's for the Kinect: ``sigma = axial + quadratic (z - 0.4)²``, metres.
    """

    axial: float = 0.0012
    quadratic: float = 0.0019
    step: float = 0.0008  # quantisation at 1 m, metres; grows with z², as disparities do
    jitter: float = 0.5  # pixels by which edges fray
    holes: float = 0.03  # share of the image lost in blots
    edge: float = 0.5  # chance of losing a pixel beside a jump in depth
    grazing: float = 0.15  # cosine between ray and surface below which nothing comes back
    colour: float = 0.012  # noise of the photo, of the full range
    blur: float = 0.6  # of the photo, pixels


PERFECT = Sensor(*[0.0] * 9)


@dataclasses.dataclass(frozen=True)
class Scene:
    """One RGB-D frame of a table, and the truth about it."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # along z, metres; 0 = unknown
    masks: Bool[np.ndarray, "n h w"]  # where each object is seen
    visible: Float[np.ndarray, " n"]  # share of each object's outline that is seen
    camera: Camera
    camera_from_object: tuple[Similarity, ...]  # of each mesh as it was given; metres
    backend: str  # who drew

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K, pixels."""
        return self.camera.to_matrix()


# --- textures ---------------------------------------------------------------------------------------------------------


def make_texture(seed: int, size: int = TEXTURE) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """A printed surface: a few colours, bands, panels, dots, rows of invented letters, and grain."""
    rng = np.random.default_rng([seed, 7])
    palette = _palette(rng, 6)
    image = _marble(rng, size, palette[0], palette[1])
    for _ in range(rng.integers(3, 6)):
        _paint_band(rng, image, palette)
    for _ in range(rng.integers(10, 16)):
        _paint_panel(rng, image, palette)
    for _ in range(rng.integers(14, 22)):
        _paint_letters(rng, image, palette)
    grain = rng.normal(0, 5, (size, size, 1)) + 18 * (_noise(rng, size, 24) - 0.5)[..., None]
    return np.clip(image + grain, 0, 255).astype(np.uint8)


def _palette(rng: np.random.Generator, count: int) -> np.ndarray:
    """Colours that differ in hue and in brightness, [count 3] in 0 … 255."""
    hue = (rng.uniform() + np.arange(count) * 0.381966 + rng.normal(0, 0.03, count)) % 1
    value = rng.permutation(np.linspace(0.25, 1.0, count))
    saturation = rng.uniform(0.25, 0.95, count)
    wheel = np.clip(np.abs((hue[:, None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    return 255 * value[:, None] * (1 - saturation[:, None] * (1 - wheel))


def _noise(rng: np.random.Generator, size: int, cells: int) -> np.ndarray:
    """Smooth noise in [0, 1], `cells` bumps across."""
    coarse = rng.uniform(size=(cells + 3, cells + 3)).astype(np.float32)
    at = np.arange(size) / size * cells + 1
    low = np.floor(at).astype(int)
    part = (at - low).astype(np.float32)
    part = part * part * (3 - 2 * part)
    rows = coarse[low] * (1 - part[:, None]) + coarse[low + 1] * part[:, None]
    return rows[:, low] * (1 - part) + rows[:, low + 1] * part


def _marble(rng: np.random.Generator, size: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    field = _noise(rng, size, 3) / 1.5 + _noise(rng, size, 8) / 3 + _noise(rng, size, 25) / 8
    blend = np.clip((field - field.mean()) * 2.5 + 0.5, 0, 1)[..., None]
    return first * (1 - blend) + second * blend


def _paint_band(rng: np.random.Generator, image: np.ndarray, palette: np.ndarray) -> None:
    size = len(image)
    start, width = rng.integers(0, size), int(rng.integers(size // 40, size // 10))
    where = (
        (slice(start, start + width), slice(None))
        if rng.uniform() < 0.5
        else (slice(None), slice(start, start + width))
    )
    image[where] = palette[rng.integers(len(palette))]


def _paint_panel(rng: np.random.Generator, image: np.ndarray, palette: np.ndarray) -> None:
    size = len(image)
    half = rng.uniform(0.03, 0.13, 2) * size
    x, y = rng.uniform(0, size, 2)
    left, right = max(int(x - half[0]), 0), min(int(x + half[0]) + 1, size)
    top, bottom = max(int(y - half[1]), 0), min(int(y + half[1]) + 1, size)
    rows, columns = np.mgrid[top:bottom, left:right]
    u, v = (columns - x) / half[0], (rows - y) / half[1]
    shape = rng.integers(4)
    if shape == 0:
        inside = np.ones_like(u, bool)
    elif shape == 1:
        inside = u**2 + v**2 < 1
    elif shape == 2:
        inside = np.abs(u) + np.abs(v) < 1
    else:
        inside = (v < 1 - 2 * np.abs(u)) & (v > -0.9)
    colour, rim = palette[rng.choice(len(palette), 2, replace=False)]
    part = image[top:bottom, left:right]
    part[inside] = colour
    part[inside & (np.maximum(np.abs(u), np.abs(v)) > 0.82)] = rim


def _paint_letters(rng: np.random.Generator, image: np.ndarray, palette: np.ndarray) -> None:
    """A line of an invented script: 5 × 4 bitmaps, half of them mirror-symmetric, as letters are."""
    size = len(image)
    zoom, count = int(rng.integers(2, 9)), int(rng.integers(3, 9))
    line = np.zeros((5, 5 * count), bool)
    for letter in range(count):
        bitmap = rng.uniform(size=(5, 4)) < 0.55
        if rng.uniform() < 0.5:
            bitmap[:, 2:] = bitmap[:, 1::-1]
        line[:, 5 * letter : 5 * letter + 4] = bitmap
    ink = line.repeat(zoom, 0).repeat(zoom, 1)
    if rng.uniform() < 0.35:
        ink = ink.T
    y, x = rng.integers(0, size, 2)
    part = image[y : y + ink.shape[0], x : x + ink.shape[1]]
    part[ink[: part.shape[0], : part.shape[1]]] = palette[rng.integers(len(palette))]


# --- shapes -----------------------------------------------------------------------------------------------------------
# A chart is a rectangle of surface laid flat: vertices, uv in its part of the texture, normals, faces.

_Chart = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
_Number = float | int
_Box = tuple[_Number, _Number, _Number, _Number]  # left, bottom, right, top in uv


def _into(box: _Box, uv: np.ndarray) -> np.ndarray:
    low, high = np.array(box[:2]), np.array(box[2:])
    return low + (0.01 + 0.98 * uv) * (high - low)


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def _extrude(outline: np.ndarray, height: float, taper: float = 1.0) -> list[_Chart]:
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
        charts.append((corners, _into((0, 0.5, 1, 1), uv), normal, np.array([[0, 1, 2], [0, 2, 3]])))
    low, high = outline.min(0), outline.max(0)
    flat = (outline - low) / (high - low).max()
    triangles = _cut_ears(outline)
    for z, sign, size, box in ((0.0, -1.0, 1.0, (0, 0, 0.5, 0.5)), (height, 1.0, taper, (0.5, 0, 1, 0.5))):
        corners = np.concatenate([outline * size, np.full((n, 1), z)], -1)
        normal = np.broadcast_to([0.0, 0, sign], (n, 3))
        charts.append((corners, _into(box, flat), normal, triangles if sign > 0 else triangles[:, ::-1]))
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


def _revolve(profile: np.ndarray, box: _Box = (0, 0, 1, 1), around: int = 40) -> list[_Chart]:
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
        charts.append((points.reshape(-1, 3), _into(box, uv.reshape(-1, 2)), normals.reshape(-1, 3), faces))
    return charts


def _sweep(path: np.ndarray, radius: float, box: _Box, around: int = 12) -> list[_Chart]:
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
    return [(points.reshape(-1, 3), _into(box, uv.reshape(-1, 2)), normals.reshape(-1, 3), faces[:, ::-1])]


def _make_corner(rng: np.random.Generator) -> list[_Chart]:
    long, short, thick = 1.0, rng.uniform(0.55, 0.85), rng.uniform(0.28, 0.4)
    outline = np.array([[0, 0], [long, 0], [long, thick], [thick, thick], [thick, short], [0, short]])
    return _extrude(outline, rng.uniform(0.35, 0.6))


def _make_tee(rng: np.random.Generator) -> list[_Chart]:
    w, h, s, t = 1.0, rng.uniform(0.7, 1.1), rng.uniform(0.28, 0.4), rng.uniform(0.25, 0.35)
    off = rng.uniform(0.15, 0.45)  # the stem is off the middle, so that there is one pose only
    outline = [[off, 0], [off + s, 0], [off + s, h - t], [w, h - t], [w, h], [0, h], [0, h - t], [off, h - t]]
    return _extrude(np.array(outline), rng.uniform(0.25, 0.45))


def _make_wedge(rng: np.random.Generator) -> list[_Chart]:
    outline = np.array([[0, 0], [1, 0], [1, rng.uniform(0.15, 0.3)], [rng.uniform(0.1, 0.35), rng.uniform(0.55, 0.8)]])
    return _extrude(outline, rng.uniform(0.4, 0.7))


def _make_prism(rng: np.random.Generator) -> list[_Chart]:
    angle = np.arange(6) * np.pi / 3
    outline = 0.5 * np.stack([np.cos(angle), np.sin(angle) * rng.uniform(0.7, 1)], -1)
    return _extrude(outline, rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.0))


def _make_carton(rng: np.random.Generator) -> list[_Chart]:
    w, d = rng.uniform(0.5, 0.9), rng.uniform(0.2, 0.6)
    return _extrude(np.array([[0, 0], [w, 0], [w, d], [0, d]]), 1.0)


def _make_star(rng: np.random.Generator) -> list[_Chart]:
    points = int(rng.integers(4, 7))
    angle = np.arange(2 * points) * np.pi / points
    radius = np.where(np.arange(2 * points) % 2 == 0, 0.5, rng.uniform(0.28, 0.38))
    return _extrude(radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1), rng.uniform(0.2, 0.4))


def _make_bottle(rng: np.random.Generator) -> list[_Chart]:
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


def _make_drum(rng: np.random.Generator) -> list[_Chart]:
    low, high, waist = rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.5), rng.uniform(0.85, 1.1)
    return _revolve(np.array([[0, 0], [low, 0], [(low + high) / 2 * waist, 0.4], [high, 0.8], [0, 0.8]]))


def _make_mug(rng: np.random.Generator) -> list[_Chart]:
    r, wall, flare = rng.uniform(0.34, 0.42), 0.04, rng.uniform(0.9, 1.1)
    profile = [[0, 0], [r * flare, 0], [r, 0.95], [r - wall, 0.95], [r * flare - wall, 0.06], [0, 0.06]]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 14)
    path = np.stack([r * 0.95 + rng.uniform(0.2, 0.28) * np.cos(angle), 0 * angle, 0.48 + 0.28 * np.sin(angle)], -1)
    return [*_revolve(np.array(profile), (0, 0.2, 1, 1)), *_sweep(path, rng.uniform(0.045, 0.065), (0, 0, 1, 0.2))]


def _make_pot(rng: np.random.Generator) -> list[_Chart]:
    """A bowl with a spout-like rod at one side."""
    r = rng.uniform(0.38, 0.5)
    curve = np.linspace(0.3, np.pi / 2, 7)
    outside = np.stack([r * np.sin(curve), 0.5 - 0.5 * np.cos(curve)], -1)
    inside = outside[::-1] * [0.9, 1] + [0, 0.03]
    t = np.linspace(0, 1, 10)
    path = np.stack([r * 0.85 + 0.5 * t, 0 * t, 0.38 + rng.uniform(0, 0.25) * t**2], -1)
    profile = np.concatenate([[[0, outside[0, 1]]], outside, inside, [[0, inside[-1, 1]]]])
    return [*_revolve(profile, (0, 0.2, 1, 1)), *_sweep(path, rng.uniform(0.05, 0.08), (0, 0, 1, 0.2))]


_MAKERS: dict[str, Callable[[np.random.Generator], list[_Chart]]] = {
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
KINDS = tuple(_MAKERS)


def make_object(kind: str, seed: int = 0) -> Mesh:
    """A textured object of unit diameter, its box's centre at the origin; kind is one of `KINDS`.

    Proportions and texture follow from the seed. Raises ValueError for an unknown kind.
    """
    if kind not in _MAKERS:
        raise ValueError(f"unknown kind of object {kind!r}: one of {', '.join(KINDS)}")
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    charts = _MAKERS[kind](rng)
    starts = np.cumsum([0] + [len(chart[0]) for chart in charts])
    rows = np.concatenate([np.concatenate(chart[:3], axis=-1) for chart in charts])
    faces = np.concatenate([chart[3] + start for chart, start in zip(charts, starts[:-1], strict=True)])
    rows[:, :3] /= np.linalg.norm(np.ptp(rows[:, :3], axis=0))  # near enough to 1 for the length of edges
    rows, faces = _split_long_edges(rows, faces, EDGE)
    keep = _areas(rows[:, :3], faces) > 1e-12
    texture = make_texture(int(rng.integers(2**31)))
    length = np.linalg.norm(rows[:, 5:8], axis=-1, keepdims=True)
    return normalise(
        make_mesh(rows[:, :3], faces[keep], uv=rows[:, 3:5], normals=rows[:, 5:8] / length, texture=texture)
    )


def _areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
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


# --- scenes -----------------------------------------------------------------------------------------------------------


def make_scene(
    objects: Sequence[Mesh],
    seed: int = 0,
    *,
    sizes: Sequence[float] | None = None,
    clutter: int = 4,
    least_visible: float = 0.5,
    sensor: Sensor = Sensor(),
    oversample: int = 3,
    backend: str = "auto",
) -> Scene:
    """Objects standing and lying on a table among clutter, seen by an RGB-D camera of 640 × 480 pixels.

    Args:
      objects: meshes of unit diameter; each is placed on a side that it can lie on.
      sizes: their diameters in metres; drawn from 0.09 … 0.22 by default.
      clutter: how many more objects stand in the way.
      least_visible: the camera is put where at least this share of the first object's outline is seen, as far as
        forty tries allow; `Scene.visible` has what came of it.
      sensor: what the camera adds; `PERFECT` adds nothing.
      oversample: odd; samples on a side of each pixel. 1 is faster.

    Raises:
      ValueError: no objects, or sizes that do not fit them.
      RenderError: nothing can draw, with a given `backend`.
    """
    if not objects:
        raise ValueError("a scene needs at least one object")
    if sizes is not None and (len(sizes) != len(objects) or not all(np.isfinite(sizes)) or min(sizes) <= 0):
        raise ValueError(f"{len(objects)} objects need as many positive sizes, got {list(sizes)}")
    rng = np.random.default_rng([seed, 11])
    drawn = rng.uniform(0.09, 0.22, len(objects) + clutter)
    bystanders = rng.choice(10 * len(KINDS), clutter, replace=False)
    meshes = [*objects, *(_make_bystander(int(number)) for number in bystanders)]
    diameters = [*(drawn[: len(objects)] if sizes is None else sizes), *drawn[len(objects) :]]
    world_from_object = _place(rng, meshes, diameters)
    camera = _draw_camera(rng)
    camera_from_world = _choose_view(rng, meshes, world_from_object, camera, least_visible)

    poses = [camera_from_world @ pose for pose in world_from_object]
    room = [(mesh, camera_from_world.to_jax()) for mesh in _make_room(rng)]
    down = camera_from_world.rotation @ np.array([0.0, 0, -1])
    light = {
        "direction": down + 0.7 * rng.normal(size=3) * [1, 1, 0.5],
        "ambient": float(rng.uniform(0.45, 0.7)),
        "diffuse": float(rng.uniform(0.35, 0.6)),
    }
    placed = [(mesh, pose.to_jax()) for mesh, pose in zip(meshes, poses, strict=True)]
    renders = render_scene([*placed, *room], camera, HEIGHT, WIDTH, light=light, oversample=oversample, backend=backend)
    if renders.ids is None:
        raise RuntimeError("the renderer returned no segmentation")
    ids = renders.ids[0]
    masks = np.stack([ids == index for index in range(len(objects))])
    areas = [_outline_area(mesh, pose, camera) for mesh, pose in zip(objects, poses, strict=False)]
    return Scene(
        rgb=_expose(rng, renders.rgb[0], sensor),
        depth=_sense(rng, renders.depth[0], camera, sensor),
        masks=masks,
        visible=np.clip(masks.sum((1, 2)) / np.maximum(areas, 1), 0, 1),
        camera=camera,
        camera_from_object=tuple(similarity for _, similarity in placed[: len(objects)]),
        backend=renders.backend,
    )


@functools.lru_cache(maxsize=10 * len(KINDS))
def _make_bystander(number: int) -> Mesh:
    """One of a fixed crowd, so that many scenes do not make a new crowd each; seeds that no caller's object has."""
    return make_object(KINDS[number % len(KINDS)], 10**9 + number)


def _draw_camera(rng: np.random.Generator) -> Camera:
    focal = rng.uniform(520, 640) * np.array([1, rng.uniform(0.99, 1.01)])
    centre = middle(WIDTH, HEIGHT) + rng.normal(0, 6, 2)
    return Camera(focal=jnp.asarray(focal, jnp.float32), centre=jnp.asarray(centre, jnp.float32))


def _rotate_onto(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The shortest rotation that takes one unit vector to another."""
    axis, cosine = np.cross(first, second), float(first @ second)
    if cosine < -0.999999:
        other = np.eye(3)[np.abs(first).argmin()]
        half = np.cross(first, other)
        half /= np.linalg.norm(half)
        return 2 * np.outer(half, half) - np.eye(3)
    skew = np.cross(np.eye(3), -axis)
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def _place(
    rng: np.random.Generator, meshes: Sequence[Mesh], diameters: Sequence[float]
) -> list[Similarity[np.ndarray]]:
    """``world_from_object``: every mesh rests on a face of its hull, the larger the likelier, apart from others."""
    poses, taken = [], []
    for mesh, diameter in zip(meshes, diameters, strict=True):
        hull = ConvexHull(mesh.vertices)
        area = _areas(hull.points, hull.simplices)
        side = rng.choice(len(area), p=area / area.sum())
        angle = rng.uniform(0, 2 * np.pi)
        rotation = _rotate_onto(hull.equations[side, :3], np.array([0.0, 0, -1]))
        rotation = rotation_from_vector(np.array([0, 0, angle])) @ rotation
        corners = diameter * hull.points[hull.vertices] @ rotation.T
        shadow = corners[ConvexHull(corners[:, :2]).vertices, :2]
        offset = rng.uniform(-0.02, 0.02, 2)
        for attempt in range(200):
            if all(_apart(shadow + offset, other) for other in taken):
                break
            reach = 0.11 + 0.0022 * attempt  # as near as there is room
            offset = rng.uniform(-reach, reach, 2)
        taken.append(shadow + offset)
        translation = np.array([*offset, -corners[:, 2].min()])
        poses.append(Similarity(rotation, translation, np.asarray(diameter, np.float64)))
    return poses


def _apart(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether a line separates two convex polygons, with 4 mm to spare."""
    for polygon in (first, second):
        edges = np.roll(polygon, -1, 0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], -1) / np.maximum(
            np.linalg.norm(edges, axis=-1, keepdims=True), 1e-9
        )
        a, b = first @ normals.T, second @ normals.T
        if ((a.min(0) - b.max(0) > 0.004) | (b.min(0) - a.max(0) > 0.004)).any():
            return True
    return False


def _choose_view(
    rng: np.random.Generator,
    meshes: Sequence[Mesh],
    world_from_object: Sequence[Similarity[np.ndarray]],
    camera: Camera,
    least: float,
) -> Similarity[np.ndarray]:
    """``camera_from_world`` of a camera above the table that sees enough of the first object; else the best of 40."""
    clouds = []
    for mesh, pose in zip(meshes, world_from_object, strict=True):
        picked = rng.choice(len(mesh.vertices), min(1500, len(mesh.vertices)), replace=False)
        clouds.append(pose @ mesh.vertices[picked])
    best, best_seen = None, -1.0
    for _ in range(40):
        view = _look(rng, world_from_object[0].translation)
        seen = _visible_share(clouds, view, camera)
        if seen > best_seen:
            best, best_seen = view, seen
        if seen >= least + 0.08:  # the points know it only roughly
            break
    assert best is not None
    return best


def _look(rng: np.random.Generator, target: np.ndarray) -> Similarity[np.ndarray]:
    """``camera_from_world`` of a camera that looks about at the target, nearly upright."""
    azimuth, elevation, distance = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.25), rng.uniform(0.45, 0.9)
    backwards = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    position = target + distance * backwards
    aim = target + rng.uniform(-0.09, 0.09, 3) * [1, 1, 0.3]
    ahead = (aim - position) / np.linalg.norm(aim - position)
    right = np.cross(ahead, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    rotation = rotation_from_vector(np.array([0, 0, rng.normal(0, 0.12)])) @ rotation
    return Similarity(rotation.T, position, np.ones(())).inverse()


def _visible_share(clouds: Sequence[np.ndarray], camera_from_world: Similarity[np.ndarray], camera: Camera) -> float:
    """Share of the first object's coarse outline where nothing is in front of it and the image has not ended."""
    cell = 10
    rows, columns = HEIGHT // cell, WIDTH // cell
    nearest = np.full((len(clouds), 3 * rows, 3 * columns), np.inf)
    for layer, cloud in zip(nearest, clouds, strict=True):
        points = camera_from_world @ cloud
        pixels = project(camera.to_matrix(), points)
        x, y = np.rint(resize_pixels(pixels, (cell, cell), (1, 1))).astype(int).T + np.array([[columns], [rows]])
        inside = (x >= 0) & (x < 3 * columns) & (y >= 0) & (y < 3 * rows)
        np.minimum.at(layer, (y[inside], x[inside]), points[inside, 2])
    mine = np.isfinite(nearest[0])
    shown = np.zeros_like(mine)
    shown[rows : 2 * rows, columns : 2 * columns] = True
    if len(clouds) > 1:
        shown &= nearest[0] <= nearest[1:].min(0)
    return float((mine & shown).sum() / max(mine.sum(), 1))


def _outline_area(mesh: Mesh, camera_from_object: Similarity[np.ndarray], camera: Camera) -> int:
    """Pixels that the mesh would cover if nothing stood before it, outside the image included."""
    import cv2

    pixels = project(camera.to_matrix(), camera_from_object @ mesh.vertices)
    low = np.floor(pixels.min(0)) - 1
    width, height = (np.ceil(pixels.max(0)) - low + 2).astype(int)
    canvas = np.zeros((height, width), np.uint8)
    fixed = np.round((pixels - low) * 16).astype(np.int32)
    for triangle in fixed[mesh.faces]:
        cv2.fillConvexPoly(canvas, triangle, 1, shift=4)
    return int(canvas.sum())


def _make_room(rng: np.random.Generator) -> list[Mesh]:
    """A table top about the origin, and the floor and walls around it."""
    # Duller than the objects, and of any brightness.
    first, second = (0.35 * _palette(rng, 2) + 0.65 * rng.uniform(30, 235, (2, 1))).clip(0, 255)
    grain = _marble(rng, TEXTURE, first, first * rng.uniform(0.6, 0.95))
    if rng.uniform() < 0.4:
        grain[:] = grain[:, :1]  # wood
    grain = grain + rng.normal(0, rng.uniform(1, 8), grain.shape)
    table = np.array([[-0.6, -0.45, 0], [0.6, -0.45, 0], [0.6, 0.45, 0], [-0.6, 0.45, 0]])
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    two = np.array([[0, 1, 2], [0, 2, 3]])
    wall = _marble(rng, TEXTURE, second, second * rng.uniform(0.7, 1.0)) + rng.normal(0, 4, (TEXTURE, TEXTURE, 1))
    r, low, high = 2.2, -0.75, 1.8
    a, b, c, d = [-r, -r], [r, -r], [r, r], [-r, r]
    quads = [[[*p, low], [*q, low], [*q, high], [*p, high]] for p, q in ((b, a), (c, b), (d, c), (a, d))]
    quads.append([[*p, low] for p in (a, b, c, d)])
    corners = np.array(quads, float).reshape(-1, 3)
    faces = np.concatenate([two + 4 * k for k in range(len(quads))])
    return [
        make_mesh(table, two, uv=square, texture=np.clip(grain, 0, 255).astype(np.uint8)),
        make_mesh(corners, faces, uv=np.tile(square, (len(quads), 1)), texture=np.clip(wall, 0, 255).astype(np.uint8)),
    ]


# --- the camera's own faults ------------------------------------------------------------------------------------------


def _expose(rng: np.random.Generator, rgb: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Exposure, white balance, blur and noise."""
    if sensor.colour == 0 and sensor.blur == 0:
        return rgb
    image = rgb.astype(np.float32) / 255
    if sensor.blur:
        image = ndimage.gaussian_filter(image, (sensor.blur, sensor.blur, 0))
    balance = rng.uniform(0.9, 1.1) * rng.normal(1, 0.03, 3)
    image = np.clip(image * balance, 0, 1) ** rng.uniform(0.85, 1.15)
    image = image + sensor.colour * rng.standard_normal(image.shape, np.float32)
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def _sense(rng: np.random.Generator, depth: np.ndarray, camera: Camera, sensor: Sensor) -> np.ndarray:
    """Depth as a cheap sensor would have it: frayed edges, noise that grows with z², steps, holes."""
    if sensor == PERFECT:
        return depth.astype(np.float32)
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    rise, run = np.gradient(depth.astype(np.float64), axis=0), np.gradient(depth.astype(np.float64), axis=1)
    # The normal of z(u, v) seen by a pinhole: tangents along u and v, crossed.
    fx, fy = np.asarray(camera.focal, float)
    rays = unproject(camera.to_matrix(), np.stack([columns, rows], -1).astype(float), np.ones((height, width)))
    along_u = rays * run[..., None] + depth[..., None] * [1 / fx, 0, 0]
    along_v = rays * rise[..., None] + depth[..., None] * [0, 1 / fy, 0]
    normal = np.cross(along_u, along_v)
    cosine = np.abs((normal * rays).sum(-1)) / np.maximum(
        np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1), 1e-12
    )
    jump = np.maximum(np.abs(rise), np.abs(run)) > 0.015

    shift = np.round(rng.normal(0, sensor.jitter, (2, height, width))).astype(int)
    moved = depth[np.clip(rows + shift[0], 0, height - 1), np.clip(columns + shift[1], 0, width - 1)].astype(np.float64)
    sigma = sensor.axial + sensor.quadratic * (moved - 0.4) ** 2
    noise = ndimage.gaussian_filter(rng.standard_normal((height, width)), 0.8)
    moved += sigma * noise / noise.std()
    if sensor.step:
        step = sensor.step * np.maximum(moved, 1e-3) ** 2
        moved = np.round(moved / step) * step
    blots = ndimage.gaussian_filter(rng.standard_normal((height, width)), 4)
    lost = blots > np.quantile(blots, 1 - sensor.holes) if sensor.holes else np.zeros_like(jump)
    lost |= jump & (rng.uniform(size=jump.shape) < sensor.edge)
    lost |= (cosine < sensor.grazing) & ~jump
    return np.where(lost | (depth <= 0), 0, np.round(moved, 4)).astype(np.float32)
