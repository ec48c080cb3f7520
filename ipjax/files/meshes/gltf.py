"""glTF 2.0 (.gltf, .glb): every triangle of the scene in the scene's frame, with its base colour.

The file is not trusted: every index, offset and count is checked, and what it asks for is counted, before anything is
allocated. An extension that the file requires and that is not handled here is refused by name. References are to the
Khronos specification, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

import base64
import binascii
import dataclasses
import io
import json
import math
import struct
from collections.abc import Sequence
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int, UInt8

from ipjax.files.meshes.parts import MAX_BYTES, MAX_FACES, Part, Source, drop_unused
from ipjax.files.meshes.textures import Texture, from_linear, to_linear
from ipjax.files.storage.parsing import parse_json

TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
# Extensions that are read, and those that change neither the shape nor the base colour.
HANDLED = {
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_emissive_strength",
    "EXT_texture_webp",
    "EXT_mesh_gpu_instancing",
}
HARMLESS = {
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_dispersion",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_xmp",
    "KHR_xmp_json_ld",
}
MOVES = {"matrix", "translation", "rotation", "scale"}
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


@dataclasses.dataclass(frozen=True)
class Look:
    """A material's base colour: linear light, an image, and which coordinates the image takes."""

    light: tuple[float, float, float] = (1.0, 1.0, 1.0)
    texture: Texture | None = None
    channel: int = 0
    turn: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1, 0, 0), (0, 1, 0))  # of (u, v, 1)
    plain: bool = False  # nothing is said of a colour


def read_gltf(source: Source) -> list[Part]:
    """The parts of the default scene. Raises ValueError in a sentence for what is not valid or not handled."""
    return _Reader(source).read()


