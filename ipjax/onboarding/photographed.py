"""From a mesh that was made from one photo elsewhere, and that photo, to an onboarded object.

Image-to-3D models (SAM 3D, InstantMesh, TripoSR) return a mesh in a frame and size of its own, accurate where the photo
showed the object and invented where it did not. The photo tells which is which.
"""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import KDTree

from ipjax.cameras import project
from ipjax.config import OnboardConfig
from ipjax.files.meshes.cleaning import clean
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import Mesh, normalise
from ipjax.files.objects.deviations import with_deviations
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.objects.saving import save
from ipjax.files.weights.encoder import load_encoder
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.mesh import onboard
from ipjax.onboarding.photo import PreparedPhoto, describe_reference, prepare_photo
from ipjax.onboarding.photo_camera import LocatedPhoto, locate_photo
from ipjax.onboarding.reconstruction.inflation import guess_camera
from ipjax.onboarding.reconstruction.result import Reconstruction
from ipjax.records import Camera, Similarity, Surface, Templates
from ipjax.rendering.render import render

log = logging.getLogger("ipjax")

# Below either, the photo is not of the mesh. Of made and real objects the right photo reached 0.52 to 0.86 and 0.78 to
# 0.95, another object's 0.35 to 0.47 and 0.70 to 0.92 (``python -m benchmarks.reconstructions made``).
LEAST_OVERLAP, LEAST_FIT = 0.49, 0.7
GRAZING = 0.17  # cosine (80°) of the angle between a normal and the photo's ray, below which the photo shows nothing
BEHIND = 0.015  # diameters by which a point may lie behind what is drawn of the mesh and still be seen
_SIDE = 448  # pixels on a side of the image in which that is decided


def onboard_with_photo(
    source: str | Path | Mesh,
    encoder: Callable[..., Any] | None = None,
    config: OnboardConfig = OnboardConfig(),
    *,
    photo: str | Path | Photo,
    mask: Any = None,
    box: Sequence[int | float] | None = None,
    click: Sequence[int | float] | None = None,
    camera: Any = None,
    tried: str | Path | None = None,
    out: str | Path | None = None,
    name: str | None = None,
    metres_per_unit: float | None = None,
    progress: bool = True,
    backend: str = "auto",
) -> tuple[Templates, ObjectInfo]:
    """Onboard a mesh that an image-to-3D model made, with the photo that it was made from.

    The photo's camera is found relative to the mesh; what it saw of the surface counts as seen, and everything else as
    invented: a pose that rests on it is not called sure, and with ``score.invented`` it decides less, too.

    Args:
      source, config, metres_per_unit, name, out, backend: as `onboard`.
      photo: a photo's file, or a `Photo`.
      mask, box, click, camera, tried: of the photo, as `onboard_photo`; without a camera its focal length is guessed.

    Raises:
      ValueError: no usable mesh, photo, mask or weights, or the photo is not of this mesh; one sentence.
    """
    prepared = prepare_photo(photo, mask=mask, box=box, click=click, camera=camera, tried=tried)
    encoder = load_encoder() if encoder is None else encoder
    templates, info = onboard(
        source, encoder, config, name=name, metres_per_unit=metres_per_unit, progress=progress, backend=backend
    )
    mesh = normalise(clean(source if isinstance(source, Mesh) else load_mesh(source))[0])
    path = None if isinstance(photo, Photo) else Path(photo)
    templates, info = add_photo(
        templates, info, mesh, prepared, encoder, path, resolution=config.resolution, fill=config.fill, backend=backend
    )
    if out is not None:
        save(out, templates, info)
    return templates, info


