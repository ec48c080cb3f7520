"""A photo with depth as the reference view of its object: by it, of several poses, the right one is known."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ipjax.config import OnboardConfig
from ipjax.estimation.features import describe, object_features
from ipjax.files.meshes.cleaning import clean
from ipjax.files.meshes.mesh import Mesh, normalise
from ipjax.onboarding.mesh import framing_cameras
from ipjax.onboarding.photo_views import ReferencePhoto, photo_poses, turn_photo
from ipjax.records import Camera, ReferenceView, Similarity, Templates, View
from ipjax.rendering.render import render


def describe_measured_photo(
    reference: ReferencePhoto,
    mesh: Mesh,
    templates: Templates,
    encoder: Callable[..., Any],
    config: OnboardConfig = OnboardConfig(),
    *,
    backend: str = "auto",
) -> ReferenceView:
    """The photo as its camera sees it when it looks at the object's centre, with the depth of the mesh there.

    The mesh's front is what was measured, without the depth image's outliers and holes.

    Args:
      reference: the photo, and where its camera stood before the mesh was normalised.
      mesh: made from the photo and its depth; the templates' object.
      templates: whose mean and basis the photo's features are relative to.
      backend: the renderer, as `ipjax.onboard` takes it.
    """
    mesh = normalise(clean(mesh)[0])
    photo = reference.of_normalised(mesh)
    poses = jax.tree.map(lambda x: x[:1], photo_poses(photo).to_jax())
    cameras = framing_cameras(mesh.vertices, poses, config.resolution, config.fill)
    side = config.resolution
    depth = np.asarray(render(mesh, poses, cameras, side, side, backend=backend, progress=False).depth[0])
    pose: Similarity = jax.tree.map(lambda x: x[0], poses)
    camera: Camera = jax.tree.map(lambda x: x[0], cameras)
    rgb, mask = turn_photo(photo, pose.to_numpy(), camera.to_matrix(), side)
    depth = np.where(mask, depth, 0).astype(np.float32)
    rgb = np.where(depth[..., None] > 0, rgb, 0).astype(np.float32) / 255
    view = View(jnp.asarray(rgb), jnp.asarray(depth), jnp.asarray(depth > 0), camera)
    patches = jax.jit(describe)(encoder, view, config.describe)
    points = jnp.matmul(patches.points - pose.translation, pose.rotation, precision="highest")
    features = object_features(patches.features, templates).astype(templates.patches.features.dtype)
    patches = dataclasses.replace(patches, features=features, points=points)
    return ReferenceView(view, patches, pose, measured=True)
