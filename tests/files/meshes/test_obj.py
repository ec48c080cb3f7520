"""OBJ and MTL as other programs write them: one box with six colours is read as the same box."""

import warnings

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
    write_obj,
    write_ply,
)

from ipjax.files.meshes.loading import load_mesh


@pytest.mark.parametrize("top", [1, 255])
@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("material", [None, "Ka 0.2 0.2 0.2\nKd 0.8 0.8 0.8", "missing"])
@pytest.mark.parametrize("uv", [None, UV])
def test_colours_behind_vertices_are_kept(tmp_path, top, alpha, material, uv):
    rows = np.concatenate([COLOURS / 255 * top, np.full((24, 1), top)], axis=1)[:, : 3 + alpha]
    head = "" if material is None else "mtllib box.mtl\nusemtl m"
    if material not in (None, "missing"):
        (tmp_path / "box.mtl").write_text(f"newmtl m\n{material}\n")
    path = write_obj(tmp_path / "box.obj", colours=rows, uv=uv, head=head)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = load_mesh(path)
    check_box(mesh, atol=0.6)
    said = " ".join(str(warning.message) for warning in caught)
    assert ("no texture" in said) == (uv is not None)
    assert ("box.mtl is named but missing" in said) == (material == "missing")
    assert mesh.texture is None and any("vertex colours" in note for note in mesh.notes)


def test_white_vertices_do_not_hide_a_material(tmp_path):
    head = ["mtllib box.mtl"]
    text = "".join(f"newmtl s{i}\nKd {' '.join(f'{x / 255:.4f}' for x in SIDES[i])}\n" for i in range(6))
    (tmp_path / "box.mtl").write_text(text)
    faces = [line for i in range(6) for line in (f"usemtl s{i}", "f " + " ".join(str(j + 1) for j in QUADS[i]))]
    for colours in (None, np.ones((24, 3))):
        path = write_obj(tmp_path / "box.obj", uv=None, head="\n".join(head), faces=faces, colours=colours)
        check_box(load_mesh(path), atol=0.6)


@pytest.mark.parametrize(
    "line",
    [
        "map_Kd skin.png",
        "map_Kd -s 1 1 1 -o 0 0 0 skin.png",
        "map_Kd -clamp on -bm 0.5 skin.png",
        "map_Kd -blendu off -mm 0 1 skin.png",
        "map_Kd SKIN.PNG",
        "map_Kd ./images/../skin.png",
        "MAP_KD skin.png",
        "map_Kd C:\\Users\\someone\\skin.png",
        "map_Kd /home/someone/else/skin.png",
        "map_Ka skin.png",
        "map_Kd\tskin.png  ",
    ],
)
def test_images_are_found_behind_options_and_habits(tmp_path, line):
    (tmp_path / "skin.png").write_bytes(encode())
    (tmp_path / "box.mtl").write_text(f"newmtl m\nKd 0.8 0.8 0.8\n{line}\n")
    check_box(load_mesh(write_obj(tmp_path / "box.obj", head="mtllib Box.MTL\nusemtl m")))


def test_a_file_that_lacks_much_says_so_in_a_few_sentences(tmp_path):
    names = range(300)
    (tmp_path / "box.mtl").write_text("".join(f"newmtl m{i}\nmap_Kd gone{i}.png\n" for i in names))
    faces = [line for i in names for line in (f"usemtl m{i}", "f 1/1 2/2 3/3")]
    with pytest.warns(UserWarning) as caught:
        mesh = load_mesh(write_obj(tmp_path / "box.obj", head="mtllib box.mtl", faces=faces))
    said = [str(warning.message) for warning in caught]
    assert 2 <= len(said) <= 10 and "gone0.png" in said[0] and "more" in said[-1] and len(mesh.notes) < 16


def test_options_move_the_image(tmp_path):
    (tmp_path / "skin.png").write_bytes(encode())
    (tmp_path / "box.mtl").write_text("newmtl m\nmap_Kd -o 0.25 -0.5 -s 2 4 skin.png\n")
    uv = (UV - [0.25, -0.5]) / [2, 4]
    check_box(load_mesh(write_obj(tmp_path / "box.obj", uv=uv, head="mtllib box.mtl\nusemtl m")))


