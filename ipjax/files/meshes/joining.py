"""One mesh of all parts of a file; textures are packed into one image where there are several."""

import dataclasses

import numpy as np

from ipjax.files.meshes.formats.part import Part
from ipjax.files.meshes.formats.source import Source
from ipjax.files.meshes.packing import get_colours, pack
from ipjax.files.meshes.textures import Texture, TextureError, from_linear


@dataclasses.dataclass
class Joined:
    """Arrays for `ipjax.files.meshes.mesh.make_mesh`, and where the colours come from, in words."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None
    uv: np.ndarray | None
    texture: np.ndarray | None
    note: str


def join(parts: list[Part], source: Source) -> Joined:
    """One mesh of all parts; textures are packed into one image where there are several.

    An image that cannot be decoded is left out with a warning. Raises ValueError where the mesh is too large.
    """
    parts = [_tint_if_uniform(part) for part in parts]
    images: dict[Texture, np.ndarray | None] = {}
    while True:
        try:
            if any(part.texture is not None for part in parts):
                uv, pixels, note, parts = pack(parts, images)
                break
        except TextureError as error:
            source.warn(f"{error}: shown without that texture")
            broken = {texture for texture, image in images.items() if image is None}
            parts = [
                dataclasses.replace(part, texture=None, uv=None, colours=_colours_without_texture(part))
                if part.texture in broken
                else part
                for part in parts
            ]
            images = {}
            continue
        uv = pixels = None
        coloured = any(part.colours is not None for part in parts)
        note = "vertex colours" if coloured else "no colour: shown in plain grey"
        break
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
    colours = None if pixels is not None else np.concatenate([get_colours(part) for part in parts])
    return Joined(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
        colours,
        uv,
        pixels,
        note,
    )


def _colours_without_texture(part: Part) -> np.ndarray | None:
    return part.colours if part.shade is None else from_linear(part.shade)


def _tint_if_uniform(part: Part) -> Part:
    """The part with its shade as a tint of its texture, where the shade is the same everywhere."""
    if part.shade is None or part.texture is None or np.ptp(part.shade, axis=0).max() > 2e-3:
        return part
    tint = np.asarray(part.texture.tint) * part.shade.mean(0)
    if np.abs(part.shade - 1).max() < 2e-3:
        return dataclasses.replace(part, shade=None)
    texture = dataclasses.replace(part.texture, tint=(float(tint[0]), float(tint[1]), float(tint[2])))
    return dataclasses.replace(part, texture=texture, shade=None)
