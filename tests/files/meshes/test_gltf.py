"""glTF as other programs write it: one box with six colours, in every form, is read as the same box."""

import json
import math
import struct

import numpy as np
import pytest
import trimesh
from builders.mesh_files import (
    COLOURS,
    FACES,
    HALF,
    QUADS,
    SIDES,
    UV,
    VERTICES,
    Gltf,
    check_box,
    encode,
    picture,
    read_sides,
)
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import make_mesh
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.meshes.textures import from_linear, to_linear

LIGHT = to_linear(COLOURS / 255)  # glTF keeps colours of vertices as linear light


def integers(values, kind):
    """Values in [−1, 1] as normalised integers of a type."""
    return np.round(values * np.iinfo(kind).max).astype(kind)


@pytest.mark.parametrize("kind", ["u1", "<u2"])
@pytest.mark.parametrize("flag", [True, False])
@pytest.mark.parametrize("width", [3, 4])
def test_colours_of_integers_are_fractions_of_their_type_and_linear(tmp_path, kind, flag, width):
    gltf = Gltf()
    light = np.concatenate([LIGHT, np.zeros((24, 1))], axis=1)[:, :width]
    stride = {(1, 3): 4, (2, 3): 8}.get((np.dtype(kind).itemsize, width), 0)
    gltf.draw(COLOR_0=gltf.put(integers(light, kind), stride, normalized=flag))
    # Eight bits of linear light are steps of up to 13 at the dark end.
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")), atol=8 if kind == "u1" else 1)


@pytest.mark.parametrize("factor", [None, 1.0, 0.5])
def test_a_material_multiplies_colours_by_its_factor_and_by_nothing_else(tmp_path, factor):
    gltf = Gltf()
    surface = {} if factor is None else {"baseColorFactor": [factor, factor, factor, 1]}
    material = gltf.material(metallicFactor=0.3, **surface)
    gltf.draw(material=material, COLOR_0=gltf.put(LIGHT.astype("<f4")))
    wanted = from_linear(to_linear(SIDES / 255) * (factor or 1.0))
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")), wanted, atol=1)


def test_factors_are_linear_light_with_and_without_a_texture(tmp_path):
    gltf = Gltf()
    for side in range(6):
        material = gltf.material(baseColorFactor=[*to_linear(SIDES[side] / 255), 1])
        gltf.draw(
            np.array([[0, 1, 2], [0, 2, 3]]), None, material, POSITION=gltf.put(VERTICES[QUADS[side]].astype("<f4"))
        )
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")), atol=0.6)
    gltf = Gltf()
    material = gltf.skin()
    gltf.tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 0.5, 0.25, 1]
    gltf.draw(material=material, TEXCOORD_0=gltf.uv())
    wanted = from_linear(to_linear(SIDES / 255) * [1, 0.5, 0.25])
    check_box(load_mesh(gltf.save(tmp_path / "skin.glb")), wanted)


@pytest.mark.parametrize("shade", ["even", "uneven"])
def test_a_texture_is_multiplied_by_colours_of_vertices(tmp_path, shade):
    gltf = Gltf()
    light = np.full((24, 3), 0.25) if shade == "even" else np.linspace(0.2, 1, 6).repeat(4)[:, None] * np.ones(3)
    gltf.draw(material=gltf.skin(), TEXCOORD_0=gltf.uv(), COLOR_0=gltf.put(light.astype("<f4")))
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    check_box(mesh, from_linear(to_linear(SIDES / 255) * light[::4]), atol=3)


@pytest.mark.parametrize("kind", ["i1", "u1", "<i2", "<u2"])
def test_quantised_places_and_coordinates(tmp_path, kind):
    """KHR_mesh_quantization: normalised or not, places and texture coordinates; the node has the scale."""
    gltf = Gltf()
    gltf.tree["extensionsRequired"] = gltf.tree["extensionsUsed"] = ["KHR_mesh_quantization"]
    unit = VERTICES / HALF  # in [−1, 1]
    signed = np.dtype(kind).kind == "i"
    rows = integers(unit if signed else unit / 2 + 0.5, kind)
    stride = 4 * rows.dtype.itemsize
    uv = integers(np.stack([UV[:, 0], 1 - UV[:, 1]], axis=-1), kind)
    gltf.draw(
        material=gltf.skin(),
        POSITION=gltf.put(rows, stride, normalized=True),
        TEXCOORD_0=gltf.put(uv, 4 * rows.dtype.itemsize, normalized=True),
    )
    gltf.tree["nodes"][0] |= (
        {"scale": HALF.tolist()} if signed else {"scale": (2 * HALF).tolist(), "translation": (-HALF).tolist()}
    )
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")))
    # Not normalised: the numbers as they are; then the texture's transform has the scale.
    top = float(np.iinfo(kind).max)
    for entry in gltf.tree["accessors"]:
        entry.pop("normalized", None)
    scale = np.array(gltf.tree["nodes"][0]["scale"]) / top
    gltf.tree["nodes"][0]["scale"] = scale.tolist()
    gltf.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = {
        "KHR_texture_transform": {"scale": [1 / top, 1 / top]}
    }
    check_box(load_mesh(gltf.save(tmp_path / "raw.glb")))


