"""From a mesh to templates: render the object from all directions, describe every view, lift every patch."""

import dataclasses
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ipjax.config import DescribeConfig, OnboardConfig
from ipjax.estimation.features import centre, centre_on, check_cut, cut, describe, identity_of, principal_basis
from ipjax.files.meshes.cleaning import clean
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import Mesh, normalise
from ipjax.files.meshes.sampling import sample_appearance, sample_surface
from ipjax.files.meshes.textures import sample_texture
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.objects.saving import save
from ipjax.files.weights.encoder import load_encoder
from ipjax.files.weights.hashes import hash_file
from ipjax.onboarding.photo_views import ROLLS, PhotoSource, ReferencePhoto, photo_poses, put_photo
from ipjax.onboarding.viewpoints import viewpoints
from ipjax.progress import bar
from ipjax.records import UNNAMED, Appearance, Camera, Patches, ReferenceView, Similarity, Surface, Templates, View
from ipjax.rendering.render import render

_CORNERS = 3000  # of a convex hull, among which its smallest box is sought


def framing_cameras(
    vertices: Float[np.ndarray, "n 3"], camera_from_object: Similarity, resolution: int, fill: float
) -> Camera:
    """For each pose the square camera in whose image the object's box takes ``fill`` of the longer side.

    Queries are cropped around their mask in the same way, so that an object seen end-on is as large in its template
    as in the query's crop.
    """
    poses = camera_from_object.to_numpy()
    count = len(poses.scale)
    low, high = np.empty((count, 2)), np.empty((count, 2))
    for view in range(count):  # one at a time: all placed vertices would take much memory
        placed = Similarity(poses.rotation[view], poses.translation[view], np.asarray(poses.scale[view])) @ vertices
        rays = placed[:, :2] / placed[:, 2:]
        low[view], high[view] = rays.min(0), rays.max(0)
    side = np.maximum((high - low).max(axis=1), 1e-6) / fill
    focal = resolution / side
    centre = (resolution - 1) / 2 - focal[:, None] * (low + high) / 2
    return Camera(
        focal=jnp.asarray(np.repeat(focal[:, None], 2, axis=1), jnp.float32), centre=jnp.asarray(centre, jnp.float32)
    )


def box_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """The axes (rows, a rotation) of the smallest box around the points: what a box or a can turns or flips about.

    Raises ValueError where all points lie on a line (within a thousandth of its length), which has no such box.
    """
    import trimesh
    from scipy.spatial import ConvexHull, QhullError

    spread = points - points.mean(0)
    directions = np.linalg.eigh(spread.T @ spread)[1]
    length, width = np.sort(np.ptp(spread @ directions, axis=0))[:0:-1]
    if width < 1e-3 * length:
        raise ValueError("all vertices of the mesh lie on a line: it has no shape that could be found in an image")
    # To a ten-thousandth: the search is discontinuous, and its last digits would otherwise decide between equal boxes.
    points = np.round(points, 4)
    try:
        corners = ConvexHull(points).vertices
    except QhullError:  # flat
        corners = np.arange(len(points))
    if len(corners) > _CORNERS:
        # On a smooth surface every vertex is a corner of the hull, and the search tries all of them in all directions.
        points = points[corners]
        index = np.arange(_CORNERS)
        height, angle = 1 - (2 * index + 1) / _CORNERS, np.pi * (1 + 5**0.5) * index
        around = np.sqrt(1 - height**2)
        sphere = np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)
        points = points[np.unique([int((points @ direction).argmax()) for direction in sphere])]
    box_from_points, _ = trimesh.bounds.oriented_bounds(points)
    axes = box_from_points[:3, :3]
    return axes * np.sign(np.linalg.det(axes))


def make_appearance(mesh: Mesh, count: int) -> Appearance:
    """``count`` coloured points of a normalised mesh, from which candidates are drawn; always the same ones."""
    points, normals, colours = sample_appearance(mesh, count)
    return Appearance(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(normals, jnp.float32),
        jnp.asarray(colours.astype(np.float32) / 255),
    )


