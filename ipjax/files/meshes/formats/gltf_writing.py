"""Writing GLB: one mesh with its texture, or with its colours per vertex."""

import io
import json
import struct
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from ipjax.files.meshes.textures import to_linear


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