def split_glb(data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a GLB file (section 4.4)."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("has no GLB header")
    version, _, length, kind = struct.unpack("<4I", data[4:20])
    if length > len(data) - 20:
        raise ValueError(f"promises {length} bytes of JSON in {len(data)} bytes")
    if kind != 0x4E4F534A:
        raise ValueError(f"has no valid glTF JSON: its first chunk is another (version {version}; version 2 is read)")
    text, rest = data[20 : 20 + length], 20 + length
    while rest + 8 <= len(data):
        length, kind = struct.unpack("<2I", data[rest : rest + 8])
        if kind == 0x004E4942:
            return text, data[rest + 8 : rest + 8 + length]
        rest += 8 + length
    return text, b""


class _Reader:
    def __init__(self, source: Source):
        self.source = source
        data = source.read()
        text, self.chunk = (
            split_glb(data) if data[:4] == b"glTF" or source.path.suffix.lower() == ".glb" else (data, b"")
        )
        try:
            self.tree = parse_json(text)
        except ValueError as error:
            raise ValueError(f"has no valid glTF JSON: {error}") from None
        if not isinstance(self.tree, dict):
            raise ValueError("has no valid glTF JSON: it is no object")
        self.buffers: dict[int, bytes] = {}
        self.textures: dict[Any, Texture | None] = {}
        self.looks: dict[int, Look] = {}
        asset = self.tree.get("asset")
        generator = str(asset.get("generator", "")) if isinstance(asset, dict) else ""
        # trimesh writes the bytes of its colours, which are sRGB, where linear light belongs.
        self.colours_are_srgb = "trimesh" in generator.lower()

    def read(self) -> list[Part]:
        required = self.items("extensionsRequired")
        unknown = [str(name) for name in required if str_key(name) not in HANDLED | HARMLESS]
        if unknown:
            names = ", ".join(unknown[:4])[:200]
            compressed = any(name in COMPRESSED for name in unknown)
            advice = "export it without compression" if compressed else "export it without"
            raise ValueError(f"requires the extension {names}, which is not read here: {advice}")
        self.check_counts()
        placed = self.place_nodes()
        vertices = faces = 0
        shapes: dict[int, list[tuple[dict, int, int]]] = {}
        for mesh, _, _ in placed:
            if mesh not in shapes:
                shapes[mesh] = self.measure(mesh)
            vertices += sum(n for _, n, _ in shapes[mesh])
            faces += sum(m for _, _, m in shapes[mesh])
            if faces > MAX_FACES:
                break
        self.source.take_mesh(vertices, faces)
        parts = []
        read: dict[tuple[int, str], list[Part]] = {}
        for mesh, matrix, node in placed:
            key = mesh, str(node.get("weights"))  # a node may morph its mesh in its own way
            if key not in read:
                read[key] = [drop_unused(self.primitive(item, mesh, node)) for item, _, m in shapes[mesh] if m]
            for part in read[key]:
                moved = part.vertices @ matrix[:3, :3].T + matrix[:3, 3]
                # A mirroring node turns the faces inside out.
                turned = part.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else part.faces
                parts.append(dataclasses.replace(part, vertices=moved, faces=turned))
        return parts

    # --- values of the JSON ---

    def items(self, name: str, tree: Any = None) -> list:
        found = (self.tree if tree is None else tree).get(name, [])
        if not isinstance(found, list):
            raise ValueError(f"has no valid glTF JSON: {name} is no list")
        return found

    def item(self, name: str, index: Any) -> dict:
        """The entry that an index names, which must be there."""
        found = self.items(name)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(found):
            raise ValueError(f"names {name} {str(index)[:40]} of {len(found)}")
        if not isinstance(found[index], dict):
            raise ValueError(f"has no valid glTF JSON: {name} {index} is no object")
        return found[index]

    @staticmethod
    def number(tree: dict, name: str, default: int = 0, most: int = MAX_BYTES) -> int:
        """A whole number that is not negative."""
        value = tree.get(name, default)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            raise ValueError(f"has a {name} of {str(value)[:40]}")
        return value

    @staticmethod
    def floats(tree: dict, name: str, default: list) -> np.ndarray:
        """Finite numbers, as many as the default has."""
        try:
            value = np.array(tree.get(name, default), np.float64)
        except (TypeError, ValueError):
            value = np.empty(0)
        if value.shape != (len(default),) or not np.isfinite(value).all():
            raise ValueError(f"has a {name} that is not {len(default)} finite numbers")
        return value

    @staticmethod
    def extension(tree: dict, name: str) -> dict | None:
        extensions = tree.get("extensions")
        found = extensions.get(name) if isinstance(extensions, dict) else None
        return found if isinstance(found, dict) else None

    def check_counts(self) -> None:
        for index in range(len(self.items("accessors"))):
            count = self.item("accessors", index).get("count", 0)
            if isinstance(count, bool) or not isinstance(count, int | float) or not 0 <= count <= 3 * MAX_FACES:
                raise ValueError(f"has an accessor of {str(count)[:40]} elements; simplify the mesh first")

    # --- bytes ---

    def buffer(self, index: Any) -> bytes:
        entry = self.item("buffers", index)
        if index not in self.buffers:
            length = self.number(entry, "byteLength")
            uri = entry.get("uri")
            if uri is None:
                compressed = [name for name in COMPRESSED if self.extension(entry, name) is not None]
                if compressed:
                    raise ValueError(
                        f"requires the extension {compressed[0]}, which is not read here: export it without compression"
                    )
                if index != 0:
                    raise ValueError(f"names buffer {index}, which has no bytes")
                self.buffers[index] = self.chunk
            else:
                self.buffers[index] = self.resource(uri)
            if len(self.buffers[index]) < length:
                raise ValueError(f"has a buffer of {length} bytes, of which {len(self.buffers[index])} are there")
        return self.buffers[index]

    def resource(self, uri: Any) -> bytes:
        """The bytes of a URI: in the JSON itself, or in a file beside it."""
        if not isinstance(uri, str):
            raise ValueError("has a uri that is no text")
        if uri[:5].lower() == "data:":
            head, comma, body = uri.partition(",")
            self.source.take(len(body), "a data URI")
            try:
                if not comma:
                    raise ValueError
                if head.lower().endswith(";base64"):
                    text = b"".join(unquote_to_bytes(body).split())
                    return base64.b64decode(text + b"=" * (-len(text) % 4), validate=True)
                return unquote_to_bytes(body)
            except (ValueError, binascii.Error):
                raise ValueError("has a data URI that is not valid") from None
        path = self.source.find(uri, quoted=True)
        if path is None:
            raise ValueError(f"names {uri[:200]}, which is missing")
        return self.source.read_beside(path)

    def view(self, index: Any) -> tuple[bytes, int, int, int]:
        """The buffer of a view, its first byte, its length, its stride (0 = none)."""
        entry = self.item("bufferViews", index)
        for name in COMPRESSED:
            part = self.extension(entry, name)
            if part is not None and self.extension(self.item("buffers", entry.get("buffer")), name) is not None:
                raise ValueError(
                    f"requires the extension {name}, which is not read here: export it without compression"
                )
        data = self.buffer(entry.get("buffer"))
        offset, length = self.number(entry, "byteOffset"), self.number(entry, "byteLength")
        if offset + length > len(data):
            raise ValueError(f"has a buffer view of {length} bytes at {offset} in {len(data)} bytes")
        return data, offset, length, self.number(entry, "byteStride", 0, 65536)

    def strided(self, entry: dict, kind: str, width: int, count: int) -> np.ndarray:
        """`count` rows of `width` numbers where a view and an offset say; a copy."""
        data, start, length, stride = self.view(entry.get("bufferView"))
        offset = self.number(entry, "byteOffset")
        size = np.dtype(kind).itemsize
        stride = stride or size * width
        if stride < size * width:
            raise ValueError(f"has a byteStride of {stride} for elements of {size * width} bytes")
        if count and offset + stride * (count - 1) + size * width > length:
            raise ValueError(f"has an accessor of {count} elements that do not fit into {length} bytes")
        if not count:
            return np.empty((0, width), kind)
        return np.ndarray((count, width), kind, data, start + offset, (stride, size)).copy()

    def accessor(self, index: Any, shapes: tuple[str, ...]) -> tuple[np.ndarray, bool]:
        """The rows of an accessor as stored, and whether they are said to be normalised; sparse ones too (3.6.2)."""
        entry = self.item("accessors", index)
        kind, shape = TYPES.get(str_key(entry.get("componentType"))), entry.get("type")
        if kind is None or shape not in shapes:
            raise ValueError(f"has an accessor of type {str(shape)[:20]}, {str(entry.get('componentType'))[:20]}")
        width, count = WIDTHS[shape], self.number(entry, "count", 0, 3 * MAX_FACES)
        self.source.take(count * width * np.dtype(kind).itemsize, f"an accessor of {count:,} elements")
        if entry.get("bufferView") is None:
            rows = np.zeros((count, width), kind)
        else:
            rows = self.strided(entry, kind, width, count)
        sparse = entry.get("sparse")
        if isinstance(sparse, dict):
            changed = self.number(sparse, "count", 0, count)
            where, what = sparse.get("indices"), sparse.get("values")
            if not isinstance(where, dict) or not isinstance(what, dict):
                raise ValueError("has a sparse accessor without indices or values")
            index_kind = TYPES.get(str_key(where.get("componentType")))
            if index_kind not in ("<u1", "<u2", "<u4"):
                raise ValueError("has a sparse accessor whose indices are no whole numbers")
            places = self.strided(where, index_kind, 1, changed)[:, 0].astype(np.int64)
            if changed and places.max() >= count:
                raise ValueError(f"has a sparse accessor that names element {places.max()} of {count}")
            rows[places] = self.strided(what, kind, width, changed)
        return rows, entry.get("normalized") is True

    # --- the scene ---

    def place_nodes(self) -> list[tuple[int, np.ndarray, dict]]:
        """Every mesh of the default scene with its matrix in the scene's frame, instances one by one."""
        nodes = self.items("nodes")
        scenes = self.items("scenes")
        if scenes:
            chosen = self.number(self.tree, "scene", 0)
            roots = self.items("nodes", self.item("scenes", chosen))
            if len(scenes) > 1:
                self.source.notes.append(f"scene {chosen} of {len(scenes)}")
        else:
            children = {
                x for i in range(len(nodes)) for x in map(str_key, self.items("children", self.item("nodes", i)))
            }
            roots = [i for i in range(len(nodes)) if i not in children]
        placed = []
        waiting = [(root, np.eye(4)) for root in roots]
        seen = set()
        copies = 0
        while waiting:
            index, parent = waiting.pop()
            node = self.item("nodes", index)
            if index in seen:
                raise ValueError(f"has a node, {index}, with two parents or in a circle")
            seen.add(index)
            matrix = parent @ self.local(node) if MOVES & node.keys() else parent
            if not np.isfinite(matrix).all():
                raise ValueError(f"has a node, {index}, whose place is not finite")
            for child in self.items("children", node):
                waiting.append((child, matrix))
            if node.get("mesh") is None:
                continue
            self.item("meshes", node["mesh"])
            if node.get("skin") is not None:
                self.source.warn("it has a skin: shown as it was modelled, without its joints")
            instances = self.instances(node)
            copies += len(instances)
            self.source.take(256 * len(instances), f"{copies:,} instances")
            placed += [(node["mesh"], matrix if one is None else matrix @ one, node) for one in instances]
        return sorted(placed, key=lambda item: item[0])

    def local(self, node: dict) -> np.ndarray:
        if node.get("matrix") is not None:
            return self.floats(node, "matrix", [0.0] * 16).reshape(4, 4).T
        return compose(
            self.floats(node, "translation", [0, 0, 0]),
            self.floats(node, "rotation", [0, 0, 0, 1]),
            self.floats(node, "scale", [1, 1, 1]),
        )

    def instances(self, node: dict) -> Sequence[np.ndarray | None]:
        """Where EXT_mesh_gpu_instancing puts the node's mesh; once, at the node itself (None), without."""
        found = self.extension(node, "EXT_mesh_gpu_instancing")
        if found is None:
            return [None]
        names = found.get("attributes")
        if not isinstance(names, dict):
            raise ValueError("has instances without attributes")
        for index in names.values():
            count = self.number(self.item("accessors", index), "count", 0, 3 * MAX_FACES)
            self.source.take(1024 * count, f"{count:,} instances")
        rows = {}
        for name, shape in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")):
            if name in names:
                values, _ = self.accessor(names[name], (shape,))
                rows[name] = normalised(values) if values.dtype.kind != "f" else values.astype(np.float64)
        counts = {len(value) for value in rows.values()}
        if len(counts) != 1:
            raise ValueError("has instances whose attributes differ in number")
        count = counts.pop()
        if not all(np.isfinite(value).all() for value in rows.values()):
            raise ValueError("has instances that are not finite")
        blank = {"TRANSLATION": [0.0, 0, 0], "ROTATION": [0.0, 0, 0, 1], "SCALE": [1.0, 1, 1]}
        table = {name: rows.get(name, np.tile(value, (count, 1))) for name, value in blank.items()}
        return [compose(*(table[name][i] for name in blank)) for i in range(count)]

    # --- meshes ---

    def measure(self, mesh: int) -> list[tuple[dict, int, int]]:
        """Every primitive of a mesh with its numbers of vertices and faces, by the counts alone."""
        found = []
        left_out = 0
        for item in self.items("primitives", self.item("meshes", mesh)):
            attributes = item.get("attributes") if isinstance(item, dict) else None
            if not isinstance(attributes, dict):
                raise ValueError(f"has no valid glTF JSON: mesh {mesh} has a primitive without attributes")
            draco = self.extension(item, COMPRESSED[0]) is not None
            if attributes.get("POSITION") is None or item.get("mode", 4) not in (4, 5, 6):
                left_out += 1
                continue
            position = self.item("accessors", attributes["POSITION"])
            if draco and position.get("bufferView") is None:
                raise ValueError(
                    f"requires the extension {COMPRESSED[0]}, which is not read here: export it without compression"
                )
            vertices = self.number(position, "count", 0, 3 * MAX_FACES)
            corners = vertices
            if item.get("indices") is not None:
                corners = self.number(self.item("accessors", item["indices"]), "count", 0, 3 * MAX_FACES)
            faces = corners // 3 if item.get("mode", 4) == 4 else max(corners - 2, 0)
            found.append((item, vertices, faces))
        if left_out:
            self.source.warn(f"{left_out} of its parts are points or lines, which are not shown")
        return found

    def primitive(self, item: dict, mesh: int, node: dict) -> Part:
        attributes = item["attributes"]
        rows, flag = self.accessor(attributes["POSITION"], ("VEC3",))
        vertices = (normalised(rows) if flag else rows).astype(np.float64)
        vertices = self.morph(vertices, item, mesh, node)
        count = len(vertices)
        faces = self.triangles(item, count)
        look = self.look(item.get("material"))
        light = None
        if attributes.get("COLOR_0") is not None:
            light = self.colours(attributes["COLOR_0"], count)
        if look.texture is not None:
            uv = self.coordinates(attributes, look, count)
            if uv is not None:
                return Part(vertices, faces, uv=uv, texture=look.texture, shade=light)
            self.source.warn("a part has a texture and no coordinates for it: shown without that texture")
        if light is not None:
            return Part(vertices, faces, colours=from_linear(light * look.light))
        if attributes.get("TEXCOORD_0") is not None and look.plain and len(self.items("materials")) == 0:
            guess = self.source.guess_texture()
            uv = self.coordinates(attributes, look, count)
            if guess is not None and uv is not None:
                return Part(vertices, faces, uv=uv, texture=guess)
        if item.get("material") is None:
            return Part(vertices, faces)
        return Part(vertices, faces, colours=np.tile(from_linear(np.array(look.light)), (count, 1)))

    def morph(self, vertices: np.ndarray, item: dict, mesh: int, node: dict) -> np.ndarray:
        """Vertices with the mesh's (or the node's) default weights of its morph targets (3.7.2.2)."""
        targets = self.items("targets", item)
        if not targets:
            return vertices
        owner = node if node.get("weights") is not None else self.item("meshes", mesh)
        weights = self.floats(owner, "weights", [0.0] * len(targets))
        for weight, target in zip(weights, targets, strict=True):
            if weight and isinstance(target, dict) and target.get("POSITION") is not None:
                rows, flag = self.accessor(target["POSITION"], ("VEC3",))
                if len(rows) != len(vertices):
                    raise ValueError("has a morph target of another number of vertices")
                vertices = vertices + weight * (normalised(rows) if flag else rows)
        return vertices

    def triangles(self, item: dict, count: int) -> np.ndarray:
        """Triangles of a list, a strip or a fan (3.7.2.1)."""
        if item.get("indices") is None:
            corners = np.arange(count)
        else:
            rows, _ = self.accessor(item["indices"], ("SCALAR",))
            if rows.dtype.kind != "u":
                raise ValueError("has indices that are no whole numbers")
            corners = rows[:, 0].astype(np.int64)
        if len(corners) and corners.max() >= count:
            raise ValueError(f"a face names vertex {corners.max()} of {count}")
        mode = item.get("mode", 4)
        if mode == 4:
            return corners[: len(corners) // 3 * 3].reshape(-1, 3)
        step = np.arange(max(len(corners) - 2, 0))
        if mode == 6:
            return np.stack([corners[step * 0], corners[step + 1], corners[step + 2]], axis=-1)
        odd = step % 2
        return np.stack([corners[step], corners[step + 1 + odd], corners[step + 2 - odd]], axis=-1)

    def colours(self, index: Any, count: int) -> np.ndarray:
        """COLOR_0 as linear light (3.7.2.1); whole numbers are normalised, whether the file says so or not."""
        rows, _ = self.accessor(index, ("VEC3", "VEC4"))
        if len(rows) != count:
            raise ValueError(f"has {len(rows)} colours for {count} vertices")
        light = rows[:, :3].astype(np.float64) if rows.dtype.kind == "f" else normalised(rows[:, :3])
        light = np.clip(np.nan_to_num(light), 0, 1)
        return to_linear(light) if self.colours_are_srgb else light

    def coordinates(self, attributes: dict, look: Look, count: int) -> np.ndarray | None:
        """Texture coordinates, v up."""
        name = f"TEXCOORD_{look.channel}"
        if attributes.get(name) is None:
            return None
        rows, flag = self.accessor(attributes[name], ("VEC2",))
        if len(rows) != count:
            raise ValueError(f"has {len(rows)} texture coordinates for {count} vertices")
        quantised = "KHR_mesh_quantization" in self.items("extensionsUsed") + self.items("extensionsRequired")
        uv = rows.astype(np.float64) if quantised and not flag else normalised(rows)
        uv = np.clip(np.nan_to_num(uv), -1e6, 1e6)
        uv = np.concatenate([uv, np.ones((count, 1))], axis=1) @ np.array(look.turn, np.float64).T
        return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1)

    # --- materials ---

    def look(self, index: Any) -> Look:
        if index is None:
            return Look(plain=True)
        entry = self.item("materials", index)
        if index not in self.looks:
            self.looks[index] = self.material(entry)
        return self.looks[index]

    def material(self, entry: dict) -> Look:
        """Base colour and what shines of itself (3.9)."""
        base = entry.get("pbrMetallicRoughness")
        base = base if isinstance(base, dict) else {}
        glossy = self.extension(entry, "KHR_materials_pbrSpecularGlossiness")
        if glossy is not None:
            factor, picture = self.floats(glossy, "diffuseFactor", [1, 1, 1, 1]), glossy.get("diffuseTexture")
        else:
            factor, picture = self.floats(base, "baseColorFactor", [1, 1, 1, 1]), base.get("baseColorTexture")
        light = np.clip(factor[:3], 0, 1)
        texture, channel, turn = self.picture(picture)
        if texture is not None:
            texture = dataclasses.replace(texture, tint=triple(light))
        shine = self.floats(entry, "emissiveFactor", [0, 0, 0])
        strength = self.extension(entry, "KHR_materials_emissive_strength")
        if strength is not None:
            shine = shine * self.floats({"s": [strength.get("emissiveStrength", 1)]}, "s", [1])
        if not shine.any():
            return Look(triple(light), texture, channel, turn)
        glow, glow_channel, glow_turn = self.picture(entry.get("emissiveTexture"))
        shine = np.clip(shine, 0, 1e3)
        if glow is None:
            if texture is not None:
                texture = dataclasses.replace(texture, offset=triple(shine))
            return Look(triple(np.clip(light + shine, 0, 1)), texture, channel, turn)
        glow = dataclasses.replace(glow, tint=triple(shine))
        if texture is None:
            return Look(triple(light), dataclasses.replace(glow, offset=triple(light)), glow_channel, glow_turn)
        if (channel, turn) == (glow_channel, glow_turn):
            return Look(triple(light), dataclasses.replace(texture, plus=glow), channel, turn)
        if not light.any():
            return Look(triple(light), glow, glow_channel, glow_turn)
        self.source.warn("a part shines by an image with coordinates of its own: shown without that")
        return Look(triple(light), texture, channel, turn)

    def picture(self, info: Any) -> tuple[Texture | None, int, tuple]:
        """The image of a texture reference, its coordinates' number, and how they are moved."""
        turn = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        if not isinstance(info, dict):
            return None, 0, turn
        channel = self.number(info, "texCoord", 0, 64)
        moved = self.extension(info, "KHR_texture_transform")
        if moved is not None:
            channel = self.number(moved, "texCoord", channel, 64)
            offset, scale = self.floats(moved, "offset", [0, 0]), self.floats(moved, "scale", [1, 1])
            angle = float(self.floats({"a": [moved.get("rotation", 0)]}, "a", [0])[0])
            c, s = math.cos(angle), math.sin(angle)
            turn = (
                (c * scale[0], s * scale[1], offset[0]),
                (-s * scale[0], c * scale[1], offset[1]),
            )
            turn = tuple(tuple(float(x) for x in row) for row in turn)
        entry = self.item("textures", info.get("index"))
        webp = self.extension(entry, "EXT_texture_webp")
        source = (webp or {}).get("source", entry.get("source"))
        if source is None:
            names = ", ".join(entry.get("extensions", {})) if isinstance(entry.get("extensions"), dict) else ""
            self.source.warn(f"a texture is only there in a form that is not read here ({names[:80]})")
            return None, channel, turn
        texture = self.image(source)
        sampler = self.item("samplers", entry["sampler"]) if entry.get("sampler") is not None else {}
        wrap = tuple(WRAPS.get(str_key(sampler.get(name, 10497)), "repeat") for name in ("wrapS", "wrapT"))
        if texture is not None and wrap != ("repeat", "repeat"):
            texture = dataclasses.replace(texture, wrap=(wrap[0], wrap[1]))
        return texture, channel, turn

    def image(self, index: Any) -> Texture | None:
        entry = self.item("images", index)
        if index not in self.textures:
            name = str(entry.get("name") or f"image {index}")[:80]
            uri = entry.get("uri")
            if entry.get("bufferView") is not None:
                data, offset, length, _ = self.view(entry["bufferView"])
                self.source.take(length, f"the image {name}")
                self.textures[index] = self.source.open_texture(name, data[offset : offset + length])
            elif isinstance(uri, str) and uri[:5].lower() == "data:":
                self.textures[index] = self.source.open_texture(name, self.resource(uri))
            else:
                self.textures[index] = self.source.open_texture(str(uri), quoted=True)
        return self.textures[index]


def str_key(value: Any) -> Any:
    """A value that may be looked up: hostile JSON has lists where numbers belong."""
    return value if isinstance(value, int | str) else None


def triple(values: np.ndarray) -> tuple[float, float, float]:
    """Three Python floats."""
    return float(values[0]), float(values[1]), float(values[2])


def normalised(rows: np.ndarray) -> np.ndarray:
    """Whole numbers as fractions of their type's maximum (3.6.2.2); floats stay."""
    if rows.dtype.kind == "f":
        return rows.astype(np.float64)
    return np.maximum(rows.astype(np.float64) / np.iinfo(rows.dtype).max, -1.0)


def compose(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """T R S as a matrix [4 4]; the rotation is a quaternion x, y, z, w."""
    length = np.linalg.norm(rotation)
    x, y, z, w = rotation / length if length > 0 else np.array([0.0, 0, 0, 1])
    turned = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned * scale, translation
    return matrix


# --- writing -------------------------------------------------------------------------------------------------------


def make_glb(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    uv: Float[np.ndarray, "n 2"] | None = None,
    texture: UInt8[np.ndarray, "th tw 3"] | None = None,
) -> bytes:
    """A GLB file of one mesh: with its texture where it has one, else with its colours, which the format keeps as
    linear light (sixteen bits, so that the bytes come back as they were)."""
    blocks: list[bytes] = []
    views: list[dict] = []
    accessors: list[dict] = []

    def add(data: bytes, **view: int) -> int:
        views.append({"buffer": 0, "byteOffset": sum(map(len, blocks)), "byteLength": len(data), **view})
        blocks.append(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    def put(values: np.ndarray, component: int, shape: str, target: int = 34962, **more: Any) -> int:
        view = add(values.tobytes(), target=target)
        accessors.append({"bufferView": view, "componentType": component, "count": len(values), "type": shape, **more})
        return len(accessors) - 1

    places = vertices.astype("<f4")
    limits = {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    attributes = {"POSITION": put(places, 5126, "VEC3", **limits)}
    if (np.linalg.norm(normals, axis=-1) > 0.99).all():  # the format has no normal of length 0
        attributes["NORMAL"] = put(normals.astype("<f4"), 5126, "VEC3")
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "ipjax"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    if texture is not None and uv is not None:
        from PIL import Image

        attributes["TEXCOORD_0"] = put(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1).astype("<f4"), 5126, "VEC2")
        png = io.BytesIO()
        Image.fromarray(texture).save(png, "PNG")
        tree |= {"images": [{"bufferView": add(png.getvalue()), "mimeType": "image/png"}], "textures": [{"source": 0}]}
        surface["baseColorTexture"] = {"index": 0}
    else:
        light = np.round(to_linear(np.arange(256) / 255) * 65535).astype("<u2")[colours]
        rows = np.concatenate([light, np.full((len(light), 1), 65535, "<u2")], axis=1)
        attributes["COLOR_0"] = put(rows, 5123, "VEC4", normalized=True)
    indices = put(faces.astype("<u4").reshape(-1, 1), 5125, "SCALAR", 34963)
    tree |= {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(map(len, blocks))}],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(blocks)
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(body))
    return head + struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(body), 0x004E4942) + body
