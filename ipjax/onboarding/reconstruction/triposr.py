"""Reconstruction by TripoSR: its weights, its mesh of a photo, and the surface of its density field."""

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.files.storage.cache import cache_folder
from ipjax.files.weights.catalogue import Source, WeightsError
from ipjax.files.weights.downloading import download_file
from ipjax.files.weights.finding import is_offline
from ipjax.files.weights.hashes import cached_hash
from ipjax.files.weights.local import Resolved
from ipjax.onboarding.reconstruction.methods import METHODS
from ipjax.onboarding.reconstruction.result import Progress, Reconstruction
from ipjax.records import Camera, Similarity

if TYPE_CHECKING:
    from ipjax.networks.triposr.model import TripoSR
    from ipjax.onboarding.foreground import Foreground

# https://huggingface.co/stabilityai/TripoSR, MIT; the sum is pinned alike by several public installers.
TRIPOSR = Source(
    "triposr",
    "triposr",
    "triposr_5b521936_model.ckpt",
    METHODS["triposr"].licence,
    "429e2c6b22a0923967459de24d67f05962b235f79cde6b032aa7ed2ffcd970ee",
    url="https://huggingface.co/stabilityai/TripoSR/resolve/5b521936b01fbe1890f6f9baed0254ab6351c04a/model.ckpt",
)
_DISTANCE, _FOV = 1.9, 40.0  # of the camera that the model's renderer puts before the object: mesh units, degrees


def resolve_triposr(
    explicit: str | Path | None = None, offline: bool | None = None, *, download: bool = False
) -> Resolved:
    """Find the published checkpoint: explicit path (or IPJAX_TRIPOSR) → cache → download, only when asked for.

    Raises WeightsError in one sentence when there is none, or when it is not the published file.
    """
    explicit = explicit or os.environ.get("IPJAX_TRIPOSR")
    if explicit is not None:
        path = Path(explicit).expanduser()
        if not path.is_file():
            raise WeightsError(f"there is no weights file at {path}")
        found = cached_hash(path)
        return Resolved(path, "explicit", TRIPOSR.name, TRIPOSR.preset, found, found == TRIPOSR.sha256)
    cached = cache_folder("weights") / TRIPOSR.file
    if cached.is_file():
        found = cached_hash(cached)
        if found != TRIPOSR.sha256:
            raise WeightsError(
                f"{cached} is not the published file: its sha256 is {found}, expected {TRIPOSR.sha256}; "
                "remove it and fetch it again"
            )
        return Resolved(cached, "cache", TRIPOSR.name, TRIPOSR.preset, found, True)
    if download and not is_offline(offline):
        try:
            return download_file(TRIPOSR)
        except OSError as error:
            raise WeightsError(f"the weights of TripoSR could not be fetched: {error}") from None
    raise WeightsError(
        f"the weights of TripoSR are not here: download {TRIPOSR.url} (1.7 GB, {TRIPOSR.licence}) and give its path, "
        "or reconstruct without weights (method 'inflate')"
    )


def load_triposr(path: str | Path, *, dtype: str = "float32") -> "TripoSR":
    """The published model of its checkpoint, read without running anything in it.

    ``dtype`` "bfloat16" halves the memory. Raises WeightsError in one sentence when the file is not this model's.
    """
    from ipjax.files.weights.pickles import read_pth
    from ipjax.networks.triposr.config import TripoSRConfig
    from ipjax.networks.triposr.weights import load_model

    try:
        return load_model(TripoSRConfig(dtype=dtype), read_pth(path))
    except ValueError as error:
        raise WeightsError(f"{path}: {error}") from None


def reconstruct_with_triposr(
    model: "TripoSR", foreground: "Foreground", *, resolution: int = 256, progress: Progress | None = None
) -> Reconstruction:
    """TripoSR's mesh of a photo, with vertex colours; its scale is arbitrary, and unseen surface is guessed.

    The camera is the one that the model assumes: it does not take the photo's. Raises ValueError when the field has no
    surface.
    """
    import jax.numpy as jnp
    from flax import nnx

    from ipjax.networks.triposr.model import prepare_image
    from ipjax.onboarding.foreground import composite_grey, crop_foreground

    show = progress or (lambda stage, share: None)
    rgba = np.dstack([foreground.rgb, foreground.alpha])
    square, (x, y) = crop_foreground(rgba)
    photo = jnp.asarray(composite_grey(square).astype(np.float32) / 255)
    show("network", 0.0)
    triplane = nnx.jit(lambda model, image: model(image))(model, prepare_image(photo, model.config.image_size))
    triplane.block_until_ready()
    show("network", 1.0)
    mesh = extract_mesh(model, triplane, resolution=resolution, progress=show)
    size = square.shape[0]
    focal = 0.5 * size / np.tan(np.deg2rad(0.5 * _FOV))
    camera = Camera(
        focal=jnp.full(2, focal, jnp.float32),
        centre=jnp.asarray([x + (size - 1) / 2, y + (size - 1) / 2], jnp.float32),
    )
    pose = Similarity(
        # Mesh: +x to the camera, +y to the image's right, +z up. Camera: x right, y down, z ahead.
        rotation=jnp.asarray([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], jnp.float32),
        translation=jnp.asarray([0, 0, _DISTANCE], jnp.float32),
        scale=jnp.float32(1.0),
    )
    seen = _find_seen(mesh, np.array([_DISTANCE, 0.0, 0.0]))
    report = (
        f"TripoSR made the mesh ({len(mesh.faces):,} faces, resolution {resolution}); its scale is arbitrary",
        "the photo's camera is the one TripoSR assumes (40° field of view, level, 1.9 units away)",
    )
    return Reconstruction(dataclasses.replace(mesh, seen=seen), pose, camera, False, report)


