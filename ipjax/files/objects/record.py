"""What is known about an onboarded object besides its templates, and the photo that it was made from."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from ipjax.files.objects.pictures import decode_picture
from ipjax.records import Similarity

GUESS_DEVIATION = 0.35  # relative standard deviation of a guessed focal length: from a phone's 0.7 sides to a tele's 2


@dataclasses.dataclass(frozen=True)
class Reference:
    """The photo that an object was made from, and where its camera stood.

    Args:
        file, sha256: of the photo; no folders.
        rotation, translation, scale: ``camera_from_mesh``, x_camera = scale * rotation @ x_mesh + translation; metres
            where `metric`, else in the arbitrary unit of the reconstruction.
        focal, centre, size: of the photo's camera, given or assumed; pixels of the photo as it was read.
        camera_source: where the camera is from: "given" by the user, told by "exif", or "guessed".
        focal_deviation: relative standard deviation of the focal length; 0 where it was given.
        metric: the photo had depth, so the mesh is in metres and its size was measured.
        method: how the mesh was made: a name in `METHODS` of the reconstruction, such as "inflate".
        seen: share of the surface that the photo shows; the rest is guessed.
        picture: a small JPEG of the photo; None = not kept.
    """

    file: str
    sha256: str
    rotation: np.ndarray  # 3 × 3
    translation: np.ndarray
    scale: float
    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int]  # width, height
    camera_source: str
    metric: bool
    method: str
    seen: float
    picture: bytes | None = None
    focal_deviation: float = 0.0

    @property
    def camera_given(self) -> bool:
        """The user gave the camera."""
        return self.camera_source == "given"

    def describe_camera(self) -> str:
        """The focal length, how far it may be off, and where it is from, in words."""
        sources = {"given": "given", "exif": "as the photo's EXIF tells", "guessed": "guessed"}
        off = f" ± {self.focal_deviation:.0%}" if self.focal_deviation else ""
        return f"focal length {self.focal[0]:.0f} px{off}, {sources.get(self.camera_source, self.camera_source)}"

    def camera_as_json(self) -> dict[str, Any]:
        """What `describe_camera` tells, for programs."""
        return {"source": self.camera_source, "focal_px": self.focal[0], "focal_deviation": self.focal_deviation}

    @property
    def camera_from_mesh(self) -> Similarity:
        """The photo's camera from the coordinates of the reconstructed mesh."""
        values = (self.rotation, self.translation, self.scale)
        return Similarity(*(jnp.asarray(x, jnp.float32) for x in values))

    def as_json(self) -> dict[str, Any]:
        """As the header holds it: without the picture."""
        entry = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "picture"}
        return (
            entry
            | {"rotation": np.asarray(self.rotation, float).tolist()}
            | {"translation": np.asarray(self.translation, float).tolist()}
            | {"camera_given": self.camera_given}  # for readers that know no other sources
        )

    @staticmethod
    def from_json(entry: dict[str, Any], picture: bytes | None = None) -> "Reference":
        """The inverse of `as_json`. Raises KeyError, TypeError or ValueError for anything else."""
        rotation = np.asarray(entry["rotation"], np.float64).reshape(3, 3)
        translation = np.asarray(entry["translation"], np.float64).reshape(3)
        scale, numbers = float(entry["scale"]), [float(x) for x in (*entry["focal"], *entry["centre"])]
        if not (np.isfinite([*rotation.ravel(), *translation, scale, *numbers]).all() and scale > 0):
            raise ValueError("the reference camera is not finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise ValueError("the reference camera's pose is no rotation")
        # Files of before told only whether the camera was given; how far it is off, they did not say.
        given = bool(entry["camera_given"])
        deviation = float(entry.get("focal_deviation", 0.0 if given else GUESS_DEVIATION))
        if not (np.isfinite(deviation) and deviation >= 0):
            raise ValueError("the deviation of the reference's focal length is not a positive number")
        return Reference(
            file=str(entry["file"]),
            sha256=str(entry["sha256"]),
            rotation=rotation,
            translation=translation,
            scale=scale,
            focal=(numbers[0], numbers[1]),
            centre=(numbers[2], numbers[3]),
            size=(int(entry["size"][0]), int(entry["size"][1])),
            camera_source=str(entry.get("camera_source", "given" if given else "guessed")),
            focal_deviation=deviation,
            metric=bool(entry["metric"]),
            method=str(entry["method"]),
            seen=float(entry["seen"]),
            picture=picture,
        )


@dataclasses.dataclass(frozen=True)
class ObjectInfo:
    """What is known about an onboarded object besides its templates.

    Args:
        name: of the object.
        encoder: `Encoder.identity` of the encoder that described the templates.
        mesh_scale: model units per unit of the mesh file (1 / the diameter there).
        mesh_centre: the object frame's origin in the mesh file's frame, in its units.
        mesh_file: name of the mesh file, without folders.
        mesh_sha256: of the mesh file.
        metres_per_unit: of the mesh file, as the user gave it; None = unknown.
        config: how it was onboarded, as plain JSON.
        notes: what was found and repaired while the mesh was read, a sentence each.
        resolution: side of the template images in pixels.
        vertices, faces, colours: the normalised mesh, for pictures; None = not kept.
        pictures: the template images ``[v h w 3]`` uint8, or the JPEG bytes of each; None = not kept.
        reference: the photo it was made from; None = made from a mesh.
        content_sha256: of the object file it was read from, according to its header; `check` compares.
    """

    name: str
    encoder: str
    mesh_scale: float = 1.0
    mesh_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mesh_file: str = ""
    mesh_sha256: str = ""
    metres_per_unit: float | None = None
    config: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    resolution: int = 224
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    colours: np.ndarray | None = None
    pictures: Any = None
    reference: Reference | None = None
    content_sha256: str = ""

    @property
    def measured_diameter(self) -> float | None:
        """The object's diameter in metres, where its reference photo had depth; None = free."""
        if self.reference is None or not self.reference.metric or self.metres_per_unit is None:
            return None
        return self.metres_per_unit / self.mesh_scale

    @property
    def object_from_mesh(self) -> Similarity:
        """Model units from the coordinates of the user's mesh file."""
        scale = jnp.asarray(self.mesh_scale, jnp.float32)
        return Similarity(
            rotation=jnp.eye(3, dtype=jnp.float32),
            translation=jnp.asarray(-self.mesh_scale * np.asarray(self.mesh_centre, np.float64), jnp.float32),
            scale=scale,
        )

    def picture(self, view: int) -> np.ndarray | None:
        """The image of one template, uint8 ``[h w 3]``; None where none was kept."""
        if self.pictures is None:
            return None
        if isinstance(self.pictures, np.ndarray):
            return self.pictures[view]
        return decode_picture(self.pictures[view])
