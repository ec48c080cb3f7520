"""Tables with objects on them, and the room around: what synthetic scenes and captures have in common."""

import functools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.records import Similarity
from ipjax.synthetic.objects import KINDS, face_areas, make_object
from ipjax.synthetic.textures import TEXTURE, make_marble, make_palette
from ipjax.transforms import rotation_from_vector

TABLE = (1.2, 0.9)  # metres: of the table top that `make_room` makes


@functools.lru_cache(maxsize=10 * len(KINDS))
def make_clutter(number: int) -> Mesh:
    """One of a fixed set of objects, made once for many scenes; from seeds that no caller's object has."""
    return make_object(KINDS[number % len(KINDS)], 10**9 + number)


def place_on_table(
    rng: np.random.Generator,
    meshes: Sequence[Mesh],
    diameters: Sequence[float],
    *,
    gap: float = 0.004,
    touching: int = 0,
    row: int = 0,
) -> list[Similarity[np.ndarray]]:
    """``world_from_object``: every mesh rests on a face of its hull, the larger the likelier, apart from others.

    Args:
      diameters: metres.
      gap: metres between what the objects cover of the table.
      touching: of so many pairs the second object is pushed against the first: meshes 0 and 1, 2 and 3 …
      row: so many of the first meshes are in a row, each pushed against the one before it.
    """
    poses, taken = [], []
    for mesh, diameter in zip(meshes, diameters, strict=True):
        hull = ConvexHull(mesh.vertices)
        area = face_areas(hull.points, hull.simplices)
        side = rng.choice(len(area), p=area / area.sum())
        angle = rng.uniform(0, 2 * np.pi)
        rotation = rotate_onto(hull.equations[side, :3], np.array([0.0, 0, -1]))
        rotation = rotation_from_vector(np.array([0, 0, angle])) @ rotation
        corners = diameter * hull.points[hull.vertices] @ rotation.T
        shadow = corners[ConvexHull(corners[:, :2]).vertices, :2]
        offset = rng.uniform(-0.02, 0.02, 2)
        pushed = (len(taken) % 2 == 1 and len(taken) < 2 * touching) or 0 < len(taken) < row
        for attempt in range(200):
            if pushed:
                offset = _push(rng, shadow, taken[-1])
            if all(are_apart(shadow + offset, other, gap) for other in (taken[:-1] if pushed else taken)):
                break
            if not pushed:
                reach = 0.11 + 0.0022 * attempt  # as near as there is room
                offset = rng.uniform(-reach, reach, 2)
        taken.append(shadow + offset)
        translation = np.array([*offset, -corners[:, 2].min()])
        poses.append(Similarity(rotation, translation, np.asarray(diameter, np.float64)))
    return poses


def _push(rng: np.random.Generator, shadow: np.ndarray, against: np.ndarray) -> np.ndarray:
    """The offset at which a convex polygon, pushed from a random side towards another, is half a millimetre from it."""
    angle = rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle)])
    near, far = 0.0, float(np.ptp(shadow, axis=0).sum() + np.ptp(against, axis=0).sum())
    start = against.mean(0) - shadow.mean(0)
    for _ in range(20):
        half = (near + far) / 2
        near, far = (near, half) if are_apart(shadow + start + half * way, against, 0.0005) else (half, far)
    return start + far * way


def are_apart(first: np.ndarray, second: np.ndarray, gap: float = 0.004) -> bool:
    """Whether a line separates two convex polygons, with a gap (metres) to spare."""
    for polygon in (first, second):
        edges = np.roll(polygon, -1, 0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], -1) / np.maximum(
            np.linalg.norm(edges, axis=-1, keepdims=True), 1e-9
        )
        a, b = first @ normals.T, second @ normals.T
        if ((a.min(0) - b.max(0) > gap) | (b.min(0) - a.max(0) > gap)).any():
            return True
    return False


def rotate_onto(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The shortest rotation that takes one unit vector to another."""
    axis, cosine = np.cross(first, second), float(first @ second)
    if cosine < -0.999999:
        other = np.eye(3)[np.abs(first).argmin()]
        half = np.cross(first, other)
        half /= np.linalg.norm(half)
        return 2 * np.outer(half, half) - np.eye(3)
    skew = np.cross(np.eye(3), -axis)
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def make_room(rng: np.random.Generator) -> list[Mesh]:
    """A table top about the origin, and the floor and walls around it."""
    # Duller than the objects, and of any brightness.
    first, second = (0.35 * make_palette(rng, 2) + 0.65 * rng.uniform(30, 235, (2, 1))).clip(0, 255)
    grain = make_marble(rng, TEXTURE, first, first * rng.uniform(0.6, 0.95))
    if rng.uniform() < 0.4:
        grain[:] = grain[:, :1]  # wood
    grain = grain + rng.normal(0, rng.uniform(1, 8), grain.shape)
    x, y = TABLE[0] / 2, TABLE[1] / 2
    table = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    two = np.array([[0, 1, 2], [0, 2, 3]])
    wall = make_marble(rng, TEXTURE, second, second * rng.uniform(0.7, 1.0)) + rng.normal(0, 4, (TEXTURE, TEXTURE, 1))
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
