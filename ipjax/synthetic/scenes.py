"""Synthetic scenes with their true poses, for the demo and for fitting the confidence.

Everything follows from a kind and a seed, so two people with the same version see the same scene. Objects have unit
diameter, like every normalised mesh; a scene gives each a size in metres.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import ConvexHull

from ipjax.cameras import middle, project, resize_pixels
from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.records import Camera, Similarity
from ipjax.rendering.render import render_scene
from ipjax.synthetic.objects import KINDS, face_areas, make_object
from ipjax.synthetic.sensor import STRUCTURED_LIGHT, Sensor, expose, sense_depth
from ipjax.synthetic.textures import TEXTURE, make_marble, make_palette
from ipjax.transforms import rotation_from_vector

WIDTH, HEIGHT = 640, 480


@dataclasses.dataclass(frozen=True)
class Scene:
    """One RGB-D frame of a table, and the truth about it."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # along z, metres; 0 = unknown
    masks: Bool[np.ndarray, "n h w"]  # where each object is seen
    visible: Float[np.ndarray, " n"]  # share of each object's outline that is seen
    camera: Camera
    camera_from_object: tuple[Similarity, ...]  # of each mesh as it was given; metres
    backend: str  # of the renderer

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K, pixels."""
        return self.camera.to_matrix()


def make_scene(
    objects: Sequence[Mesh],
    seed: int = 0,
    *,
    sizes: Sequence[float] | None = None,
    clutter: int = 4,
    least_visible: float = 0.5,
    sensor: Sensor = STRUCTURED_LIGHT,
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
    cluttering = rng.choice(10 * len(KINDS), clutter, replace=False)
    meshes = [*objects, *(_make_clutter(int(number)) for number in cluttering)]
    diameters = [*(drawn[: len(objects)] if sizes is None else sizes), *drawn[len(objects) :]]
    world_from_object = _place_on_table(rng, meshes, diameters)
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
        rgb=expose(rng, renders.rgb[0], sensor),
        depth=sense_depth(rng, renders.depth[0], camera, sensor),
        masks=masks,
        visible=np.clip(masks.sum((1, 2)) / np.maximum(areas, 1), 0, 1),
        camera=camera,
        camera_from_object=tuple(similarity for _, similarity in placed[: len(objects)]),
        backend=renders.backend,
    )


@functools.lru_cache(maxsize=10 * len(KINDS))
def _make_clutter(number: int) -> Mesh:
    """One of a fixed set of objects, made once for many scenes; from seeds that no caller's object has."""
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


def _place_on_table(
    rng: np.random.Generator, meshes: Sequence[Mesh], diameters: Sequence[float]
) -> list[Similarity[np.ndarray]]:
    """``world_from_object``: every mesh rests on a face of its hull, the larger the likelier, apart from others."""
    poses, taken = [], []
    for mesh, diameter in zip(meshes, diameters, strict=True):
        hull = ConvexHull(mesh.vertices)
        area = face_areas(hull.points, hull.simplices)
        side = rng.choice(len(area), p=area / area.sum())
        angle = rng.uniform(0, 2 * np.pi)
        rotation = _rotate_onto(hull.equations[side, :3], np.array([0.0, 0, -1]))
        rotation = rotation_from_vector(np.array([0, 0, angle])) @ rotation
        corners = diameter * hull.points[hull.vertices] @ rotation.T
        shadow = corners[ConvexHull(corners[:, :2]).vertices, :2]
        offset = rng.uniform(-0.02, 0.02, 2)
        for attempt in range(200):
            if all(_are_apart(shadow + offset, other) for other in taken):
                break
            reach = 0.11 + 0.0022 * attempt  # as near as there is room
            offset = rng.uniform(-reach, reach, 2)
        taken.append(shadow + offset)
        translation = np.array([*offset, -corners[:, 2].min()])
        poses.append(Similarity(rotation, translation, np.asarray(diameter, np.float64)))
    return poses


def _are_apart(first: np.ndarray, second: np.ndarray) -> bool:
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
        view = _draw_view(rng, world_from_object[0].translation)
        seen = _visible_share(clouds, view, camera)
        if seen > best_seen:
            best, best_seen = view, seen
        if seen >= least + 0.08:  # the share is estimated from few points
            break
    assert best is not None
    return best


def _draw_view(rng: np.random.Generator, target: np.ndarray) -> Similarity[np.ndarray]:
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
    first, second = (0.35 * make_palette(rng, 2) + 0.65 * rng.uniform(30, 235, (2, 1))).clip(0, 255)
    grain = make_marble(rng, TEXTURE, first, first * rng.uniform(0.6, 0.95))
    if rng.uniform() < 0.4:
        grain[:] = grain[:, :1]  # wood
    grain = grain + rng.normal(0, rng.uniform(1, 8), grain.shape)
    table = np.array([[-0.6, -0.45, 0], [0.6, -0.45, 0], [0.6, 0.45, 0], [-0.6, 0.45, 0]])
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