@pytest.mark.parametrize("indexed", [True, False])
def test_lists_strips_and_fans_are_the_same_faces(tmp_path, indexed):
    for mode, order in ((4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
        gltf = Gltf()
        material = gltf.skin()
        for quad in QUADS:
            index = quad[order]
            if indexed:
                gltf.draw(index, mode, material, TEXCOORD_0=gltf.uv())
            else:
                place = gltf.put(VERTICES[index].astype("<f4"))
                gltf.draw(None, mode, material, POSITION=place, TEXCOORD_0=gltf.uv(UV[index]))
        check_box(load_mesh(gltf.save(tmp_path / f"box{mode}.glb")))


@given(st.integers(0, 23), st.booleans(), st.integers(0, 2**31))
def test_sparse_accessors_are_the_dense_ones(tmp_path_factory, changed, based, seed):
    """Some rows replaced over a base, or all over zeros."""
    random = np.random.default_rng(seed)
    gltf = Gltf()
    which = np.sort(random.permutation(24)[: changed if based else 24])
    base = VERTICES.copy()
    base[which] = random.normal(size=(len(which), 3))
    place = gltf.put(base.astype("<f4"))
    entry = gltf.tree["accessors"][place]
    if not based:
        del entry["bufferView"]
    if len(which):
        entry["sparse"] = {
            "count": len(which),
            "indices": {"bufferView": gltf.view(which.astype("<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": gltf.view(VERTICES[which].astype("<f4").tobytes())},
        }
    gltf.draw(material=gltf.skin(), POSITION=place, TEXCOORD_0=gltf.uv())
    check_box(load_mesh(gltf.save(tmp_path_factory.mktemp("sparse") / "box.glb")))


@given(st.floats(-3, 3), st.floats(0.2, 3), st.floats(0.2, 3), st.floats(-2, 2), st.floats(-2, 2), st.integers(0, 1))
def test_the_transform_of_a_texture_is_undone_by_its_inverse(tmp_path_factory, angle, sx, sy, ox, oy, channel):
    """KHR_texture_transform: scale, then a turn (counter-clockwise in an image whose v goes down), then an offset."""
    gltf = Gltf()
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, s], [-s, c]]) * [sx, sy]
    down = np.stack([UV[:, 0], 1 - UV[:, 1]], axis=-1)
    moved = (down - [ox, oy]) @ np.linalg.inv(turn).T
    extension = {"offset": [ox, oy], "rotation": angle, "scale": [sx, sy]}
    material = gltf.skin(texCoord=channel, extensions={"KHR_texture_transform": extension})
    names = {
        f"TEXCOORD_{channel}": gltf.put(moved.astype("<f4")),
        f"TEXCOORD_{1 - channel}": gltf.put(down[::-1].astype("<f4")),
    }
    gltf.draw(material=material, **names)
    check_box(load_mesh(gltf.save(tmp_path_factory.mktemp("turn") / "box.glb")))


@pytest.mark.parametrize("how", [33071, 33648])
@pytest.mark.parametrize("parts", [1, 2])
def test_images_go_on_as_their_sampler_says(tmp_path, how, parts):
    """A mirrored image, and one whose border goes on, alone and packed beside another."""
    gltf = Gltf()
    material = gltf.skin()
    gltf.tree["samplers"] = [{"wrapS": how, "wrapT": how}]
    gltf.tree["textures"][0]["sampler"] = 0
    down = np.stack([UV[:, 0], 1 - UV[:, 1]], axis=-1)
    if how == 33648:
        down = 2 - down  # behind the mirror
    else:
        # Everything beyond the right border has the colour of the border there.
        down[:, 0] += 3
    if parts == 1:
        gltf.draw(material=material, TEXCOORD_0=gltf.put(down.astype("<f4")))
    else:
        other = gltf.skin()
        gltf.draw(FACES[:6], None, material, TEXCOORD_0=gltf.put(down.astype("<f4")))
        gltf.draw(FACES[6:], None, other, TEXCOORD_0=gltf.put(down.astype("<f4")) if how == 33071 else gltf.uv())
        gltf.tree["textures"][1]["sampler"] = 0 if how == 33071 else None
        if how != 33071:
            del gltf.tree["textures"][1]["sampler"]
    wanted = SIDES if how == 33648 else SIDES[[2, 2, 2, 5, 5, 5]]
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")), wanted)


def test_nodes_place_mirror_and_repeat_what_they_show(tmp_path):
    gltf = Gltf()
    gltf.draw(material=gltf.skin(), TEXCOORD_0=gltf.uv())
    half = math.sqrt(0.5)
    gltf.tree["nodes"] = [
        {"children": [1, 2], "scale": [2, 2, 2]},
        {"mesh": 0, "scale": [-0.5, 0.5, 0.5]},  # mirrored: faces still look outwards
        {"mesh": 0, "rotation": [0, 0, half, half], "translation": [10, 0, 0], "scale": [0.5, 0.5, 0.5]},
        {"mesh": 0},  # of no scene
    ]
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(mesh.vertices.max(0), [20 + HALF[1], 1.5, 2], atol=1e-6)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    middle = np.where((a[:, :1] > 10), [[20.0, 0, 0]], 0)
    assert (np.einsum("mi,mi->m", np.cross(b - a, c - a), (a + b + c) / 3 - middle) > 0).all()
    one = make_mesh(mesh.vertices, mesh.faces[a[:, 0] < 10], uv=mesh.uv, texture=mesh.texture)
    np.testing.assert_allclose(read_sides(one), SIDES[[1, 0, 2, 3, 4, 5]], atol=2)
    gltf.tree["nodes"] = [{"mesh": 0}]
    gltf.tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    places = gltf.put(np.array([[0, 0, 0], [0, 0, 9], [9, 0, 0]], "<f4"))
    gltf.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
    assert len(load_mesh(gltf.save(tmp_path / "three.glb")).faces) == 36


def test_nodes_morph_the_mesh_that_they_share_each_in_its_own_way(tmp_path):
    gltf = Gltf()
    shift = gltf.put(np.tile(np.array([[10, 0, 0]], "<f4"), (24, 1)))
    gltf.draw(material=gltf.skin(), TEXCOORD_0=gltf.uv())["targets"] = [{"POSITION": shift}]
    gltf.tree["meshes"][0]["weights"] = [0.25]
    gltf.tree["nodes"] = [{"mesh": 0, "weights": [0]}, {"mesh": 0, "weights": [1]}, {"mesh": 0}]
    gltf.tree["scenes"] = [{"nodes": [0, 1, 2]}]
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    places = np.unique(mesh.vertices[:, 0])
    np.testing.assert_allclose(places, np.sort([x + side for x in (0, 2.5, 10) for side in (-1, 1)]))


def test_an_extension_without_an_image_leaves_the_usual_one(tmp_path):
    gltf = Gltf()
    gltf.draw(material=gltf.skin(), TEXCOORD_0=gltf.uv())
    gltf.tree["textures"][0]["extensions"] = {"EXT_texture_webp": {}}
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")))


def test_what_is_required_and_not_handled_is_refused_by_name(tmp_path):
    for name in ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "ACME_shape"):
        gltf = Gltf()
        gltf.draw(material=gltf.skin(), TEXCOORD_0=gltf.uv())
        gltf.tree["extensionsRequired"] = ["KHR_materials_unlit", name]
        with pytest.raises(ValueError, match=name):
            load_mesh(gltf.save(tmp_path / "box.glb"))
    gltf.tree["extensionsRequired"] = ["KHR_materials_unlit", "KHR_materials_ior"]
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")))
    # A part that is only there compressed, in a file that does not say that it is required.
    gltf.tree["extensionsRequired"] = []
    primitive = gltf.tree["meshes"][0]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    check_box(load_mesh(gltf.save(tmp_path / "both.glb")))
    for entry in gltf.tree["accessors"]:
        entry.pop("bufferView")
    with pytest.raises(ValueError, match="KHR_draco"):
        load_mesh(gltf.save(tmp_path / "only.glb"))


