"""A part of a mesh file: triangles that share a texture or a kind of colour."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int, UInt8

from ipjax.files.meshes.textures import Texture

GREY = 160  # of what has no colour


@dataclasses.dataclass
class Part:
    """Triangles of a file that share an appearance: a texture, colours per vertex, or no colour."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colours: UInt8[np.ndarray, "n 3"] | None = None
    uv: Float[np.ndarray, "n 2"] | None = None  # v = 0 is the bottom row of the image
    texture: Texture | None = None
    shade: Float[np.ndarray, "n 3"] | None = None  # linear light that the texture is multiplied by


def drop_unused(part: Part) -> Part:
    """The part without vertices that no face names."""
    used, faces = np.unique(part.faces, return_inverse=True)
    if len(used) == len(part.vertices):
        return part
    return dataclasses.replace(
        part,
        vertices=part.vertices[used],
        faces=faces.reshape(-1, 3),
        **{name: None if (x := getattr(part, name)) is None else x[used] for name in ("colours", "uv", "shade")},
    )


def split_corners(part: Part) -> Part:
    """The part with three vertices of its own for every face."""
    index = part.faces.ravel()
    return dataclasses.replace(
        part,
        vertices=part.vertices[index],
        faces=np.arange(len(index)).reshape(-1, 3),
        **{name: None if (x := getattr(part, name)) is None else x[index] for name in ("colours", "uv", "shade")},
    )