def make_templates(
    mesh: Mesh,
    encoder: Callable[..., Any],
    config: OnboardConfig = OnboardConfig(),
    *,
    photo: PhotoSource | None = None,
    progress: bool = True,
    backend: str = "auto",
) -> tuple[Templates, UInt8[np.ndarray, "v h w 3"]]:
    """Render and describe a normalised mesh.

    Args:
      photo: the one without depth that the mesh was made from. The templates are then its views, whatever
        ``config.directions`` and ``config.rolls``: what it did not show, nobody knows.

    Returns:
      The templates, and their images ``[v resolution resolution 3]`` uint8 for pictures.

    Raises:
      ValueError: more ``config.channels`` than the encoder's features have, said before anything takes time; or a photo
        none of whose patches is object enough.
    """
    if config.channels:
        image = jax.ShapeDtypeStruct((config.resolution, config.resolution, 3), jnp.float32)
        check_cut(jax.eval_shape(encoder, image).shape[-1], config.channels)
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    axes = box_axes(mesh.vertices[used])  # first: it refuses what has no shape
    if photo is None:
        poses = viewpoints(config.directions, config.rolls, distance=config.distance)
    else:
        poses = photo_poses(photo).to_jax()
    cameras = framing_cameras(mesh.vertices, poses, config.resolution, config.fill)
    views = render(mesh, poses, cameras, config.resolution, config.resolution, backend=backend, progress=progress)
    views = dataclasses.replace(views, camera=jax.tree.map(np.asarray, cameras))
    if photo is not None:
        views = put_photo(views, photo, poses.to_numpy())
    surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(mesh, config.surface, seed=0)))
    poses_on_host = jax.tree.map(np.asarray, poses)  # slicing a JAX array by a Python number compiles once per number

    def describe_view(index: int) -> tuple[Patches, Array]:
        pose = jax.tree.map(lambda x: x[index], poses_on_host)
        camera = Camera(jnp.asarray(views.camera.focal[index]), jnp.asarray(views.camera.centre[index]))
        rgb = views.rgb[index].astype(np.float32) / 255
        view = View(jnp.asarray(rgb), jnp.asarray(views.depth[index]), jnp.asarray(views.mask[index]), camera)
        return jax.block_until_ready(describe_compiled(encoder, view, pose, surface, config.describe))

    describe_compiled, workers = _describe_view, 1
    if jax.default_backend() == "cpu":
        # One view per core is faster than one view on all cores, most of all where cores are shared with others.
        describe_compiled = _describe_view_on_one_core
        workers = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    patches, seen = [], []
    with ThreadPoolExecutor(workers) as pool:
        try:
            found = pool.map(describe_view, range(len(poses.scale)))
            for one, seen_share in bar(
                found, desc="describing", total=len(poses.scale), unit="view", disable=not progress
            ):
                patches.append(one)
                seen.append(seen_share)
        except BaseException:  # Ctrl-C too: views that have not begun are not needed
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    raw = jax.tree.map(lambda *x: jnp.stack(x), *patches)
    if photo is not None and not bool(jnp.any(raw.valid[0])):
        raise ValueError(
            f"the object is too thin: in the photo, reduced to {config.resolution} pixels around it, it fills "
            f"{config.describe.cover:.0%} of no patch"
        )
    patches, mean, norm = jax.jit(centre)(raw)
    if photo is not None:
        # The mean of the photo itself: the drawings from beside show its colours, not all of what an encoder sees.
        mean = jax.jit(centre)(jax.tree.map(lambda x: x[:ROLLS], raw))[1]
        features, norm = centre_on(raw.features.astype(mean.dtype), mean)
        patches = dataclasses.replace(patches, features=features.astype(raw.features.dtype))
    basis = None
    if config.channels:
        basis = jnp.asarray(principal_basis(patches, config.channels))
        features, kept = jax.jit(cut)(patches.features, basis)
        patches = dataclasses.replace(patches, features=features.astype(patches.features.dtype))
        norm = norm * kept
    first = lambda tree: jax.tree.map(lambda x: x[0], tree)
    templates = Templates(
        patches=patches,
        basis=basis,
        mean=mean,
        norm=norm,
        seen=jnp.stack(seen),
        camera_from_object=poses,
        camera=cameras,
        surface=surface,
        extents=jnp.asarray(np.ptp(mesh.vertices, axis=0), jnp.float32),
        axes=jnp.asarray(axes, jnp.float32),
        appearance=make_appearance(mesh, config.appearance) if config.appearance else None,
        reference=None
        if photo is None
        else ReferenceView(
            view=View(
                rgb=jnp.asarray(views.rgb[0].astype(np.float32) / 255),
                depth=jnp.asarray(views.depth[0]),
                mask=jnp.asarray(views.mask[0]),
                camera=first(cameras),
            ),
            patches=first(patches),
            camera_from_object=first(poses),
        ),
    )
    return templates, views.rgb