@pytest.mark.parametrize("kind", ["WEBP", "JPEG", "TGA", "BMP", "TIFF"])
def test_images_of_many_formats(tmp_path, kind):
    gltf = Gltf()
    options = {"quality": 95} if kind in ("WEBP", "JPEG") else {}
    material = gltf.skin(encode(kind, **options))
    if kind == "WEBP":
        gltf.tree["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
        gltf.tree["extensionsRequired"] = ["EXT_texture_webp"]
    gltf.draw(material=material, TEXCOORD_0=gltf.uv())
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")), atol=8)


@pytest.mark.parametrize("mode", ["P", "RGBA", "LA", "I;16", "1"])
def test_images_of_many_modes(tmp_path, mode):
    image = picture()
    wanted = SIDES.astype(float)
    if mode in ("LA", "I;16", "1"):
        grey = np.asarray(image.convert("L")).astype(int)
        grey = np.where(grey > 127, 255, 0) if mode == "1" else grey
        wide = Image.fromarray((grey * 257).astype(np.uint16))
        image = wide if mode == "I;16" else Image.fromarray(grey.astype(np.uint8)).convert(mode)
        wanted = grey[[8, 8, 8, 24, 24, 24], [8, 24, 40] * 2][:, None].repeat(3, 1)
    else:
        image = image.quantize(16) if mode == "P" else image.copy()
        if mode == "RGBA":
            image.putalpha(0)  # transparency is no colour
    gltf = Gltf()
    gltf.draw(material=gltf.skin(encode("PNG", image)), TEXCOORD_0=gltf.uv())
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")), wanted)


def test_names_may_be_quoted_and_stay_in_the_folder(tmp_path):
    name = "Größe 1 (base) 100%.png"
    (tmp_path / name).write_bytes(encode())
    for uri in (name, "Gr%C3%B6%C3%9Fe%201%20%28base%29%20100%25.png"):
        gltf = Gltf()
        gltf.tree["buffers"][0]["uri"] = "box.bin" if uri == name else "box%2Ebin"
        gltf.draw(material=gltf.skin(uri=uri), TEXCOORD_0=gltf.uv())
        check_box(load_mesh(gltf.save(tmp_path / "box.gltf")))
    (tmp_path / "inner").mkdir()
    for uri in ("../box.bin", "%2e%2e/box.bin", "%2E%2E%2Fbox.bin", str(tmp_path / "box.bin")):
        gltf.tree["buffers"][0]["uri"] = uri
        (tmp_path / "inner" / "box.gltf").write_text(json.dumps(gltf.tree))
        with pytest.raises(ValueError, match="outside its own folder"):
            load_mesh(tmp_path / "inner" / "box.gltf")


def test_bytes_of_colours_that_trimesh_wrote_are_not_linear(tmp_path):
    shape = trimesh.Trimesh(VERTICES, FACES, vertex_colors=COLOURS, process=False)
    shape.export(tmp_path / "box.glb")
    check_box(load_mesh(tmp_path / "box.glb"), atol=0.6)


def test_our_own_glb_keeps_bytes_and_is_linear(tmp_path):
    random = np.random.default_rng(0)
    paint = random.integers(0, 256, (24, 3)).astype(np.uint8)
    paint[:8] = np.arange(8)[:, None]  # the dark end, where sixteen bits are needed
    save_mesh(make_mesh(VERTICES, FACES, colours=paint), tmp_path / "box.glb")
    np.testing.assert_array_equal(load_mesh(tmp_path / "box.glb").colours, paint)
    data = (tmp_path / "box.glb").read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + length])
    entry = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    rows = np.frombuffer(data, "<u2", 96, 28 + length + tree["bufferViews"][entry["bufferView"]]["byteOffset"])
    assert entry["normalized"] and entry["componentType"] == 5123
    np.testing.assert_allclose(rows.reshape(24, 4)[:, :3] / 65535, to_linear(paint / 255), atol=1e-5)


def test_what_shines_of_itself_is_seen(tmp_path):
    gltf = Gltf()
    material = gltf.skin()
    entry = gltf.tree["materials"][material]
    entry["emissiveTexture"] = entry["pbrMetallicRoughness"].pop("baseColorTexture")
    entry["pbrMetallicRoughness"]["baseColorFactor"] = [0, 0, 0, 1]
    entry["emissiveFactor"] = [1, 1, 1]
    gltf.draw(material=material, TEXCOORD_0=gltf.uv())
    check_box(load_mesh(gltf.save(tmp_path / "box.glb")))
    entry["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.5, 0.5, 1]}
    entry["emissiveFactor"] = [0.5, 0.5, 0.5]
    check_box(load_mesh(gltf.save(tmp_path / "half.glb")))
    entry["pbrMetallicRoughness"] = {}
    entry.pop("emissiveFactor")
    entry["extensions"] = {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}}
    check_box(load_mesh(gltf.save(tmp_path / "gloss.glb")))
