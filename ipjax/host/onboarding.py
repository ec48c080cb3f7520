"""From a mesh to templates: render the object from everywhere, describe every view, lift every patch."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from tqdm import tqdm

from ipjax.config import DescribeConfig, OnboardConfig
from ipjax.dinov2 import Encoder
from ipjax.features import describe
from ipjax.host.meshes import Mesh, sample_surface
from ipjax.host.rendering import render
from ipjax.host.viewpoints import viewpoints
from ipjax.types import Camera, Patches, Similarity, Surface, Templates, View


def framing_cameras(
    vertices: Float[np.ndarray, "n 3"], camera_from_object: Similarity, resolution: int, fill: float
) -> Camera:
    """For each pose the square camera in whose image the object's box takes ``fill`` of the longer side.

    Queries are cropped around their mask in the same way, so that an object seen end-on is as large in its template
    as in the query's crop.
    """
    rotation = np.asarray(camera_from_object.rotation, np.float64)
    translation = np.asarray(camera_from_object.translation, np.float64)
    low, high = np.empty((len(rotation), 2)), np.empty((len(rotation), 2))
    for view in range(len(rotation)):
        placed = vertices @ rotation[view].T + translation[view]
        rays = placed[:, :2] / placed[:, 2:]
        low[view], high[view] = rays.min(0), rays.max(0)
    side = np.maximum((high - low).max(axis=1), 1e-6) / fill
    focal = resolution / side
    centre = (resolution - 1) / 2 - focal[:, None] * (low + high) / 2
    return Camera(
        focal=jnp.asarray(np.repeat(focal[:, None], 2, axis=1), jnp.float32), centre=jnp.asarray(centre, jnp.float32)
    )


def make_templates(
    mesh: Mesh,
    encoder: Encoder,
    config: OnboardConfig = OnboardConfig(),  # noqa: B008
    *,
    progress: bool = True,
    backend: str = "auto",
) -> tuple[Templates, UInt8[np.ndarray, "v h w 3"]]:
    """Render and describe a normalised mesh.

    Returns:
      The templates, and their images ``[v resolution resolution 3]`` uint8 for pictures.
    """
    poses = viewpoints(config.directions, config.rolls, distance=config.distance)
    cameras = framing_cameras(mesh.vertices, poses, config.resolution, config.fill)
    views = render(
        mesh, poses, cameras, config.resolution, config.resolution, backend=backend, progress=progress
    )
    surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(mesh, config.surface, seed=0)))
    patches, seen = [], []
    for index in tqdm(range(len(poses.scale)), "describing", unit="view", disable=not progress):
        view, pose = jax.tree.map(lambda x, index=index: jnp.asarray(x[index]), (views, poses))
        one, sure = _describe_view(encoder, view, pose, surface, config.describe)
        patches.append(one)
        seen.append(sure)
    templates = Templates(
        patches=jax.tree.map(lambda *x: jnp.stack(x), *patches),
        seen=jnp.stack(seen),
        camera_from_object=poses,
        camera=cameras,
        surface=surface,
        extents=jnp.asarray(np.ptp(mesh.vertices, axis=0), jnp.float32),
    )
    return templates, views.rgb


@jax.jit
def _describe_view(
    encoder: Encoder, view: View, camera_from_object: Similarity, surface: Surface, config: DescribeConfig
) -> tuple[Patches, Float[Array, "p"]]:
    """The patches of one template in the object's frame, and how far the surface under each was seen."""
    view = eqx.tree_at(lambda v: v.rgb, view, view.rgb.astype(jnp.float32) / 255)
    patches = describe(encoder, view, config)
    # x_object = Rᵀ (x_camera − t): the rotation is orthonormal and a template's scale is 1.
    offset = patches.points - camera_from_object.translation
    points = jnp.sum(offset[:, :, None] * camera_from_object.rotation[None], axis=1)
    squared = jnp.sum((points[:, None] - surface.points[None]) ** 2, axis=-1)
    seen = surface.seen[jnp.argmin(squared, axis=1)]
    return Patches(patches.features.astype(jnp.float16), points, patches.grid, patches.valid), seen
