"""The JSON and the bytes of a glTF 2.0 file (.gltf, .glb): checked values, buffers, accessors.

The file is not trusted: every index, offset and count is checked, and what it asks for is counted, before anything is
allocated. References are to the Khronos specification, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

import base64
import binascii
import struct
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np

from ipjax.files.meshes.formats.source import MAX_BYTES, MAX_FACES, Source
from ipjax.files.storage.parsing import parse_json

TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


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


class Document:
    """One glTF file: values by name, refused where they are not what the specification says."""

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
        asset = self.tree.get("asset")
        generator = str(asset.get("generator", "")) if isinstance(asset, dict) else ""
        # trimesh writes the bytes of its colours, which are sRGB, where linear light belongs.
        self.colours_are_srgb = "trimesh" in generator.lower()

    def items(self, name: str, tree: Any = None) -> list:
        """The list of this name in an object (the file's own by default); empty where there is none."""
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
        """What an extension of this name adds to an object; None where it adds nothing."""
        extensions = tree.get("extensions")
        found = extensions.get(name) if isinstance(extensions, dict) else None
        return found if isinstance(found, dict) else None

    def check_counts(self) -> None:
        """Refuse accessors of more elements than any mesh may have, before anything is allocated."""
        for index in range(len(self.items("accessors"))):
            count = self.item("accessors", index).get("count", 0)
            if isinstance(count, bool) or not isinstance(count, int | float) or not 0 <= count <= 3 * MAX_FACES:
                raise ValueError(f"has an accessor of {str(count)[:40]} elements; simplify the mesh first")

    def buffer(self, index: Any) -> bytes:
        """The bytes of a buffer, read once."""
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
        """The bytes of a URI: in the JSON itself, or in a file in its folder."""
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
        return self.source.read_companion(path)

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
        """A copy of `count` rows of `width` numbers, found by a view and an offset."""
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
        """The rows of an accessor as stored, sparse ones too, and whether it is marked as normalised (3.6.2)."""
        entry = self.item("accessors", index)
        kind, shape = TYPES.get(as_key(entry.get("componentType"))), entry.get("type")
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
            index_kind = TYPES.get(as_key(where.get("componentType")))
            if index_kind not in ("<u1", "<u2", "<u4"):
                raise ValueError("has a sparse accessor whose indices are no whole numbers")
            places = self.strided(where, index_kind, 1, changed)[:, 0].astype(np.int64)
            if changed and places.max() >= count:
                raise ValueError(f"has a sparse accessor that names element {places.max()} of {count}")
            rows[places] = self.strided(what, kind, width, changed)
        return rows, entry.get("normalized") is True


def as_key(value: Any) -> Any:
    """A value that can be a key of a dictionary, else None: invalid JSON has lists where numbers belong."""
    return value if isinstance(value, int | str) else None


def normalised(rows: np.ndarray) -> np.ndarray:
    """Whole numbers as fractions of their type's maximum (3.6.2.2); floats stay."""
    if rows.dtype.kind == "f":
        return rows.astype(np.float64)
    return np.maximum(rows.astype(np.float64) / np.iinfo(rows.dtype).max, -1.0)