def _describe(
    encoder: Callable[..., Any], view: View, camera_from_object: Similarity, surface: Surface, config: DescribeConfig
) -> tuple[Patches, Float[Array, "p"]]:
    """The patches of one template in the object's frame, and the share of the surface under each that was seen."""
    patches = describe(encoder, view, config)
    # x_object = Rᵀ (x_camera − t): the rotation is orthonormal and a template's scale is 1.
    offset = patches.points - camera_from_object.translation
    points = jnp.sum(offset[:, :, None] * camera_from_object.rotation[None], axis=1)
    squared = jnp.sum((points[:, None] - surface.points[None]) ** 2, axis=-1)
    seen = surface.seen[jnp.argmin(squared, axis=1)]
    return dataclasses.replace(patches, features=patches.features.astype(jnp.float16), points=points), seen


_describe_view_on_one_core = jax.jit(_describe, compiler_options={"xla_cpu_multi_thread_eigen": False})
_describe_view = jax.jit(_describe)


def onboard(
    source: str | Path | Mesh,
    encoder: Callable[..., Any] | None = None,
    config: OnboardConfig = OnboardConfig(),
    *,
    out: str | Path | None = None,
    name: str | None = None,
    metres_per_unit: float | None = None,
    reference: ReferencePhoto | None = None,
    progress: bool = True,
    backend: str = "auto",
) -> tuple[Templates, ObjectInfo]:
    """Onboard an object: make the templates that `ipjax.estimate` matches, from a mesh.

    Args:
      source: a mesh file (OBJ, PLY, GLB, glTF, STL) or a ``Mesh``.
      encoder: default: the best weights on this machine (``load_encoder()``); or one of your own, as ``describe``
        takes it: a pytree, with an ``identity`` if it is to be told from others.
      out: also write the object file.
      name: default: the file's.
      metres_per_unit: the mesh file's unit, where it is known; then the object's size is, too.
      reference: the photo without depth that the mesh was made from: poses are found through it.
      backend: the renderer: ``auto``, ``egl``, ``osmesa``, ``native`` or ``raster``.

    Raises:
      ValueError: what is not a mesh, or weights that are not there; in words.
    """
    encoder = load_encoder() if encoder is None else encoder
    path = None if isinstance(source, Mesh) else Path(source)
    mesh = source if isinstance(source, Mesh) else load_mesh(source)
    mesh, repairs = clean(mesh)
    mesh = normalise(mesh)
    photo = None if reference is None else reference.of_normalised(mesh)
    templates, pictures = make_templates(mesh, encoder, config, photo=photo, progress=progress, backend=backend)
    textured = None if mesh.texture is None or mesh.uv is None else (mesh.texture, mesh.uv)
    info = ObjectInfo(
        name=name or (path.stem if path else "object"),
        encoder=identity_of(encoder) or UNNAMED,
        mesh_scale=mesh.scale,
        mesh_centre=mesh.centre,
        mesh_file=path.name if path else "",
        mesh_sha256=hash_file(path) if path else "",
        metres_per_unit=metres_per_unit,
        config=dataclasses.asdict(config),
        notes=(*mesh.notes, *repairs),
        resolution=config.resolution,
        vertices=mesh.vertices,
        faces=mesh.faces,
        colours=mesh.colours if textured is None else sample_texture(*textured),
        pictures=pictures,
    )
    if out is not None:
        save(out, templates, info)
    return templates, info
