"""PLY as other programs write it: one box with six colours is read as the same box."""

import struct

import numpy as np
import pytest
from builders.mesh_files import (
    BYTE_ORDER_MARK,
    COLOURS,
    FACES,
    QUADS,
    SIDES,
    UV,
    VERTICES,
    check_box,
    encode,
    picture,
    write_ply,
)
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ipjax.files.meshes.loading import load_mesh

NAMES = [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")]
PAINTED = [*zip("xyz", ["float"] * 3, VERTICES.T, strict=True), *zip(NAMES[0], ["uchar"] * 3, COLOURS.T, strict=True)]
TOPS = {"uchar": 255, "ushort": 65535, "float": 1, "double": 1, "int": 255}


@given(
    st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    st.sampled_from(NAMES),
    st.sampled_from(sorted(TOPS)),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from(["triangles", "quads", "mixed"]),
    st.sampled_from(["vertex_indices uchar int", "vertex_index int uint", "vertex_indices uint8 int32"]),
    st.booleans(),
)
def test_colours_and_polygons_in_every_spelling(tmp_path_factory, form, names, kind, ending, shape, faces, wide):
    values = COLOURS / 255 * TOPS[kind]
    values = values if kind in ("float", "double") else np.round(values)
    place = "double" if wide else "float"
    vertex = [*zip("xyz", [place] * 3, VERTICES.T, strict=True), *zip(names, [kind] * 3, values.T, strict=True)]
    rows = {
        "triangles": [(face,) for face in FACES],
        "quads": [(quad,) for quad in QUADS],
        "mixed": [(quad,) for quad in QUADS[:3]] + [(face,) for face in FACES[6:8]] + [(q,) for q in QUADS[4:]],
    }[shape]
    path = write_ply(tmp_path_factory.mktemp("ply") / "box.ply", vertex, rows, form, face=[faces], ending=ending)
    check_box(load_mesh(path), atol=1)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("names", ["texture_u texture_v", "texture_s texture_t", "u v", "s t"])
def test_coordinates_in_every_spelling(tmp_path, form, names):
    (tmp_path / "t ex.png").write_bytes(encode())
    u, v = names.split()
    vertex = [*zip("xyz", ["float"] * 3, VERTICES.T, strict=True), (u, "float", UV[:, 0]), (v, "float", UV[:, 1])]
    rows = [(face,) for face in FACES]
    head = ["comment TextureFile t ex.png"]
    check_box(
        load_mesh(write_ply(tmp_path / "box.ply", vertex, rows, form, head=head, face=["vertex_indices uchar int"]))
    )


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
@pytest.mark.parametrize("shape", ["triangles", "quads"])
def test_two_textures_and_coordinates_of_corners(tmp_path, form, shape):
    """The left half of the fields is in one file, the right in another; faces say which."""
    image = np.asarray(picture())
    for name, part in (("a.png", slice(0, 16)), ("b.png", slice(16, 32))):
        (tmp_path / name).write_bytes(encode("PNG", Image.fromarray(np.ascontiguousarray(image[part]))))
    vertex = [*zip("xyz", ["float"] * 3, VERTICES.T, strict=True)]
    rows = []
    for i, face in enumerate(FACES if shape == "triangles" else QUADS):
        second = i // (2 if shape == "triangles" else 1) >= 3
        uv = UV[face] * [1, 2] - [0, 0 if second else 1]
        rows.append((face, uv.ravel(), int(second)))
    head = ["comment TextureFile a.png", "comment TextureFile b.png"]
    face = ["vertex_indices uchar int", "texcoord uchar float", "texnumber int"]
    check_box(load_mesh(write_ply(tmp_path / "box.ply", vertex, rows, form, head=head, face=face)))


def test_colours_of_faces_and_strips(tmp_path):
    vertex = [*zip("xyz", ["float"] * 3, VERTICES.T, strict=True)]
    rows = [(quad, *SIDES[i]) for i, quad in enumerate(QUADS)]
    face = ["vertex_indices uchar int", "red uchar", "green uchar", "blue uchar"]
    check_box(load_mesh(write_ply(tmp_path / "box.ply", vertex, rows, "binary_little_endian", face=face)), atol=0)
    vertex += [*zip(NAMES[0], ["uchar"] * 3, COLOURS.T, strict=True)]
    strip = np.concatenate([[*quad[[0, 1, 3, 2]], -1] for quad in QUADS])
    path = write_ply(tmp_path / "strip.ply", vertex, [(strip,)], face=["vertex_indices int int"])
    path.write_text(path.read_text().replace("element face", "element tristrips"))
    check_box(load_mesh(path), atol=0)


def test_rows_of_many_lengths_stay_in_order(tmp_path):
    """Words behind a row, and lists of vertices, do not reorder the vertices that faces count."""
    path = write_ply(tmp_path / "box.ply", PAINTED, [(q,) for q in QUADS], face=["vertex_indices uchar int"])
    lines = path.read_text().split("\n")
    first = lines.index("end_header") + 1
    for i in range(0, 24, 3):
        lines[first + i] += " 0" * (i % 4 + 1)
    (tmp_path / "words.ply").write_text("\n".join(lines))
    check_box(load_mesh(tmp_path / "words.ply"), atol=0)
    for form, order in (("ascii", None), ("binary_little_endian", "<"), ("binary_big_endian", ">")):
        kinds = ["property float x", "property float y", "property float z", "property list uchar short near"]
        kinds += [f"property uchar {name}" for name in NAMES[0]]
        head = ["ply", f"format {form} 1.0", "element vertex 24", *kinds]
        head += ["element face 6", "property list uchar int vertex_indices", "end_header"]
        data = ("\n".join(head) + "\n").encode()
        for i in range(24):
            near = [7] * (i % 3)
            if order is None:
                data += (" ".join(map(str, [*VERTICES[i], len(near), *near, *COLOURS[i]])) + "\n").encode()
            else:
                data += struct.pack(f"{order}3fB{len(near)}h3B", *VERTICES[i], len(near), *near, *COLOURS[i])
        for quad in QUADS:
            data += struct.pack(f"{order}B4i", 4, *quad) if order else f"4 {' '.join(map(str, quad))}\n".encode()
        (tmp_path / "lists.ply").write_bytes(data)
        check_box(load_mesh(tmp_path / "lists.ply"), atol=0)


def test_clouds_are_told_apart(tmp_path):
    vertex = [*zip("xyz", ["float"] * 3, VERTICES.T, strict=True)]
    with pytest.raises(ValueError, match="point cloud"):
        load_mesh(write_ply(tmp_path / "cloud.ply", vertex, [], face=["vertex_indices uchar int"]))
    vertex.append(("f_dc_0", "float", VERTICES[:, 0]))
    with pytest.raises(ValueError, match="Gaussians"):
        load_mesh(write_ply(tmp_path / "splat.ply", vertex, [], face=["vertex_indices uchar int"]))


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path):
    path = write_ply(tmp_path / "box.ply", PAINTED, [(q,) for q in QUADS], face=["vertex_indices uchar int"])
    path.write_bytes(BYTE_ORDER_MARK + path.read_bytes())
    check_box(load_mesh(path))
