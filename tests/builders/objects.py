"""An onboarded object of random numbers, and object files with altered content."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ipjax.files.objects.record import ObjectInfo
from ipjax.records import Camera, Patches, ReferenceView, Similarity, Surface, Templates, View


def make_object(views=5, patches=4, channels=8, points=7, seed=0) -> tuple[Templates, ObjectInfo]:
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    features = rng.normal(size=(views, patches, channels))
    features /= np.linalg.norm(features, axis=-1, keepdims=True)
    rotation = np.linalg.qr(rng.normal(size=(views, 3, 3)))[0]
    rotation *= np.linalg.det(rotation)[:, None, None]
    templates = Templates(
        patches=Patches(
            features=jnp.asarray(features, jnp.float16),
            points=normal(views, patches, 3),
            grid=normal(views, patches, 2),
            valid=jnp.asarray(rng.random((views, patches)) < 0.7).at[0, 0].set(True),
            encoder="dinov2 vits14 block=8",
        ),
        mean=normal(channels),
        norm=normal(views, patches),
        seen=normal(views, patches),
        camera_from_object=Similarity(jnp.asarray(rotation, jnp.float32), normal(views, 3), jnp.ones(views)),
        camera=Camera(focal=normal(views, 2), centre=normal(views, 2)),
        surface=Surface(points=normal(points, 3), normals=normal(points, 3), seen=normal(points)),
        extents=normal(3),
        axes=normal(3, 3),
    )
    info = ObjectInfo(
        name="mug",
        encoder="dinov2 vits14 block=8",
        mesh_scale=4.0,
        mesh_centre=(1.0, -2.0, 0.5),
        mesh_file="mug.glb",
        mesh_sha256="ab" * 32,
        metres_per_unit=0.01,
        config={"directions": 5, "nested": {"cover": 0.3}},
        notes=("two faces were degenerate",),
        resolution=28,
        vertices=np.eye(3, dtype=np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        colours=np.full((3, 3), 7, np.uint8),
        pictures=np.full((views, 28, 28, 3), (200, 100, 50), np.uint8),
    )
    return templates, info


def with_reference(templates: Templates, side=28, seed=0) -> Templates:
    """As if made from a photo without depth of so many pixels a side, which the first template shows."""
    rng = np.random.default_rng(seed)
    mask = rng.random((side, side)) < 0.6
    rgb = rng.integers(0, 256, (side, side, 3)).astype(np.float32) / 255 * mask[..., None]
    depth = np.where(mask, rng.uniform(2, 3, mask.shape), 0)
    first = lambda tree: jax.tree.map(lambda x: x[0], tree)
    camera = Camera(focal=jnp.asarray([40.0, 41.0]), centre=jnp.asarray([side / 2, side / 2 - 1]))
    view = View(jnp.asarray(rgb), jnp.asarray(depth, jnp.float32), jnp.asarray(mask), camera)
    reference = ReferenceView(view, first(templates.patches), first(templates.camera_from_object))
    return dataclasses.replace(templates, reference=reference)


def rewrite(path, change=None, drop=None, metadata=None):
    """Write an object file again with altered tensors or description: well-formed, but not as it was saved."""
    from safetensors import safe_open
    from safetensors.numpy import load_file, save_file

    tensors = load_file(path)
    with safe_open(path, framework="numpy") as opened:
        text = opened.metadata()["ipjax"]
    for name, array in (change or {}).items():
        tensors[name] = array(tensors[name]) if callable(array) else array
    for name in drop or ():
        del tensors[name]
    save_file(tensors, path, metadata={"ipjax": metadata(text) if metadata else text})


def nan(array):
    array = array.copy()
    array.reshape(-1)[0] = np.nan
    return array
