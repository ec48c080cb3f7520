"""Photos of one object alone, with the true pose: what a person takes before there is anything to compare it with."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.cameras import look_at, middle, project
from ipjax.files.meshes.mesh import Mesh
from ipjax.records import Camera, Similarity
from ipjax.rendering.render import render_scene
from ipjax.synthetic.scenes import HEIGHT, WIDTH
from ipjax.synthetic.sensor import STRUCTURED_LIGHT, Sensor, expose
from ipjax.transforms import rotation_from_vector

BACKGROUND = 128  # grey level, neither the darkest nor the brightest that objects have


@dataclasses.dataclass(frozen=True)
class MadePhoto:
    """One RGB photo of an object before a plain background, and the truth about it; there is no depth."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]  # where the object is
    camera: Camera
    camera_from_object: Similarity  # of the mesh as it was given; metres
    angle: float  # degrees between the directions from the object to this camera and to the other

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K, pixels."""
        return self.camera.to_matrix()


def make_photo(
    mesh: Mesh,
    seen: Similarity,
    camera: Camera,
    seed: int = 0,
    *,
    angles: tuple[float, float] = (25.0, 35.0),
    sensor: Sensor = STRUCTURED_LIGHT,
    backend: str = "auto",
) -> MadePhoto:
    """The object alone, lit from near the camera, from another direction than it was seen from.

    Args:
      mesh: of unit diameter.
      seen: ``camera_from_object`` of the other image, metres; its scale is the object's size.
      camera: of both, 640 × 480 pixels.
      seed: draws direction, roll, distance, light and noise.
      angles: the smallest and the largest between the two directions from the object's origin to the camera, degrees.
        Which way the camera went is drawn, and so is a roll of up to 20°.
      sensor: what the camera adds to the colours; `PERFECT` adds nothing.

    Raises:
      ValueError: angles that are not in order within 0 … 180.
      RenderError: nothing can draw, with a given `backend`.
    """
    low, high = angles
    if not 0 <= low <= high <= 180:
        raise ValueError(f"angles between views go from 0 to 180 degrees, the smaller first, got {low} and {high}")
    rng = np.random.default_rng([seed, 23])
    pose, matrix, size = seen.to_numpy(), camera.to_matrix(), float(seen.scale)
    angle, way = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
    # Both cameras look straight at the object while one is turned: only so is the angle the one that was asked for.
    upright = look_at(matrix, project(matrix, pose.translation[None])[0]).T @ pose.rotation
    across = rotation_from_vector(np.deg2rad(angle) * np.array([np.cos(way), np.sin(way), 0.0]))
    roll = rotation_from_vector(np.array([0.0, 0.0, np.deg2rad(rng.uniform(-20, 20))]))
    # Nobody puts an object exactly into the middle.
    aside = look_at(matrix, middle(WIDTH, HEIGHT) + rng.uniform(-40, 40, 2))
    distance = size * rng.uniform(3.0, 4.5)
    placed = Similarity(aside @ roll @ across @ upright, distance * aside[:, 2], np.asarray(size)).to_jax()
    light = {"direction": [*rng.normal(size=2) * 0.5, 1.0], "ambient": 0.6, "diffuse": 0.45}
    drawn = render_scene([(mesh, placed)], camera, HEIGHT, WIDTH, light=light, backend=backend)
    rgb = np.where(drawn.mask[0][..., None], drawn.rgb[0], BACKGROUND).astype(np.uint8)
    return MadePhoto(expose(rng, rgb, sensor), np.asarray(drawn.mask[0]), camera, placed, float(angle))
