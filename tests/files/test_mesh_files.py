"""Mesh files as other programs write them: one box with six colours, in every form, is read as the same box."""

import json
import math
import struct
import warnings

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from mesh_files import (
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
    write_obj,
    write_ply,
)
from PIL import Image

from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import diameter, make_mesh
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.meshes.textures import from_linear, sample_texture, to_linear

LIGHT = to_linear(COLOURS / 255)  # glTF keeps colours of vertices as linear light


# --- glTF ----------------------------------------------------------------------------------------------------------


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


# --- many textures -------------------------------------------------------------------------------------------------


def test_parts_of_every_kind_are_packed_without_loss(tmp_path):
    """A texture that repeats, a small one, a gradient of vertices, a flat colour, nothing: each keeps its colours."""
    gltf = Gltf()
    uv, gradient = UV.copy(), LIGHT.copy()
    uv[:4] += [3, -2]  # whole images away
    gradient[8:12] = to_linear(np.array([[120, 120, 120], [200, 100, 60], [100, 200, 150], [140, 160, 200]]) / 255)
    image = picture().resize((480, 320), Image.Resampling.NEAREST)
    large = gltf.skin(encode("PNG", image))
    small = gltf.skin()
    flat = gltf.material(baseColorFactor=[*to_linear(SIDES[3] / 255), 1])
    gltf.draw(FACES[:2], None, large, TEXCOORD_0=gltf.uv(uv))
    gltf.draw(FACES[2:4], None, small, TEXCOORD_0=gltf.uv())
    gltf.draw(FACES[4:6], COLOR_0=gltf.put(gradient.astype("<f4")))
    gltf.draw(FACES[6:8], None, flat)
    gltf.draw(FACES[8:10], COLOR_0=gltf.put(LIGHT.astype("<f4")))
    gltf.draw(FACES[10:])
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    wanted = SIDES.astype(float)
    wanted[2], wanted[5] = np.nan, 160
    check_box(mesh, wanted)
    # Over the two triangles of the third side colours blend as they do between vertices.
    side = np.flatnonzero(mesh.vertices[mesh.faces][:, :, 1].min(1) > 1.4)
    random = np.random.default_rng(0)
    corner = from_linear(gradient[8:12])[[[0, 1, 2], [0, 2, 3]]].astype(float)
    for face in side:
        weights = random.dirichlet(np.ones(3), 50)
        found = sample_texture(mesh.texture, weights @ mesh.uv[mesh.faces[face]])
        blends = [weights @ corner[i] for i in range(2)]
        assert min(np.abs(found - blend).max() for blend in blends) <= 2


@pytest.mark.parametrize("repeats", [3, 40, 500])
def test_an_image_that_repeats_stays_small_in_a_packed_texture(tmp_path, repeats):
    gltf = Gltf()
    uv = UV.copy()
    uv[:4] = (np.array([[0, 0], [1, 0], [1, 1], [0, 1]])) * repeats
    grain = np.zeros((64, 64, 3), np.uint8)
    grain[:, :, 0] = 200
    one, two = gltf.skin(encode("PNG", Image.fromarray(grain))), gltf.skin()
    gltf.draw(FACES[:2], None, one, TEXCOORD_0=gltf.uv(uv))
    gltf.draw(FACES[2:], None, two, TEXCOORD_0=gltf.uv(uv))
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    assert max(mesh.texture.shape) <= 4400
    wanted = SIDES.copy()
    wanted[0] = [200, 0, 0]
    check_box(mesh, wanted, atol=6)


# --- OBJ -----------------------------------------------------------------------------------------------------------


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


MARK = b"\xef\xbb\xbf"


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path):
    """Without its first line an OBJ would lose its materials, or its first vertex."""
    (tmp_path / "t.png").write_bytes(encode())
    (tmp_path / "box.mtl").write_bytes(MARK + b"newmtl m\nmap_Kd t.png\n")
    for head in ("mtllib box.mtl\nusemtl m", ""):
        path = write_obj(tmp_path / "box.obj", head=head, colours=COLOURS)
        path.write_bytes(MARK + path.read_bytes())
        with warnings.catch_warnings():
            warnings.simplefilter("error" if head else "ignore")
            check_box(load_mesh(path))
    path = write_ply(tmp_path / "box.ply", PAINTED, [(q,) for q in QUADS], face=["vertex_indices uchar int"])
    path.write_bytes(MARK + path.read_bytes())
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


# --- PLY -----------------------------------------------------------------------------------------------------------

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


# --- STL -----------------------------------------------------------------------------------------------------------


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
    for mark in (b"", MARK):
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


# --- files of other people's reports ---------------------------------------------------------------------------------

