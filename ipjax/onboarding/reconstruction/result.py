"""What every method of reconstruction returns."""

import dataclasses
from collections.abc import Callable
from typing import Any

from ipjax.files.meshes.mesh import Mesh
from ipjax.records import Camera, Similarity

Progress = Callable[[str, float], Any]  # stage, share done


@dataclasses.dataclass(frozen=True)
class Reconstruction:
    """A mesh made from one photo, and where the photo's camera stood.

    ``camera_from_mesh`` maps the mesh as it is here; a mesh that is normalised later keeps the
    way back to this frame in `Mesh.to_file`. With ``camera`` it puts the mesh onto the photo, pixel by pixel.
    """

    mesh: Mesh
    camera_from_mesh: Similarity | None  # metres where `metric`, else arbitrary units
    camera: Camera | None  # of the photo, given or assumed; pixels of the photo as it was read
    metric: bool  # mesh units are metres
    report: tuple[str, ...] = ()  # what was done and what was guessed, one sentence each
