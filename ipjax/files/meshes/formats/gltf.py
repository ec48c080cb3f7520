"""glTF 2.0 (.gltf, .glb): every triangle of the scene in the scene's frame, with its base colour.

An extension that the file requires and that is not handled here is refused by name. References are to the Khronos
specification, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ipjax.files.meshes.formats.gltf_document import COMPRESSED, Document, as_key, normalised
from ipjax.files.meshes.formats.gltf_materials import Material, Materials
from ipjax.files.meshes.formats.part import Part, drop_unused
from ipjax.files.meshes.formats.source import MAX_FACES, Source
from ipjax.files.meshes.textures import from_linear, to_linear
from ipjax.transforms import rotation_from_quaternion

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


def read_gltf(source: Source) -> list[Part]:
    """The parts of the default scene. Raises ValueError in a sentence for what is not valid or not handled."""
    return _Scene(Document(source)).read()


class _Scene:
    """Nodes, meshes and primitives of one file."""

    def __init__(self, document: Document):
        self.document = document
        self.materials = Materials(document)

    def read(self) -> list[Part]:
        required = self.document.items("extensionsRequired")
        unknown = [str(name) for name in required if as_key(name) not in HANDLED | HARMLESS]
        if unknown:
            names = ", ".join(unknown[:4])[:200]
            compressed = any(name in COMPRESSED for name in unknown)
            advice = "export it without compression" if compressed else "export it without"
            raise ValueError(f"requires the extension {names}, which is not read here: {advice}")
        self.document.check_counts()
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
        self.document.source.take_mesh(vertices, faces)
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

    def place_nodes(self) -> list[tuple[int, np.ndarray, dict]]:
        """Every mesh of the default scene with its matrix in the scene's frame, instances one by one."""
        nodes = self.document.items("nodes")
        scenes = self.document.items("scenes")
        if scenes:
            chosen = self.document.number(self.document.tree, "scene", 0)
            roots = self.document.items("nodes", self.document.item("scenes", chosen))
            if len(scenes) > 1:
                self.document.source.notes.append(f"scene {chosen} of {len(scenes)}")
        else:
            entries = [self.document.item("nodes", i) for i in range(len(nodes))]
            children = {as_key(child) for entry in entries for child in self.document.items("children", entry)}
            roots = [i for i in range(len(nodes)) if i not in children]
        placed = []
        waiting = [(root, np.eye(4)) for root in roots]
        seen = set()
        copies = 0
        while waiting:
            index, parent = waiting.pop()
            node = self.document.item("nodes", index)
            if index in seen:
                raise ValueError(f"has a node, {index}, with two parents or in a circle")
            seen.add(index)
            matrix = parent @ self.local(node) if MOVES & node.keys() else parent
            if not np.isfinite(matrix).all():
                raise ValueError(f"has a node, {index}, whose place is not finite")
            for child in self.document.items("children", node):
                waiting.append((child, matrix))
            if node.get("mesh") is None:
                continue
            self.document.item("meshes", node["mesh"])
            if node.get("skin") is not None:
                self.document.source.warn("it has a skin: shown as it was modelled, without its joints")
            instances = self.instances(node)
            copies += len(instances)
            self.document.source.take(256 * len(instances), f"{copies:,} instances")
            placed += [(node["mesh"], matrix if one is None else matrix @ one, node) for one in instances]
        return sorted(placed, key=lambda item: item[0])

    def local(self, node: dict) -> np.ndarray:
        if node.get("matrix") is not None:
            return self.document.floats(node, "matrix", [0.0] * 16).reshape(4, 4).T
        return compose_matrix(
            self.document.floats(node, "translation", [0, 0, 0]),
            self.document.floats(node, "rotation", [0, 0, 0, 1]),
            self.document.floats(node, "scale", [1, 1, 1]),
        )

    def instances(self, node: dict) -> Sequence[np.ndarray | None]:
        """Where EXT_mesh_gpu_instancing puts the node's mesh; once, at the node itself (None), without."""
        found = self.document.extension(node, "EXT_mesh_gpu_instancing")
        if found is None:
            return [None]
        names = found.get("attributes")
        if not isinstance(names, dict):
            raise ValueError("has instances without attributes")
        for index in names.values():
            count = self.document.number(self.document.item("accessors", index), "count", 0, 3 * MAX_FACES)
            self.document.source.take(1024 * count, f"{count:,} instances")
        rows = {}
        for name, shape in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")):
            if name in names:
                values, _ = self.document.accessor(names[name], (shape,))
                rows[name] = normalised(values) if values.dtype.kind != "f" else values.astype(np.float64)
        counts = {len(value) for value in rows.values()}
        if len(counts) != 1:
            raise ValueError("has instances whose attributes differ in number")
        count = counts.pop()
        if not all(np.isfinite(value).all() for value in rows.values()):
            raise ValueError("has instances that are not finite")
        blank = {"TRANSLATION": [0.0, 0, 0], "ROTATION": [0.0, 0, 0, 1], "SCALE": [1.0, 1, 1]}
        table = {name: rows.get(name, np.tile(value, (count, 1))) for name, value in blank.items()}
        return [compose_matrix(*(table[name][i] for name in blank)) for i in range(count)]

    def measure(self, mesh: int) -> list[tuple[dict, int, int]]:
        """Every primitive of a mesh with its numbers of vertices and faces, by the counts alone."""
        found = []
        left_out = 0
        for item in self.document.items("primitives", self.document.item("meshes", mesh)):
            attributes = item.get("attributes") if isinstance(item, dict) else None
            if not isinstance(attributes, dict):
                raise ValueError(f"has no valid glTF JSON: mesh {mesh} has a primitive without attributes")
            draco = self.document.extension(item, COMPRESSED[0]) is not None
            if attributes.get("POSITION") is None or item.get("mode", 4) not in (4, 5, 6):
                left_out += 1
                continue
            position = self.document.item("accessors", attributes["POSITION"])
            if draco and position.get("bufferView") is None:
                raise ValueError(
                    f"requires the extension {COMPRESSED[0]}, which is not read here: export it without compression"
                )
            vertices = self.document.number(position, "count", 0, 3 * MAX_FACES)
            corners = vertices
            if item.get("indices") is not None:
                indices = self.document.item("accessors", item["indices"])
                corners = self.document.number(indices, "count", 0, 3 * MAX_FACES)
            faces = corners // 3 if item.get("mode", 4) == 4 else max(corners - 2, 0)
            found.append((item, vertices, faces))
        if left_out:
            self.document.source.warn(f"{left_out} of its parts are points or lines, which are not shown")
        return found

    def primitive(self, item: dict, mesh: int, node: dict) -> Part:
        attributes = item["attributes"]
        rows, flag = self.document.accessor(attributes["POSITION"], ("VEC3",))
        vertices = (normalised(rows) if flag else rows).astype(np.float64)
        vertices = self.morph(vertices, item, mesh, node)
        count = len(vertices)
        faces = self.triangles(item, count)
        material = self.materials.find(item.get("material"))
        light = None
        if attributes.get("COLOR_0") is not None:
            light = self.colours(attributes["COLOR_0"], count)
        if material.texture is not None:
            uv = self.coordinates(attributes, material, count)
            if uv is not None:
                return Part(vertices, faces, uv=uv, texture=material.texture, shade=light)
            self.document.source.warn("a part has a texture and no coordinates for it: shown without that texture")
        if light is not None:
            return Part(vertices, faces, colours=from_linear(light * material.light))
        uncoloured = material.is_default and not self.document.items("materials")
        if attributes.get("TEXCOORD_0") is not None and uncoloured:
            guess = self.document.source.guess_texture()
            uv = self.coordinates(attributes, material, count)
            if guess is not None and uv is not None:
                return Part(vertices, faces, uv=uv, texture=guess)
        if item.get("material") is None:
            return Part(vertices, faces)
        return Part(vertices, faces, colours=np.tile(from_linear(np.array(material.light)), (count, 1)))

    def morph(self, vertices: np.ndarray, item: dict, mesh: int, node: dict) -> np.ndarray:
        """Vertices with the mesh's (or the node's) default weights of its morph targets (3.7.2.2)."""
        targets = self.document.items("targets", item)
        if not targets:
            return vertices
        owner = node if node.get("weights") is not None else self.document.item("meshes", mesh)
        weights = self.document.floats(owner, "weights", [0.0] * len(targets))
        for weight, target in zip(weights, targets, strict=True):
            if weight and isinstance(target, dict) and target.get("POSITION") is not None:
                rows, flag = self.document.accessor(target["POSITION"], ("VEC3",))
                if len(rows) != len(vertices):
                    raise ValueError("has a morph target of another number of vertices")
                vertices = vertices + weight * (normalised(rows) if flag else rows)
        return vertices

    def triangles(self, item: dict, count: int) -> np.ndarray:
        """Triangles of a list, a strip or a fan (3.7.2.1)."""
        if item.get("indices") is None:
            corners = np.arange(count)
        else:
            rows, _ = self.document.accessor(item["indices"], ("SCALAR",))
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
        """COLOR_0 as linear light (3.7.2.1); whole numbers are always normalised."""
        rows, _ = self.document.accessor(index, ("VEC3", "VEC4"))
        if len(rows) != count:
            raise ValueError(f"has {len(rows)} colours for {count} vertices")
        light = rows[:, :3].astype(np.float64) if rows.dtype.kind == "f" else normalised(rows[:, :3])
        light = np.clip(np.nan_to_num(light), 0, 1)
        return to_linear(light) if self.document.colours_are_srgb else light

    def coordinates(self, attributes: dict, material: Material, count: int) -> np.ndarray | None:
        """Texture coordinates, v up."""
        name = f"TEXCOORD_{material.channel}"
        if attributes.get(name) is None:
            return None
        rows, flag = self.document.accessor(attributes[name], ("VEC2",))
        if len(rows) != count:
            raise ValueError(f"has {len(rows)} texture coordinates for {count} vertices")
        named = self.document.items("extensionsUsed") + self.document.items("extensionsRequired")
        quantised = "KHR_mesh_quantization" in named
        uv = rows.astype(np.float64) if quantised and not flag else normalised(rows)
        uv = np.clip(np.nan_to_num(uv), -1e6, 1e6)
        uv = np.concatenate([uv, np.ones((count, 1))], axis=1) @ np.array(material.uv_transform, np.float64).T
        return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1)


def compose_matrix(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """T R S as a matrix [4 4]; the rotation is a quaternion x, y, z, w."""
    turned = rotation_from_quaternion(np.asarray(rotation, np.float64))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned * scale, translation
    return matrix
