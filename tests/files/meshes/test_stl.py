"""STL, binary and text, as other programs write it."""

import struct

import numpy as np
import pytest
from builders.mesh_files import (
    BYTE_ORDER_MARK,
    FACES,
    VERTICES,
    check_box,
)

from ipjax.files.meshes.loading import load_mesh


@pytest.mark.parametrize("name", [b"box", "Größe".encode(), "Größe".encode("latin-1"), b""])
@pytest.mark.parametrize("change", [str, str.upper])
def test_text_stl_in_either_case_and_any_encoding(tmp_path, name, change):
    lines = []
    for face in FACES:
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += [f"  vertex {x:e} {y:e} {z:e}" for x, y, z in VERTICES[face]]
        lines += [" endloop", "endfacet"]
    text = (
        change("solid ").encode()
        + name
        + b"\n"
        + change("\n".join(lines)).encode()
        + b"\n"
        + change("endsolid").encode()
    )
    for mark in (b"", BYTE_ORDER_MARK):
        (tmp_path / "box.stl").write_bytes(mark + text)
        check_box(load_mesh(tmp_path / "box.stl"), np.full((6, 3), 160))
    (tmp_path / "two.stl").write_bytes(text + b"\n" + text)
    assert len(load_mesh(tmp_path / "two.stl").faces) == 24


@pytest.mark.parametrize("head", [b"", b"solid exported by some cad", b"SOLID facet"])
@pytest.mark.parametrize("name", ["box.stl", "box.STL"])
def test_binary_stl_may_begin_like_text(tmp_path, head, name):
    record = b"".join(struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES)
    for behind in (b"", b"\r\n", b"\0" * 40):
        (tmp_path / name).write_bytes(head.ljust(80) + struct.pack("<I", 12) + record + behind)
        check_box(load_mesh(tmp_path / name), np.full((6, 3), 160))


def test_faces_behind_those_that_binary_stl_promises_are_told(tmp_path):
    record = b"".join(struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES)
    (tmp_path / "box.stl").write_bytes(bytes(80) + struct.pack("<I", 10) + record)
    with pytest.warns(UserWarning, match="promises 10 faces and has room for 12"):
        assert len(load_mesh(tmp_path / "box.stl").faces) == 10