@pytest.mark.parametrize(("encoding", "name"), [("latin-1", "Größe"), ("gb18030", "杯子"), ("shift_jis", "カップ")])
def test_names_in_any_encoding(tmp_path, encoding, name):
    (tmp_path / f"{name}.png").write_bytes(encode())
    (tmp_path / f"{name}.mtl").write_bytes(f"newmtl {name}\nmap_Kd {name}.png\n".encode(encoding))
    text = write_obj(tmp_path / "box.obj", head=f"# {name}\nmtllib {name}.mtl\nusemtl {name}").read_text("utf-8")
    (tmp_path / "box.obj").write_bytes(text.encode(encoding))
    check_box(load_mesh(tmp_path / "box.obj"))


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path):
    """Without its first line an OBJ would lose its materials, or its first vertex."""
    (tmp_path / "t.png").write_bytes(encode())
    (tmp_path / "box.mtl").write_bytes(BYTE_ORDER_MARK + b"newmtl m\nmap_Kd t.png\n")
    for head in ("mtllib box.mtl\nusemtl m", ""):
        path = write_obj(tmp_path / "box.obj", head=head, colours=COLOURS)
        path.write_bytes(BYTE_ORDER_MARK + path.read_bytes())
        with warnings.catch_warnings():
            warnings.simplefilter("error" if head else "ignore")
            check_box(load_mesh(path))


@pytest.mark.parametrize("image", ["box.png", "texture.png", "box_albedo.jpg", "Box.PNG", "material_0.png"])
@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_the_image_beside_a_mesh_is_taken_where_its_name_says_so(tmp_path, image, kind):
    (tmp_path / image).write_bytes(encode("JPEG", quality=95) if image.endswith("jpg") else encode())
    if kind == "obj":
        path = write_obj(tmp_path / "box.obj")
    else:
        vertex = [
            *zip("xyz", ["float"] * 3, VERTICES.T, strict=True),
            ("s", "float", UV[:, 0]),
            ("t", "float", UV[:, 1]),
        ]
        path = write_ply(tmp_path / "box.ply", vertex, [(face,) for face in FACES], face=["vertex_indices uchar int"])
    mesh = load_mesh(path)
    check_box(mesh, atol=6)
    assert any(image in note for note in mesh.notes)
    # A general name says nothing where there are two meshes.
    (tmp_path / "other.obj").write_text("")
    if image in ("texture.png", "material_0.png"):
        with pytest.warns(UserWarning, match="no texture that can be read"):
            assert load_mesh(path).texture is None


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (encode()[:-30], "cannot be read"),
        (b"v/1\x01 not an image", "no image of a format"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 12\n", "Git LFS pointer"),
        (None, "missing"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "no image of a format"),  # would run a program
    ],
)
@pytest.mark.parametrize("coloured", [True, False])
def test_a_broken_texture_is_a_warning_and_colours_stay(tmp_path, data, words, coloured):
    if data is not None:
        (tmp_path / "skin.png").write_bytes(data)
    (tmp_path / "box.mtl").write_text("newmtl m\nmap_Kd skin.png\n")
    rows = COLOURS / 255 if coloured else None
    path = write_obj(tmp_path / "box.obj", head="mtllib box.mtl\nusemtl m", colours=rows)
    with pytest.warns(UserWarning, match=words) as caught:
        mesh = load_mesh(path)
    assert all("\n" not in str(warning.message) for warning in caught)
    assert any(words in note for note in mesh.notes)
    if coloured and data != encode()[:-30]:
        check_box(mesh, atol=0.6)
    assert len(mesh.faces) == 12 and mesh.texture is None


def test_pointers_of_git_lfs_are_named_as_such(tmp_path):
    for kind in ("obj", "ply", "glb", "gltf", "stl"):
        path = tmp_path / f"mesh.{kind}"
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 12345\n")
        with pytest.raises(ValueError, match="Git LFS pointer"):
            load_mesh(path)


@pytest.mark.parametrize(
    "faces",
    [
        ["f " + " ".join(f"{i - 24}/{i - 24}" for i in quad) for quad in QUADS],
        ["f " + " ".join(f"{i + 1}/{i + 1}/1" for i in quad) for quad in QUADS],
        ["f  " + "\t".join(f"{i + 1}/{i + 1}/" for i in quad) + " # a side" for quad in QUADS],
        ["f \\\n" + " \\\n".join(f"{i + 1}/{i + 1}" for i in quad) for quad in QUADS],
        [" f " + " ".join(f"{i + 1}/{i + 1}" for i in quad) + "\r" for quad in QUADS],
        ["o box", "g a", "s 1", *("f " + " ".join(f"{i + 1}/{i + 1}" for i in quad) for quad in QUADS), "l 1 2", "p 1"],
    ],
)
def test_faces_in_many_hands(tmp_path, faces):
    (tmp_path / "box.png").write_bytes(encode())
    check_box(load_mesh(write_obj(tmp_path / "box.obj", faces=faces)))


def test_vertices_between_faces_that_count_backwards(tmp_path):
    lines = []
    for quad in QUADS:
        lines += ["v " + " ".join(f"{x:g}" for x in VERTICES[i]) + " " + " ".join(map(str, COLOURS[i])) for i in quad]
        lines.append("f -4 -3 -2 -1")
    (tmp_path / "box.obj").write_text("\n".join(lines))
    check_box(load_mesh(tmp_path / "box.obj"), atol=0.6)