def add_photo(
    templates: Templates,
    info: ObjectInfo,
    mesh: Mesh,
    prepared: PreparedPhoto,
    encoder: Callable[..., Any],
    path: Path | None = None,
    *,
    resolution: int = OnboardConfig().resolution,
    fill: float = OnboardConfig().fill,
    backend: str = "auto",
) -> tuple[Templates, ObjectInfo]:
    """An object that was onboarded from a mesh, with the photo that the mesh was made from.

    Args:
        mesh: normalised; the one that was onboarded.
        prepared: the photo with its mask, and its camera where that is known.
        encoder: made the templates' features.
        path: of the photo, where it has one.
        resolution, fill: as in the `OnboardConfig` of the templates.

    Raises ValueError where the photo is not of this mesh.
    """
    shown = prepared.foreground
    if prepared.camera is None:
        focal, middle = guess_camera(shown.mask)
        matrix = np.array([[focal[0], 0, middle[0]], [0, focal[1], middle[1]], [0, 0, 1.0]])
    else:
        matrix = prepared.camera.to_matrix()
    located = locate_photo(
        templates,
        mesh,
        encoder,
        shown.rgb,
        shown.mask,
        matrix,
        resolution=resolution,
        fill=fill,
        camera_given=prepared.camera is not None,
        backend=backend,
    )
    if located.overlap < LEAST_OVERLAP or located.fit < LEAST_FIT:
        raise ValueError(
            f"{path.name if path else 'the photo'}: the mesh {info.name} was not made from this photo, or its mask is "
            f"not of the object: where the mesh fits best, {located.overlap:.2f} of the features agree (at least "
            f"{LEAST_OVERLAP:g}) and {located.fit:.2f} of the outline (at least {LEAST_FIT:g})"
        )
    templates = mark_seen(templates, mesh, located, shown.mask, backend=backend)
    # From the mesh file's frame, at its size: normalising is undone.
    pose = located.camera_from_object
    shift = pose.translation / mesh.scale - pose.rotation @ np.asarray(mesh.centre, np.float64)
    made = Reconstruction(
        mesh=mesh,
        camera_from_mesh=Similarity(pose.rotation, shift, np.ones(())).to_jax(),
        camera=Camera.from_matrix(located.matrix),
        metric=False,
    )
    share = float(np.asarray(templates.surface.seen).mean())
    note = (
        f"the photo's camera was found relative to the mesh: {located.overlap:.2f} of the features and "
        f"{located.fit:.2f} of the outline agree; the photo saw {share:.0%} of the surface, the rest counts as invented"
    )
    reference = describe_reference(path, prepared, made, "elsewhere", info, templates)
    return templates, dataclasses.replace(info, notes=(*shown.notes, *info.notes, note), reference=reference)


def mark_seen(
    templates: Templates,
    mesh: Mesh,
    located: LocatedPhoto,
    mask: Bool[np.ndarray, "h w"],
    *,
    backend: str = "auto",
) -> Templates:
    """The templates, with what the photo saw as seen, how far each point may be off, and where its camera stood.

    A point was seen if it faces the photo's camera, lies in the mask, and nothing of the mesh is before it.

    Args:
        mesh: normalised.
        mask: of the photo that was located.
    """
    surface, pose = templates.surface, located.camera_from_object
    where, normals = (np.asarray(x, np.float64) for x in (surface.points, surface.normals))
    seen = _is_seen(where, normals, mesh, located, mask, backend)
    points = np.asarray(templates.patches.points)
    nearest = KDTree(np.asarray(surface.points)).query(np.nan_to_num(points))[1]
    share = seen.astype(np.float32)[nearest]
    centre = -pose.rotation.T @ pose.translation
    return dataclasses.replace(
        templates,
        seen=jnp.asarray(share),
        surface=with_deviations(Surface(surface.points, surface.normals, jnp.asarray(seen, jnp.float32)), "elsewhere"),
        photo_centre=jnp.asarray(centre, jnp.float32),
    )


def mark_vertices(mesh: Mesh, templates: Templates) -> Mesh:
    """The normalised mesh whose vertices are as seen as the nearest point of the surface."""
    nearest = KDTree(np.asarray(templates.surface.points)).query(mesh.vertices)[1]
    return dataclasses.replace(mesh, seen=np.asarray(templates.surface.seen, np.float64)[nearest])


def _is_seen(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    mesh: Mesh,
    located: LocatedPhoto,
    mask: Bool[np.ndarray, "h w"],
    backend: str,
) -> Bool[np.ndarray, " n"]:
    pose = located.camera_from_object
    placed = points @ pose.rotation.T + pose.translation
    facing = -((normals @ pose.rotation.T) * placed).sum(axis=1) / np.linalg.norm(placed, axis=1)
    # The photo's own camera, at a resolution that tells the front from the back.
    pixels = project(located.matrix, mesh.vertices @ pose.rotation.T + pose.translation)
    low, high = pixels.min(0), pixels.max(0)
    zoom = (_SIDE - 8) / max(float((high - low).max()), 1e-6)
    lens = np.array([[zoom, 0, 4 - zoom * low[0]], [0, zoom, 4 - zoom * low[1]], [0, 0, 1]]) @ located.matrix
    still = Similarity(pose.rotation, pose.translation, np.ones(())).to_jax()
    depth = render(mesh, still, Camera.from_matrix(lens), _SIDE, _SIDE, backend=backend).depth[0]
    behind = ndimage.maximum_filter(depth, 3)
    column, row = np.clip(np.round(project(lens, placed)), 0, _SIDE - 1).astype(int).T
    shown = placed[:, 2] <= behind[row, column] + BEHIND
    at = np.round(project(located.matrix, placed)).astype(int)
    inside = np.asarray(((at >= 0) & (at < mask.shape[::-1])).all(axis=1))
    at = np.where(inside[:, None], at, 0)
    return (facing > GRAZING) & shown & inside & mask[at[:, 1], at[:, 0]]