def _find_seen(mesh: Mesh, eye: np.ndarray) -> np.ndarray:
    """1 for vertices that face the eye and that nothing hides (depth buffer of the vertices, 96² bins), else 0."""
    towards = eye - mesh.vertices
    distance = np.linalg.norm(towards, axis=1)
    facing = (mesh.normals * towards).sum(1) > 0
    # The eye looks along −x: (y, z) over the distance along x are the picture's axes.
    picture = mesh.vertices[:, 1:] / np.maximum(eye[0] - mesh.vertices[:, :1], 1e-6)
    low, high = picture.min(0), picture.max(0)
    bins = np.minimum((95 * (picture - low) / np.maximum(high - low, 1e-9)).astype(int), 95)
    number = bins[:, 0] * 96 + bins[:, 1]
    nearest = np.full(96 * 96, np.inf)
    np.minimum.at(nearest, number, distance)
    size = np.ptp(mesh.vertices, axis=0).max()
    return (facing & (distance < nearest[number] + 0.04 * size)).astype(np.float64)


def extract_mesh(
    model: "TripoSR",
    triplane: Any,
    *,
    resolution: int = 256,
    slabs: int = 16,
    chunk: int = 1 << 14,
    progress: Progress | None = None,
) -> Mesh:
    """The surface at the model's threshold, with vertex colours, in the model's frame; ``slabs`` x-slabs at a time.

    scikit-image's marching cubes; outward faces. Raises ValueError when the field nowhere crosses the threshold.
    """
    import jax.numpy as jnp
    from flax import nnx

    from ipjax.networks.triposr.field import density_grid, query

    show = progress or (lambda stage, share: None)
    # The window slides back at the end rather than change its size: one shape, one compilation.
    slabs = min(slabs, resolution)
    grid = np.empty((resolution,) * 3, np.float32)
    run = nnx.jit(lambda model, triplane, start: density_grid(model, triplane, resolution, start=start, count=slabs))
    for start in range(0, resolution, slabs):
        start = min(start, resolution - slabs)
        grid[start : start + slabs] = run(model, triplane, jnp.int32(start))
        show("density", (start + slabs) / resolution)
    vertices, faces = find_surface(grid, model.config.threshold, model.config.radius)
    count = -(-len(vertices) // chunk) * chunk  # whole chunks: one compilation per count of chunks
    padded = np.zeros((count, 3), np.float32)
    padded[: len(vertices)] = vertices
    paint = nnx.jit(lambda model, triplane, points: query(model, triplane, points, chunk=chunk)[1])
    colours = np.concatenate([paint(model, triplane, jnp.asarray(part)) for part in padded.reshape(-1, chunk, 3)])
    show("colour", 1.0)
    return make_mesh(vertices, faces, colours=np.rint(255 * colours[: len(vertices)]).astype(np.uint8))


def find_surface(
    density: Float[np.ndarray, "r r r"], threshold: float, radius: float
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Vertices (mesh units) and outward faces where a density grid over the cube of half side ``radius`` crosses it."""
    from skimage.measure import marching_cubes

    if not density.min() < threshold < density.max():
        raise ValueError(
            "the reconstruction has no surface: the photo, its mask or the weights do not suit the model "
            f"(densities {density.min():.3g} to {density.max():.3g}, threshold {threshold:g})"
        )
    # float32 near 1e4 would round the crossing: subtract first, and cap what lies far inside.
    level = np.clip(density - threshold, None, 1e6)
    vertices, faces, _, _ = marching_cubes(level, 0.0, method="lewiner", gradient_direction="ascent")
    return vertices.astype(np.float64) / (density.shape[0] - 1) * 2 * radius - radius, faces
