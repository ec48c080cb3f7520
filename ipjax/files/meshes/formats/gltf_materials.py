"""Materials of glTF files: base colours and their images, emission added (specification, section 3.9)."""

import dataclasses
import math
from typing import Any

import numpy as np

from ipjax.files.meshes.formats.gltf_document import Document, as_key
from ipjax.files.meshes.textures import Texture

Affine = tuple[tuple[float, float, float], tuple[float, float, float]]  # u and v of (u, v, 1)
WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


@dataclasses.dataclass(frozen=True)
class Material:
    """A material's base colour in linear light, its image, and which texture coordinates the image takes."""

    light: tuple[float, float, float] = (1.0, 1.0, 1.0)
    texture: Texture | None = None
    channel: int = 0
    uv_transform: Affine = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    is_default: bool = False  # the file names no material


class Materials:
    """The materials of one file, each read once."""

    def __init__(self, document: Document):
        self.document = document
        self.textures: dict[Any, Texture | None] = {}
        self.materials: dict[int, Material] = {}

    def find(self, index: Any) -> Material:
        """The material of an index, read once; the default one where a primitive names none."""
        if index is None:
            return Material(is_default=True)
        entry = self.document.item("materials", index)
        if index not in self.materials:
            self.materials[index] = self._read(entry)
        return self.materials[index]

    def _read(self, entry: dict) -> Material:
        """Base colour and emission (3.9)."""
        base = entry.get("pbrMetallicRoughness")
        base = base if isinstance(base, dict) else {}
        glossy = self.document.extension(entry, "KHR_materials_pbrSpecularGlossiness")
        if glossy is not None:
            factor, picture = self.document.floats(glossy, "diffuseFactor", [1, 1, 1, 1]), glossy.get("diffuseTexture")
        else:
            factor, picture = self.document.floats(base, "baseColorFactor", [1, 1, 1, 1]), base.get("baseColorTexture")
        light = np.clip(factor[:3], 0, 1)
        texture, channel, uv_transform = self._read_texture(picture)
        if texture is not None:
            texture = dataclasses.replace(texture, tint=triple(light))
        emission = self.document.floats(entry, "emissiveFactor", [0, 0, 0])
        strength = self.document.extension(entry, "KHR_materials_emissive_strength")
        if strength is not None:
            emission = emission * self.document.floats({"s": [strength.get("emissiveStrength", 1)]}, "s", [1])
        if not emission.any():
            return Material(triple(light), texture, channel, uv_transform)
        image, emission_channel, emission_transform = self._read_texture(entry.get("emissiveTexture"))
        emission = np.clip(emission, 0, 1e3)
        if image is None:
            if texture is not None:
                texture = dataclasses.replace(texture, offset=triple(emission))
            return Material(triple(np.clip(light + emission, 0, 1)), texture, channel, uv_transform)
        image = dataclasses.replace(image, tint=triple(emission))
        if texture is None:
            image = dataclasses.replace(image, offset=triple(light))
            return Material(triple(light), image, emission_channel, emission_transform)
        if (channel, uv_transform) == (emission_channel, emission_transform):
            return Material(triple(light), dataclasses.replace(texture, plus=image), channel, uv_transform)
        if not light.any():
            return Material(triple(light), image, emission_channel, emission_transform)
        self.document.source.warn("a part shines by an image with coordinates of its own: shown without that")
        return Material(triple(light), texture, channel, uv_transform)

    def _read_texture(self, info: Any) -> tuple[Texture | None, int, tuple]:
        """The image of a texture reference, its coordinates' number, and how they are moved."""
        uv_transform = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        if not isinstance(info, dict):
            return None, 0, uv_transform
        channel = self.document.number(info, "texCoord", 0, 64)
        moved = self.document.extension(info, "KHR_texture_transform")
        if moved is not None:
            channel = self.document.number(moved, "texCoord", channel, 64)
            offset, scale = self.document.floats(moved, "offset", [0, 0]), self.document.floats(moved, "scale", [1, 1])
            angle = float(self.document.floats({"a": [moved.get("rotation", 0)]}, "a", [0])[0])
            c, s = math.cos(angle), math.sin(angle)
            uv_transform = (
                (c * scale[0], s * scale[1], offset[0]),
                (-s * scale[0], c * scale[1], offset[1]),
            )
            uv_transform = tuple(tuple(float(x) for x in row) for row in uv_transform)
        entry = self.document.item("textures", info.get("index"))
        webp = self.document.extension(entry, "EXT_texture_webp")
        source = (webp or {}).get("source", entry.get("source"))
        if source is None:
            names = ", ".join(entry.get("extensions", {})) if isinstance(entry.get("extensions"), dict) else ""
            self.document.source.warn(f"a texture is only there in a form that is not read here ({names[:80]})")
            return None, channel, uv_transform
        texture = self._read_image(source)
        sampler = self.document.item("samplers", entry["sampler"]) if entry.get("sampler") is not None else {}
        wrap = tuple(WRAPS.get(as_key(sampler.get(name, 10497)), "repeat") for name in ("wrapS", "wrapT"))
        if texture is not None and wrap != ("repeat", "repeat"):
            texture = dataclasses.replace(texture, wrap=(wrap[0], wrap[1]))
        return texture, channel, uv_transform

    def _read_image(self, index: Any) -> Texture | None:
        entry = self.document.item("images", index)
        if index not in self.textures:
            name = str(entry.get("name") or f"image {index}")[:80]
            uri = entry.get("uri")
            if entry.get("bufferView") is not None:
                data, offset, length, _ = self.document.view(entry["bufferView"])
                self.document.source.take(length, f"the image {name}")
                self.textures[index] = self.document.source.open_texture(name, data[offset : offset + length])
            elif isinstance(uri, str) and uri[:5].lower() == "data:":
                self.textures[index] = self.document.source.open_texture(name, self.document.resource(uri))
            else:
                self.textures[index] = self.document.source.open_texture(str(uri), quoted=True)
        return self.textures[index]


def triple(values: np.ndarray) -> tuple[float, float, float]:
    """Three Python floats."""
    return float(values[0]), float(values[1]), float(values[2])
