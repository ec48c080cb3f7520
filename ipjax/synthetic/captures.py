"""Synthetic captures: a hand-held RGB-D camera goes around a table, and the truth of all it saw is known.

The rig is that of cheap RGB-D cameras: a depth camera stands beside the colour camera, with a size, a focal length and
an invalid band of its own, and the factory's calibration of the two is a little wrong. The light hangs in the room.
Everything follows from a seed.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ipjax.cameras import middle
from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.files.storage.writing import write_text, writing
from ipjax.inference.depth import register_depth
from ipjax.records import Camera, Similarity
from ipjax.rendering.render import render_frames
from ipjax.synthetic.objects import KINDS, make_object
from ipjax.synthetic.sensor import STRUCTURED_LIGHT, Sensor, expose, sense_depth
from ipjax.synthetic.tables import make_room, place_on_table
from ipjax.synthetic.textures import make_texture
from ipjax.transforms import rotation_from_vector

DEPTH_UNIT = 0.0001  # metres per number of the depth images that are written
_BAND = 0.065  # of the width of a raw depth image that its camera does not know, on the left: 42 of 640 pixels


@dataclasses.dataclass(frozen=True)
class MadeCapture:
    """A capture of a table with objects, and the truth about it; world: the table's middle, z up."""

    names: tuple[str, ...]  # of the frames
    rgb: UInt8[np.ndarray, "v h w 3"]
    depth: Float[np.ndarray, "v h w"]  # raw depth registered to the colours as the factory would; metres; 0 = unknown
    raw_depth: Float[np.ndarray, "v hd wd"]  # as the depth camera saw it, metres; 0 = unknown
    camera: Camera  # of the colour images
    factory_depth_camera: Camera  # what the factory says of the depth camera
    factory_colour_from_depth: Similarity[np.ndarray]
    # The truth.
    depth_camera: Camera
    colour_from_depth: Similarity[np.ndarray]
    world_from_camera: Similarity[np.ndarray]  # of every frame, [v]
    world_from_object: Similarity[np.ndarray]  # of every mesh, [n]; its scale is the object's diameter, metres
    meshes: tuple[Mesh, ...]  # of unit diameter
    true_depth: Float[np.ndarray, "v h w"]  # in the colour camera, of everything; metres
    ids: Int[np.ndarray, "v h w"]  # which object is seen; -1 = table and room, -2 = the gripper
    backend: str  # of the renderer

    @property
    def gripper(self) -> Bool[np.ndarray, "h w"]:
        """What moves with the camera."""
        return self.ids[0] == -2


