"""Models in new arrangements: dropped onto a table, seen by several cameras, with the truth."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int

from ipjax.cameras import middle
from ipjax.capture.labels.masks import FrameLabels, label_frames
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.capture.views.paths import look_from
from ipjax.capture.views.settling import SettlingConfig, settle
from ipjax.files.meshes.mesh import diameter
from ipjax.records import Camera
from ipjax.rendering.render import render_frames
from ipjax.synthetic.sensor import PERFECT, Sensor, expose, sense_depth
from ipjax.synthetic.tables import make_room
from ipjax.transforms import Similarity


@dataclasses.dataclass(frozen=True)
class Arrangement:
    """Things on a table, and what cameras around it see; world: the table's middle, z up."""

    frames: tuple[PosedFrame, ...]
    labels: tuple[FrameLabels, ...]
    which: tuple[int, ...]  # the model of every thing
    things: tuple[ObjectModel, ...]  # where they came to rest
    ids: Int[np.ndarray, "v h w"]  # which thing is seen; −1 = table and room
    deep: float  # metres that the deepest contact of any two, or of one with the table, is in the other


def arrange(
    models: Sequence[ObjectModel],
    seed: int = 0,
    *,
    views: int = 12,
    count: int | None = None,
    size: tuple[int, int] = (640, 480),
    sensor: Sensor = PERFECT,
    oversample: int = 3,
    settling: SettlingConfig | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Arrangement:
    """Drop models onto a table and look at them from all around; all of it follows from the seed.

    The light hangs in the room, other in each arrangement. Masks, boxes and poses are exact.

    Args:
      models: metres.
      views: cameras, around the table at various heights and distances.
      count: of things, drawn among the models (some may come twice); by default each model once.
      size: of the images: width, height.
      sensor: what the cameras add; nothing by default.
      oversample: odd; samples on a side of each pixel.

    Raises:
      CaptureError: the models do not come to rest on the table.
      ValueError: there are no models, or no views or things are asked for.
      RenderError: nothing can draw, with a given `backend`.
    """
    if not models:
        raise ValueError("there are no models to arrange")
    if views < 1 or (count is not None and count < 1):
        raise ValueError(f"an arrangement has one view and one thing or more, not {views} and {count}")
    rng = np.random.default_rng([seed, 59])
    which = tuple(range(len(models)))
    if count is not None:
        rounds = [rng.permutation(len(models)) for _ in range(-(-count // len(models)))]
        which = tuple(int(i) for i in np.concatenate(rounds)[:count])
    settled = settle([models[i].mesh for i in which], seed, settling)
    things = tuple(
        dataclasses.replace(models[i], world_from_model=pose)
        for i, pose in zip(which, settled.world_from_thing, strict=True)
    )
    middles = np.stack([pose.translation for pose in settled.world_from_thing])
    reach = max(
        float(np.linalg.norm(place[:2] - middles.mean(0)[:2])) + diameter(thing.mesh) / 2
        for place, thing in zip(middles, things, strict=True)
    )
    width, height = size
    focal = rng.uniform(0.88, 0.97) * width
    K = np.array([[focal, 0, 0], [0, focal, 0], [0, 0, 1.0]])
    K[:2, 2] = middle(width, height) + rng.normal(0, 0.01, 2) * width
    world_from_camera = _draw_cameras(rng, views, middles.mean(0), reach, 2 * focal / min(width, height * 4 / 3))
    room = make_room(rng)
    light = {"ambient": float(rng.uniform(0.45, 0.65)), "diffuse": float(rng.uniform(0.4, 0.6))}
    down = np.array([0.0, 0, -1]) + 0.6 * rng.normal(size=3) * [1, 1, 0.3]

    camera_from_world = world_from_camera.inverse()
    shown = [(thing.mesh, camera_from_world @ thing.world_from_model) for thing in things]
    shown += [(mesh, camera_from_world) for mesh in room]
    seen = render_frames(
        shown,
        Camera.from_matrix(K),
        height,
        width,
        light={"direction": camera_from_world.rotation @ down, **light},
        oversample=oversample,
        backend=backend,
        progress=progress,
    )
    if seen.ids is None:
        raise RuntimeError("the renderer returned no segmentation")
    camera = Camera.from_matrix(K)
    frames = []
    for number in range(views):
        pose = world_from_camera.take(number)
        rgb, depth = expose(rng, seen.rgb[number], sensor), sense_depth(rng, seen.depth[number], camera, sensor)
        frames.append(PosedFrame(f"{number:06d}", rgb, depth, np.ones(depth.shape, bool), K, pose))
    labels = label_frames(things, frames, exact=True, backend=backend)
    ids = np.where(seen.ids < len(things), seen.ids, -1)
    return Arrangement(tuple(frames), tuple(labels), which, things, ids, settled.deep)


def _draw_cameras(
    rng: np.random.Generator, views: int, at: np.ndarray, reach: float, zoom: float
) -> Similarity[np.ndarray]:
    """``world_from_camera`` of cameras around a place, all of it in view, [v]."""
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(views) + rng.uniform(-0.3, 0.3, views)) / views
    elevation = rng.uniform(0.45, 1.15, views)
    distance = np.maximum(rng.uniform(1.05, 1.45, views) * reach * zoom, 0.35)
    backwards = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    poses = look_from(at + distance[:, None] * backwards, at, np.array([0.0, 0, 1]))
    wobble = Similarity[np.ndarray].exp(
        np.concatenate([rng.normal(0, [0.03, 0.03, 0.08], (views, 3)), np.zeros((views, 3))], 1)
    )
    return poses @ wobble
