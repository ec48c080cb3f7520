"""STL, binary and text in either case."""

import re
import struct

import numpy as np

from ipjax.files.meshes.formats.part import Part
from ipjax.files.meshes.formats.source import BYTE_ORDER_MARK, Source

# Digits are bounded: without, a file of nothing but digits takes the square of its length to be refused.
NUMBER = rb"[+-]?(?:[0-9]{1,64}(?:\.[0-9]{0,64})?|\.[0-9]{1,64})(?:e[+-]?[0-9]{1,8})?|[+-]?nan|[+-]?inf"
VERTEX = re.compile(rb"\bvertex\s+(%s)\s+(%s)\s+(%s)" % (NUMBER, NUMBER, NUMBER), re.IGNORECASE)
RECORD = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(source: Source) -> list[Part]:
    """One part without colour, three vertices a face. Raises ValueError in a sentence."""
    data = source.read()
    text = data.removeprefix(BYTE_ORDER_MARK)
    count = struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else -1
    # Binary files may begin with "solid" too, and some have bytes behind their faces: a zero is in no text.
    binary = len(data) == 84 + 50 * count or (count >= 0 and b"\0" in data[:512])
    if not binary and text[:512].lstrip()[:5].lower() == b"solid":
        data = text
        if not re.search(rb"\bfacet\b", data[:65536], re.IGNORECASE):
            raise ValueError("the mesh is empty: it has no facet")
        source.take(len(data), "its text")
        values = []
        found: list[tuple[bytes, ...]] = []
        for match in VERTEX.finditer(data):
            found.append(match.groups())
            if len(found) == 100_000:
                values.append(np.array(found).astype(np.float64))
                found = []
                source.take(100_000 * 240, "its vertices")
        if found:
            values.append(np.array(found).astype(np.float64))
        vertices = np.concatenate(values) if values else np.empty((0, 3))
        source.take_mesh(0, len(vertices) // 3)
        if len(vertices) == 0 or len(vertices) % 3:
            raise ValueError(f"has {len(vertices)} vertices, which are not three a face")
    else:
        if count < 0:
            raise ValueError("is too short for STL")
        if 84 + 50 * count > len(data):
            raise ValueError(f"promises {count} faces in {len(data)} bytes")
        if count == 0:
            raise ValueError("the mesh is empty: it has no faces")
        if len(data) >= 84 + 50 * (count + 1):
            source.warn(
                f"it promises {count:,} faces and has room for {(len(data) - 84) // 50:,}: the rest is not shown"
            )
        source.take_mesh(3 * count, count)
        vertices = np.frombuffer(data, RECORD, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    return [Part(vertices, np.arange(len(vertices)).reshape(-1, 3))]
