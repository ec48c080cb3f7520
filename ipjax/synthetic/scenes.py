"""Synthetic scenes with their true poses, for the demo and for fitting the confidence.

Everything follows from a kind and a seed, so two people with the same version see the same scene. Objects have unit
diameter, like every normalised mesh; a scene gives each a size in metres.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.cameras import middle, project, resize_pixels
from ipjax.files.meshes.mesh import Mesh
from ipjax.records import Camera, Similarity
from ipjax.rendering.render import render_scene
from ipjax.synthetic.objects import KINDS
from ipjax.synthetic.sensor import STRUCTURED_LIGHT, Sensor, expose, sense_depth
from ipjax.synthetic.tables import make_clutter, make_room, place_on_table
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
    touching: bool = False,
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
      touching: each of the objects stands against the one before it, half a millimetre from it.
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
    meshes = [*objects, *(make_clutter(int(number)) for number in cluttering)]
    diameters = [*(drawn[: len(objects)] if sizes is None else sizes), *drawn[len(objects) :]]
    world_from_object = place_on_table(rng, meshes, diameters, row=len(objects) if touching else 0)
    camera = _draw_camera(rng)
    camera_from_world = _choose_view(rng, meshes, world_from_object, camera, least_visible)

    poses = [camera_from_world @ pose for pose in world_from_object]
    room = [(mesh, camera_from_world.to_jax()) for mesh in make_room(rng)]
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


def _draw_camera(rng: np.random.Generator) -> Camera:
    focal = rng.uniform(520, 640) * np.array([1, rng.uniform(0.99, 1.01)])
    centre = middle(WIDTH, HEIGHT) + rng.normal(0, 6, 2)
    return Camera(focal=jnp.asarray(focal, jnp.float32), centre=jnp.asarray(centre, jnp.float32))


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
