"""A box with six coloured sides, written in every form of every format, and checks of what is read of it."""

import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from ipjax.files.meshes.mesh import Mesh
from ipjax.files.meshes.textures import sample_texture

SIDES = np.array([[220, 40, 40], [40, 200, 60], [40, 70, 220], [230, 210, 40], [200, 60, 210], [60, 200, 210]])
HALF = np.array([1.0, 1.5, 2.0])
WIDTH, HEIGHT = 48, 32  # of the texture: three by two fields
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8


def corners() -> tuple[np.ndarray, np.ndarray]:
    """Vertices [24 3], four a side (+x, −x, +y, −y, +z, −z), seen from outside counter-clockwise; and uv, v up."""
    vertices, uv = [], []
    for side in range(6):
        axis, sign = side // 2, 1 - 2 * (side % 2)
        one, two = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])[::sign]
        for a, b in square:
            vertices.append((sign * np.eye(3)[axis] + a * one + b * two) * HALF)
            uv.append([(side % 3 + 0.5 + 0.3 * a) / 3, 1 - (side // 3 + 0.5 + 0.3 * b) / 2])
    return np.array(vertices), np.array(uv)


VERTICES, UV = corners()
QUADS = np.arange(24).reshape(6, 4)
FACES = QUADS[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
COLOURS = SIDES.repeat(4, axis=0).astype(np.uint8)


def picture() -> Image.Image:
    """The texture: one field of colour for each side."""
    fields = SIDES.reshape(2, 3, 3).repeat(HEIGHT // 2, 0).repeat(WIDTH // 3, 1)
    return Image.fromarray(fields.astype(np.uint8))


def encode(kind: str = "PNG", image: Image.Image | None = None, **options) -> bytes:
    """An image's bytes."""
    file = io.BytesIO()
    (image or picture()).save(file, kind, **options)
    return file.getvalue()


def read_sides(mesh: Mesh) -> np.ndarray:
    """The colour in the middle of every face of each of the six sides; [6 3], NaN where a side has no face or where its
    faces differ."""
    result = np.full((6, 3), np.nan)
    used = mesh.vertices[np.unique(mesh.faces)]
    middle, half = (used.min(0) + used.max(0)) / 2, np.ptp(used, axis=0) / 2
    centres = (mesh.vertices[mesh.faces].mean(1) - middle) / half
    for side in range(6):
        on = np.flatnonzero(centres[:, side // 2] * (1 - 2 * (side % 2)) > 0.999)
        if len(on) == 0:
            continue
        if mesh.texture is not None and mesh.uv is not None:
            found = sample_texture(mesh.texture, mesh.uv[mesh.faces[on]].mean(1)).astype(float)
        else:
            found = mesh.colours[mesh.faces[on]].astype(float).mean(1)
        if np.ptp(found, axis=0).max() <= 3:
            result[side] = found.mean(0)
    return result


def check_box(mesh: Mesh, colours: np.ndarray = SIDES, faces: int = 12, atol: float = 2.0) -> None:
    """The whole box is there, in its place, its sides look outwards and have their colours."""
    assert len(mesh.faces) == faces, mesh.notes
    used = mesh.vertices[np.unique(mesh.faces)]
    np.testing.assert_allclose(used.max(0), HALF, atol=1e-3)
    np.testing.assert_allclose(used.min(0), -HALF, atol=1e-3)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    assert (np.einsum("mi,mi->m", np.cross(b - a, c - a), a + b + c) > 0).all(), "a face looks inwards"
    np.testing.assert_allclose(read_sides(mesh), colours, atol=atol, err_msg=str(mesh.notes))


class Gltf:
    """A glTF tree that is put together piece by piece."""

    def __init__(self):
        self.data = b""
        self.tree: dict = {
            "asset": {"version": "2.0", "generator": "a test"},
            "accessors": [],
            "bufferViews": [],
            "buffers": [{}],
            "meshes": [{"primitives": []}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        }

    def view(self, data: bytes, **more) -> int:
        """A buffer view of these bytes."""
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data + b"\0" * (-len(data) % 4)
        return len(self.tree["bufferViews"]) - 1

    def put(self, values: np.ndarray, stride: int = 0, **more) -> int:
        """An accessor of these rows, in their own type."""
        values = np.atleast_2d(values.T).T
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}[values.dtype.str[1:]]
        rows = values.tobytes()
        view = {}
        if stride:
            size = values.dtype.itemsize * values.shape[1]
            rows = b"".join(rows[i : i + size] + b"\7" * (stride - size) for i in range(0, len(rows), size))
            view = {"byteStride": stride}
        shape = ["SCALAR", "VEC2", "VEC3", "VEC4"][values.shape[1] - 1]
        entry = {"bufferView": self.view(rows, **view), "componentType": component, "count": len(values), "type": shape}
        self.tree["accessors"].append(entry | more)
        return len(self.tree["accessors"]) - 1

    def draw(self, indices: np.ndarray | None = FACES, mode: int | None = None, material=None, **attributes) -> dict:
        """A primitive with these attributes, which are accessors; POSITION is the box's where it is not given."""
        if "POSITION" not in attributes:
            attributes["POSITION"] = self.put(VERTICES.astype("<f4"))
        primitive: dict = {"attributes": attributes}
        if indices is not None:
            primitive["indices"] = self.put(indices.astype("<u2").reshape(-1, 1))
        if mode is not None:
            primitive["mode"] = mode
        if material is not None:
            primitive["material"] = material
        self.tree["meshes"][0]["primitives"].append(primitive)
        return primitive

    def skin(self, data: bytes | None = None, uri: str | None = None, **more) -> int:
        """A material with a texture; `more` goes into its reference."""
        image = {"uri": uri} if uri else {"bufferView": self.view(encode() if data is None else data)}
        self.tree.setdefault("images", []).append(image)
        self.tree.setdefault("textures", []).append({"source": len(self.tree["images"]) - 1})
        reference = {"index": len(self.tree["textures"]) - 1, **more}
        return self.material(baseColorTexture=reference)

    def material(self, **surface) -> int:
        """A material with this surface."""
        self.tree.setdefault("materials", []).append({"pbrMetallicRoughness": surface})
        return len(self.tree["materials"]) - 1

    def uv(self, uv: np.ndarray = UV) -> int:
        """Texture coordinates, given v up, as the format has them."""
        return self.put(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1).astype("<f4"))

    def glb(self) -> bytes:
        """The file."""
        self.tree["buffers"][0].setdefault("byteLength", len(self.data))
        return pack_glb(json.dumps(self.tree).encode(), self.data)

    def save(self, path: Path) -> Path:
        """Write it; a .gltf has its bytes beside it unless it names others."""
        if path.suffix == ".glb":
            path.write_bytes(self.glb())
            return path
        self.tree["buffers"][0].setdefault("uri", path.stem + ".bin")
        self.tree["buffers"][0]["byteLength"] = len(self.data)
        path.write_text(json.dumps(self.tree))
        (path.parent / (path.stem + ".bin")).write_bytes(self.data)
        return path


def pack_glb(text: bytes, data: bytes) -> bytes:
    """JSON and bytes as a GLB file."""
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(data))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def write_obj(path: Path, *, colours=None, uv: np.ndarray | None = UV, head: str = "", faces=None) -> Path:
    """The box as OBJ: `colours` are numbers behind the vertices' places."""
    lines = [head] if head else []
    for i, vertex in enumerate(VERTICES):
        extra = "" if colours is None else " " + " ".join(f"{x:g}" for x in colours[i])
        lines.append("v " + " ".join(f"{x:g}" for x in vertex) + extra)
    if uv is not None:
        lines += [f"vt {u:.6f} {v:.6f}" for u, v in uv]
    corner = "{0}/{0}" if uv is not None else "{0}"
    lines += faces or ["f " + " ".join(corner.format(i + 1) for i in face) for face in FACES]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_ply(
    path: Path, vertex: list[tuple], face_rows, form: str = "ascii", *, head=(), face=(), ending="\n"
) -> Path:
    """PLY by its properties: `vertex` lists (name, type, column); `face_rows` are tuples of lists and numbers, of the
    properties `face` (each "name type" or "name length type")."""
    codes = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
    codes |= {"float": "f4", "double": "f8", "uint8": "u1", "int32": "i4", "float32": "f4"}
    count = len(vertex[0][2])
    lines = ["ply", f"format {form} 1.0", *head, f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind, _ in vertex] + [f"element face {len(face_rows)}"]
    for item in face:
        words = item.split()
        lines.append("property " + ("list " if len(words) == 3 else "") + " ".join([*words[1:], words[0]]))
    text = (ending.join([*lines, "end_header"]) + ending).encode()
    order = ">" if "big" in form else "<"
    rows = []
    for i in range(count):
        values = [(codes[kind], [column[i]]) for _, kind, column in vertex]
        rows.append(values)
    for row in face_rows:
        values = []
        for item, value in zip(face, row, strict=True):
            words = item.split()
            if len(words) == 3:
                values += [(codes[words[1]], [len(value)]), (codes[words[2]], value)]
            else:
                values.append((codes[words[1]], [value]))
        rows.append(values)
    for values in rows:
        if form == "ascii":
            text += (" ".join(f"{x:.9g}" for _, many in values for x in many) + ending).encode()
        else:
            text += b"".join(np.array(many).astype(order + code).tobytes() for code, many in values)
    path.write_bytes(text)
    return path
