"""A rendering job, checked, and the images that it results in."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ipjax.files.meshes.mesh import Mesh
from ipjax.records import Camera, View


class RenderError(RuntimeError):
    """A backend could not draw; the message names it and what to install."""


@dataclasses.dataclass(frozen=True)
class Renders:
    """Rendered views on the host: NumPy arrays, colours as bytes; `renders[i]` is view i as a `View`."""

    rgb: UInt8[np.ndarray, "v h w 3"]  # 0 where nothing is
    depth: Float[np.ndarray, "v h w"]  # along z, units of the poses; 0 = nothing
    camera: Camera  # focal and centre [v 2]
    backend: str  # egl, osmesa, native or raster
    ids: Int[np.ndarray, "v h w"] | None = None  # which mesh, −1 = none; only for scenes

    @property
    def mask(self) -> Bool[np.ndarray, "v h w"]:
        """Where something is."""
        return self.depth > 0

    def __len__(self) -> int:
        return len(self.depth)

    def __getitem__(self, index: int) -> View:
        """View `index` (no batch axis) as the record that `describe` takes: float32 colours in [0, 1]."""
        import jax.numpy as jnp

        return View(
            rgb=jnp.asarray(self.rgb[index].astype(np.float32) / 255),
            depth=jnp.asarray(self.depth[index]),
            mask=jnp.asarray(self.depth[index] > 0),
            camera=Camera(focal=self.camera.focal[index], centre=self.camera.centre[index]),
        )


@dataclasses.dataclass(frozen=True)
class Job:
    """Meshes, their poses in every frame, and the camera of each; ValueError in words for what cannot be drawn."""

    meshes: list[Mesh]
    poses: np.ndarray  # frame, mesh, 3, 4: rigid
    scales: np.ndarray  # frame: depths are multiplied by it
    camera: Camera  # focal and centre [2], or one per frame
    height: int  # pixels
    width: int
    oversample: int  # samples on a side of a pixel; odd
    # direction [3] in the camera frame, or one per frame [frame 3]; ambient, diffuse; None = unlit
    light: dict | None
    segment: bool  # also render which mesh is at each pixel

    def __post_init__(self):
        if self.height < 1 or self.width < 1:
            raise ValueError(f"an image needs pixels, got {self.height} × {self.width}")
        if max(self.height, self.width) * self.oversample > 16384:
            raise ValueError(f"{self.height} × {self.width}, {self.oversample} samples a side, is more than 16384")
        if self.oversample < 1 or self.oversample % 2 == 0:
            raise ValueError(f"oversample must be odd, so that a sample lies at the pixel's centre; {self.oversample}")
        if not np.isfinite(self.poses).all() or not (np.isfinite(self.scales) & (self.scales > 0)).all():
            raise ValueError("a pose to render is not finite, or its scale is not positive")
        if not (np.isfinite(self.intrinsics).all() and (self.intrinsics[:, :2] > 0).all()):
            raise ValueError("the camera to render with has a focal length that is not positive")

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy of every frame."""
        focal, centre = np.asarray(self.camera.focal, np.float64), np.asarray(self.camera.centre, np.float64)
        return np.broadcast_to(np.concatenate([focal, centre], axis=-1), (len(self.poses), 4))

    @property
    def cameras(self) -> Camera:
        """The camera of every frame, focal and centre [frame 2]."""
        import jax.numpy as jnp

        table = self.intrinsics
        return Camera(focal=jnp.asarray(table[:, :2], jnp.float32), centre=jnp.asarray(table[:, 2:], jnp.float32))

    @property
    def light_directions(self) -> np.ndarray:
        """Unit vectors in the camera frame, [frame 3]: where the light of every frame goes; unlit ones look ahead."""
        given = [0.0, 0.0, 1.0] if self.light is None else self.light["direction"]
        direction = np.broadcast_to(np.asarray(given, np.float64), (len(self.poses), 3))
        return direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    def near_far(self) -> np.ndarray:
        """Clipping distances that hold everything in front of the camera, [frame 2]."""
        low, high = np.full(len(self.poses), np.inf), np.zeros(len(self.poses))
        for i, mesh in enumerate(self.meshes):
            middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
            reach = np.linalg.norm(mesh.vertices - middle, axis=-1).max()
            depth = self.poses[:, i, 2, :3] @ middle + self.poses[:, i, 2, 3]
            low, high = np.minimum(low, depth - reach), np.maximum(high, depth + reach)
        far = np.where(high > 0, high * 1.01, 1.0)
        return np.stack([np.clip(low * 0.99, far * 1e-3, far * 0.999), far], axis=-1)