def make_capture(
    seed: int = 0,
    *,
    views: int = 24,
    objects: int | Sequence[Mesh] = 4,
    sizes: Sequence[float] | None = None,
    touching: int = 0,
    size: tuple[int, int] = (640, 480),
    depth_size: tuple[int, int] | None = None,
    arc: float | int = 360,
    sensor: Sensor = STRUCTURED_LIGHT,
    factory_error: float | int = 1,
    gripper: bool = False,
    oversample: int = 1,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> MadeCapture:
    """A table with several objects, seen by a hand-held camera that goes around it, 0.5 to 0.9 m away.

    Args:
      seed: draws objects, places, path, light, rig and noise.
      views: frames, evenly along the path; neighbours overlap where there are eight or more around the table.
      objects: how many, or meshes of unit diameter.
      sizes: their diameters in metres; drawn from 0.12 … 0.22 by default.
      touching: so many pairs of them touch: objects 0 and 1, 2 and 3 …; all others are 3 cm apart or more.
      size: of the colour images: width, height, pixels.
      depth_size: of the raw depth images; four fifths of `size` by default.
      arc: degrees that the camera goes around the table.
      sensor: what the cameras add; `PERFECT` adds nothing. The invalid band of the raw depth stays.
      factory_error: times the drawn error of the factory's calibration (about 0.25° and 2 mm per axis, and 0.4 % of
        the depth camera's focal length); 0 = the factory is right.
      gripper: two fingers that move with the camera reach into every image.
      oversample: odd; samples on a side of each pixel.
      progress: called as ``progress(done, total)`` after every image.

    Raises:
      ValueError: fewer than two views, no objects, or sizes that do not fit them.
      RenderError: nothing can draw, with a given `backend`.
    """
    rng = np.random.default_rng([seed, 41])
    if views < 2:
        raise ValueError(f"a capture has two views or more, not {views}")
    if isinstance(objects, int):
        kinds = rng.permutation(np.resize(rng.permutation(len(KINDS)), max(objects, 0)))
        objects = [make_object(KINDS[kind], int(rng.integers(2**31))) for kind in kinds]
    if not objects:
        raise ValueError("a capture needs at least one object")
    if sizes is not None and (len(sizes) != len(objects) or not all(np.isfinite(sizes)) or min(sizes) <= 0):
        raise ValueError(f"{len(objects)} objects need as many positive sizes, got {list(sizes)}")
    diameters = rng.uniform(0.12, 0.22, len(objects)) if sizes is None else np.asarray(sizes, np.float64)
    placed = place_on_table(rng, objects, list(diameters), gap=0.03, touching=touching)
    room = make_room(rng)
    world_from_camera = _draw_path(rng, views, arc)
    camera, depth_camera, colour_from_depth = _draw_rig(rng, size, depth_size or _shrink(size))
    depth_size = depth_size or _shrink(size)
    light = {"ambient": float(rng.uniform(0.5, 0.65)), "diffuse": float(rng.uniform(0.45, 0.6))}
    down = np.array([0.0, 0, -1]) + 0.6 * rng.normal(size=3) * [1, 1, 0.3]  # where the light goes, in the world

    world_from = [(mesh, pose) for mesh, pose in zip(objects, placed, strict=True)]
    world_from += [(mesh, Similarity(np.eye(3), np.zeros(3), np.ones(()))) for mesh in room]
    fingers = _make_gripper(rng) if gripper else []
    still = Similarity(*(np.repeat(x[None], views, 0) for x in (np.eye(3), np.zeros(3), np.ones(()))))

    def draw(camera_from_rig: Similarity[np.ndarray], pinhole: Camera, pixels: tuple[int, int], done: int):
        camera_from_world = camera_from_rig @ world_from_camera.inverse()
        shown = [(mesh, camera_from_world @ pose) for mesh, pose in world_from]
        shown += [(mesh, camera_from_rig @ still) for mesh in fingers]
        lamp = {"direction": camera_from_world.rotation @ down, **light}

        def told(now: int, _: int) -> None:
            if progress is not None:
                progress(done + now, 2 * views)

        width, height = pixels
        return render_frames(
            shown, pinhole, height, width, light=lamp, oversample=oversample, backend=backend, progress=told
        )

    seen = draw(still, camera, size, 0)
    beside = draw(colour_from_depth.inverse(), depth_camera, depth_size, views)
    rgb = np.stack([expose(rng, image, sensor) for image in seen.rgb])
    raw = np.stack([sense_depth(rng, depth, depth_camera, sensor) for depth in beside.depth])
    raw[:, :, : round(_BAND * depth_size[0])] = 0
    error = factory_error * rng.normal(0, [0.0045] * 3 + [0.002] * 3)
    factory = colour_from_depth @ Similarity[np.ndarray].exp(error)
    factory_depth_camera = Camera(
        depth_camera.focal * jnp.float32(1 + factory_error * rng.normal(0, 0.004)), depth_camera.centre
    )
    registered = [register_depth(depth, factory_depth_camera, factory, camera, size) for depth in raw]
    if seen.ids is None:
        raise RuntimeError("the renderer returned no segmentation")
    ids = np.where(seen.ids >= len(objects), np.where(seen.ids >= len(world_from), -2, -1), seen.ids)
    return MadeCapture(
        names=tuple(f"{index:06d}" for index in range(views)),
        rgb=rgb,
        depth=np.stack(registered),
        raw_depth=raw,
        camera=camera,
        factory_depth_camera=factory_depth_camera,
        factory_colour_from_depth=factory,
        depth_camera=depth_camera,
        colour_from_depth=colour_from_depth,
        world_from_camera=world_from_camera,
        world_from_object=Similarity[np.ndarray].stack(placed),
        meshes=tuple(objects),
        true_depth=seen.depth,
        ids=ids,
        backend=seen.backend,
    )


def write_capture(capture: MadeCapture, folder: str | Path, *, poses: bool = False, raw: bool = True) -> Path:
    """A capture as a folder of frames: what its camera gave, and nothing of the truth unless it is asked for.

    ``rgb/`` and ``depth/`` (registered by the factory) with ``camera.json``; ``raw/`` with ``depth_camera.json``, which
    has the factory's ``colour_from_depth``. Depth is in tenths of a millimetre.

    Args:
      folder: made if it is missing.
      poses: write the true ``poses.json`` (world_from_camera), as a robot or a motion capture system would give it.
      raw: write the raw depth, too.

    Raises:
      OSError: it cannot be written.
    """
    folder = Path(folder)
    for name in ("rgb", "depth", *(["raw"] if raw else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(capture.names):
        _write_image(folder / "rgb" / f"{name}.png", capture.rgb[index])
        _write_image(folder / "depth" / f"{name}.png", _in_units(capture.depth[index]))
        if raw:
            _write_image(folder / "raw" / f"{name}.png", _in_units(capture.raw_depth[index]))
    height, width = capture.depth.shape[1:]
    write_text(folder / "camera.json", json.dumps(_describe(capture.camera, (width, height)), indent=2))
    if raw:
        height, width = capture.raw_depth.shape[1:]
        told = _describe(capture.factory_depth_camera, (width, height))
        told["colour_from_depth"] = capture.factory_colour_from_depth.to_matrix().tolist()
        write_text(folder / "depth_camera.json", json.dumps(told, indent=2))
    if poses:
        matrices = capture.world_from_camera.to_matrix().tolist()
        write_text(folder / "poses.json", json.dumps(dict(zip(capture.names, matrices, strict=True)), indent=1))
    return folder


def _write_image(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    with writing(path) as temporary:
        Image.fromarray(image).save(temporary, compress_level=1)


def _in_units(depth: np.ndarray) -> np.ndarray:
    units = np.round(depth / DEPTH_UNIT)
    return np.where(units <= 65535, units, 0).astype(np.uint16)  # farther is not known, rather than nearer


def _describe(camera: Camera, size: tuple[int, int]) -> dict:
    K = camera.to_matrix()
    return {
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "width": size[0],
        "height": size[1],
        "depth_scale": DEPTH_UNIT * 1000,  # to millimetres, as BOP has it
    }


def _shrink(size: tuple[int, int]) -> tuple[int, int]:
    return round(0.8 * size[0]), round(0.8 * size[1])


def _draw_rig(
    rng: np.random.Generator, size: tuple[int, int], depth_size: tuple[int, int]
) -> tuple[Camera, Camera, Similarity[np.ndarray]]:
    """The colour camera, a depth camera that sees a tenth more, and ``colour_from_depth``."""
    zoom = rng.uniform(0.88, 0.97) * size[0]
    cameras = []
    for (width, height), focal in ((size, zoom), (depth_size, zoom / size[0] / 1.1 * depth_size[0])):
        centre = middle(width, height) + rng.normal(0, 0.01, 2) * width
        focals = focal * np.array([1, rng.uniform(0.995, 1.005)])
        cameras.append(Camera(focal=jnp.asarray(focals, jnp.float32), centre=jnp.asarray(centre, jnp.float32)))
    beside = np.array([rng.choice([-1, 1]) * 0.025, 0, 0]) + rng.normal(0, [0.001, 0.001, 0.003])
    turn = rotation_from_vector(rng.normal(0, 0.007, 3))
    return cameras[0], cameras[1], Similarity(turn, beside, np.ones(()))


def _draw_path(rng: np.random.Generator, views: int, arc: float | int) -> Similarity[np.ndarray]:
    """``world_from_camera`` of a hand that carries the camera around the table, [v]."""
    share = np.arange(views) / (views if arc >= 360 else max(views - 1, 1))
    step = np.deg2rad(arc) / views
    azimuth = rng.uniform(0, 2 * np.pi) + np.deg2rad(arc) * share + rng.normal(0, 0.12 * step, views)
    # The hand rises and sinks, comes nearer and leaves, once or twice around the table.
    waves = [np.sin(2 * np.pi * (rng.integers(1, 3) * share * min(arc / 360, 1) + rng.uniform())) for _ in range(2)]
    elevation = 0.72 + 0.2 * waves[0] + rng.normal(0, 0.03, views)
    distance = np.clip(0.7 + 0.14 * waves[1] + rng.normal(0, 0.02, views), 0.5, 0.9)
    backwards = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    aim = rng.normal([0, 0, 0.04], 0.02, (views, 3))
    ahead = -backwards
    right = np.cross(ahead, [0.0, 0, 1])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    upright = np.stack([right, np.cross(ahead, right), ahead], -1)
    turn = rotation_from_vector(rng.normal(0, [0.02, 0.02, 0.06], (views, 3)))
    return Similarity(upright @ turn, aim + distance[:, None] * backwards, np.ones(views))


def _make_gripper(rng: np.random.Generator) -> list[Mesh]:
    """Two fingers in the frame of the colour camera, from below the image into its lower third."""
    fingers = []
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    for side in (-1, 1):
        box = corners * [0.012, 0.05, 0.012] + [side * 0.055, 0.125, 0.28]
        vertices = np.concatenate([box[quad] for quad in sides])
        faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(6)])
        square = np.array([[0.0, 0], [0.24, 0], [0.24, 1], [0, 1]])  # of the texture, as long as the fingers are
        texture = make_texture(int(rng.integers(2**31)), 128)
        fingers.append(make_mesh(vertices, faces, uv=np.tile(square, (6, 1)), texture=texture))
    return fingers