WRONG_FIELD = from_linear(SIDES / 255)  # sRGB where the format says linear light: shown as the format says
CASES = {
    "mesh_control/control.glb": None,
    "glb_draco/draco.glb": "KHR_draco_mesh_compression",
    "glb_draco/draco_part.glb": "KHR_draco_mesh_compression",
    "glb_draco/meshopt.glb": "EXT_meshopt_compression",
    "glb_webp/basisu.glb": "KHR_texture_basisu",
    "glb_linear/texture_times_vertex.glb": from_linear(to_linear(SIDES / 255) * 0.25),
    "glb_linear/vertex_u8_material.glb": from_linear(SIDES / 255 * 0.8),
    **{
        f"glb_linear/{name}.glb": WRONG_FIELD
        for name in [
            "vec3_u16_padded",
            "vec4_u16",
            "vertex_rgba_alpha0",
            "vertex_u16_flag",
            "vertex_u16_flag_material",
            "vertex_u16_noflag",
            "vertex_u16_noflag_material",
            "vertex_u8_material_nofactor",
            "vertex_u8_uv_nomaterial",
        ]
    },
    "glb_modes/interleaved_col.glb": WRONG_FIELD,
    "glb_modes/interleaved_vec3u16.glb": WRONG_FIELD,
    **{
        f"glb_linear/{name}.glb": None
        for name in ["emissive", "factors", "specgloss", "vertex_float", "vertex_uint16n", "vertex_uint8n"]
    },
    **{
        f"glb_modes/{name}.glb": None
        for name in [
            "fan6",
            "interleaved_tex",
            "no_indices",
            "one_fan",
            "other_scene",
            "sparse",
            "sparse_over_base",
            "strip5",
        ]
    },
    **{
        f"glb_quantised/{name}.glb": None
        for name in ["core_uv_uint16n", "gltfpack_all", "pos_int16n", "pos_uint16", "uv_uint16n", "uv_uint8n"]
    },
    "glb_uvset/texcoord1.glb": None,
    "glb_uvset/texture_transform.glb": None,
    "glb_webp/plain_webp.glb": None,
    "glb_webp/trellis2.glb": None,
    **{f"gltf_percent/{name}.gltf": None for name in ("plain", "encoded_both", "encoded_image")},
    **{f"obj_{name}/box.obj": None for name in ("case", "kd", "latin1", "options")},
    "obj_gbk/杯子.obj": None,
    "obj_triposr_bake/mesh.obj": None,
    "obj_lfs_pointer/mesh.obj": "Git LFS pointer",
    **{f"obj_{name}/box.obj": 160 for name in ("broken_tex", "exr_tex", "lfs_pointer")},
    **{
        f"obj_vcol/{name}.obj": None
        for name in [
            "missing_mtl",
            "plain",
            "plain255",
            "uv_no_mtl",
            "v01",
            "v01_alpha",
            "v01_mtl",
            "v255",
            "white_mtl",
        ]
    },
    **{
        f"ply_odd/{name}.ply": None
        for name in [
            "big_endian",
            "crlf",
            "crlf_bin",
            "diffuse_red",
            "face_colours",
            "float255",
            "float_colours",
            "little_double_alpha",
            "mixed_ascii",
            "mixed_bin",
            "plain",
            "quads_ascii",
            "quads_bin",
            "tristrips",
            "ushort16",
            "ushort_colours",
            "uv_s",
            "uv_texture_s",
            "uv_texture_u",
            "uv_u",
            "vcol_and_uv",
            "vcol_and_uv_missingtex",
            "wedge",
            "wedge_two",
            "wedge_white",
        ]
    },
    "ply_odd/cloud.ply": "point cloud",
    "ply_odd/splat.ply": "Gaussians",
    **{
        f"stl_odd/{name}": 160
        for name in ("ascii.stl", "ascii_latin1.stl", "ascii_upper.stl", "binary.STL", "binary_solid.stl")
    },
}


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", CASES)
def test_files_of_reports(shared, name):
    path, wanted = shared / "data" / "bug_cases" / name, CASES[name]
    if isinstance(wanted, str):
        with pytest.raises(ValueError, match=wanted):
            load_mesh(path)
        return
    wanted = SIDES if wanted is None else np.broadcast_to(wanted, (6, 3))
    # Eight bits of linear light, and of a lossy image, are off by some steps.
    check_box(load_mesh(path), wanted, atol=6 if "uint8n" in name or "webp" in name else 2.5)


def test_no_file_of_reports_is_forgotten(shared):
    root = shared / "data" / "bug_cases"
    kinds = (".glb", ".gltf", ".obj", ".ply", ".stl")
    files = {str(path.relative_to(root)) for path in root.rglob("*") if path.suffix.lower() in kinds}
    others = {f"ply_odd/{name}.ply" for name in ("far_double", "far_float", "pentagons", "pentagons_bin")}
    assert files - set(CASES) - others == {
        "ball/ball_6.ply",
        "glb_quantised/two_parts_int16n.glb",
        "stl_odd/two_solids.stl",
    }
    for name, extents in (
        ("far_double", [0.1, 0.15, 0.2]),
        ("far_float", [0.1, 0.15, 0.2]),
        ("pentagons_bin", [1.809, 1.902, 2]),
    ):
        mesh = load_mesh(root / "ply_odd" / f"{name}.ply")
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), extents, atol=1e-3)
    assert len(load_mesh(root / "ply_odd" / "pentagons.ply").faces) == len(mesh.faces) == 16
    np.testing.assert_allclose(
        np.ptp(load_mesh(root / "glb_quantised/two_parts_int16n.glb").vertices, axis=0), [2, 3, 6.5], atol=1e-3
    )
    assert len(load_mesh(root / "stl_odd/two_solids.stl").faces) == 24
    assert abs(diameter(load_mesh(root / "ball/ball_6.ply")) - 0.066) < 1e-6
