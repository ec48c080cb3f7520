"""Images of meshes: MuJoCo in a child process, or our own z-buffer where no GL library works.

Depth is along z in the units of the poses, 0 where there is nothing; pixel centres are integers. Colours are unlit
unless a light is asked for: what is in the texture is what is in the image.
"""

import dataclasses
import logging
from collections.abc import Callable, Sequence

import numpy as np

from ipjax.files.meshes.mesh import Mesh
from ipjax.progress import bar
from ipjax.records import Camera, Similarity
from ipjax.rendering.job import Job, RenderError, Renders
from ipjax.rendering.mujoco_process import MeshRefusedError, draw_mujoco, gl_backends, recent_failure, run_child
from ipjax.rendering.raster import draw_raster

log = logging.getLogger("ipjax")

BACKENDS = ("egl", "osmesa", "native", "raster")


def render(
    mesh: Mesh,
    camera_from_object: Similarity,
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
    oversample: int = 1,
    light: dict | None = None,
    progress: bool | Callable[[int, int], None] = False,
) -> Renders:
    """Images of one mesh at the poses ``camera_from_object`` [v] (or one pose without an axis), height × width pixels.

    Vertices are taken as they are: give a normalised mesh and template poses for templates (depth in model units), or
    a mesh and poses in metres for a scene. `camera` has one focal and centre [2], or one per view [v 2].
    `oversample` is odd: 3 averages the colours of 3 × 3 samples per pixel and takes the depth of the middle one.
    `progress`: True shows a bar; a function is called as `progress(done, total)` after every view. Raises RenderError
    naming the backend and the package to install; ValueError for wrong arguments.
    """
    rotation, translation, scale = (
        np.asarray(x, np.float64)
        for x in (camera_from_object.rotation, camera_from_object.translation, camera_from_object.scale)
    )
    if rotation.ndim == 2:
        rotation, translation, scale = rotation[None], translation[None], scale[None]
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise ValueError("the scale of a pose to render is not positive")
    # A similarity seen by a pinhole is a rigid motion seen from 1/scale as far, with depths times the scale.
    poses = np.concatenate([rotation, (translation / scale[:, None])[..., None]], axis=-1)[:, None]
    job = Job([mesh], poses, scale, camera, height, width, oversample, light, False)
    if progress is not True:
        return _draw(job, backend, progress or None)
    with bar(total=len(poses), desc="rendering", unit="view") as shown:

        def advance(done: int, total: int) -> None:
            shown.update(done - shown.n)

        return _draw(job, backend, advance)


def render_scene(
    objects: Sequence[tuple[Mesh, Similarity]],
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
    oversample: int = 3,
    light: dict | None = None,
) -> Renders:
    """One image of several meshes, each at its own ``camera_from_object``; `ids` says which mesh is at each pixel.

    `light` is None (unlit) or ``{"direction": [3] in the camera frame, "ambient": a, "diffuse": d}``. Otherwise as
    `render`; the result has one view.
    """
    if not objects:
        raise ValueError("a scene needs at least one object")
    meshes, poses = [], []
    for mesh, camera_from_object in objects:
        scale = float(np.asarray(camera_from_object.scale))
        meshes.append(dataclasses.replace(mesh, vertices=mesh.vertices * scale))
        rotation = np.asarray(camera_from_object.rotation, np.float64)
        translation = np.asarray(camera_from_object.translation, np.float64)
        poses.append(np.concatenate([rotation, translation[:, None]], axis=-1))
    job = Job(meshes, np.stack(poses)[None], np.ones(1), camera, height, width, oversample, light, True)
    return _draw(job, backend, None)


def render_frames(
    objects: Sequence[tuple[Mesh, Similarity[np.ndarray]]],
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
    oversample: int = 3,
    light: dict | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Renders:
    """Several images of one scene: of each mesh its ``camera_from_object`` in every frame, [v], all of the same scale.

    As `render_scene` otherwise; the light's direction may be one per frame, [v 3], each in its camera's frame: that of
    a lamp that hangs in the world turns with the camera. `progress` is called as `progress(done, total)`.
    """
    if not objects:
        raise ValueError("a scene needs at least one object")
    meshes, poses = [], []
    for mesh, camera_from_object in objects:
        scale = np.asarray(camera_from_object.scale, np.float64).reshape(-1)
        if np.ptp(scale) > 1e-6 * scale[0]:
            raise ValueError("a mesh keeps its size from frame to frame")
        meshes.append(dataclasses.replace(mesh, vertices=mesh.vertices * scale[0]))
        rotation = np.asarray(camera_from_object.rotation, np.float64)
        translation = np.asarray(camera_from_object.translation, np.float64)
        poses.append(np.concatenate([rotation, translation[..., None]], axis=-1))
    count = len(poses[0])
    job = Job(meshes, np.stack(poses, axis=1), np.ones(count), camera, height, width, oversample, light, True)
    return _draw(job, backend, progress)


def render_each(
    meshes: Sequence[Mesh],
    which: Sequence[int],
    camera_from_object: Similarity,
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
) -> Renders:
    """Images of several meshes, one in each: image i shows ``meshes[which[i]]`` alone, at pose i; all of them drawn by
    one child process, because starting one takes longer than drawing twenty images.

    Poses [v] and camera as in `render`, scales of 1. Raises as `render` does.
    """
    rotation, translation = (
        np.asarray(x, np.float64) for x in (camera_from_object.rotation, camera_from_object.translation)
    )
    # The meshes that an image does not show shrink to the point where the one that it shows has its origin; the child
    # leaves them out.
    poses = np.zeros((len(which), len(meshes), 3, 4))
    poses[..., 3] = translation[:, None]
    poses[np.arange(len(which)), np.asarray(which), :, :3] = rotation
    job = Job(list(meshes), poses, np.ones(len(which)), camera, height, width, 1, None, False)
    return _draw(job, backend, None)


def available_backends() -> dict[str, str]:
    """Whether each backend of this system can draw a triangle: "ok", or the reason why not."""
    import jax.numpy as jnp

    from ipjax.files.meshes.mesh import make_mesh

    triangle = make_mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    pose = np.concatenate([np.eye(3), [[0.0], [0.0], [2.0]]], axis=-1)[None, None]
    camera = Camera(focal=jnp.full(2, 8.0, jnp.float32), centre=jnp.full(2, 3.5, jnp.float32))
    job = Job([triangle], pose, np.ones(1), camera, 8, 8, 1, None, False)
    report = {}
    for name in [*gl_backends(), "raster"]:
        try:
            drawn = draw_raster(job, None) if name == "raster" else run_child(job, name, None)
            report[name] = "ok" if drawn.mask.any() else "drew nothing"
        except RenderError as error:
            report[name] = str(error)
    return report


def _draw(job: Job, backend: str, progress: Callable[[int, int], None] | None) -> Renders:
    if backend == "raster":
        return draw_raster(job, progress)
    if backend != "auto":
        if backend not in BACKENDS:
            raise ValueError(f"unknown rendering backend {backend!r}: one of auto, {', '.join(BACKENDS)}")
        return draw_mujoco(job, backend, progress)
    reasons = []
    for name in gl_backends():
        if (reason := recent_failure(name)) is not None:
            reasons.append(reason)
            continue
        try:
            return draw_mujoco(job, name, progress)
        except MeshRefusedError as error:
            log.warning("%s; rendering with the z-buffer rasteriser", error)
            return draw_raster(job, progress)
        except RenderError as error:
            reasons.append(str(error))
    log.warning("no GL library works, rendering with the z-buffer rasteriser: %s", "; ".join(reasons))
    return draw_raster(job, progress)
