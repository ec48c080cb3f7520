"""Meshes: read in every form, refused in words, repaired, normalised, sampled."""

import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ipjax.files.meshes import farthest
from ipjax.files.meshes.cleaning import clean
from ipjax.files.meshes.farthest import largest_distance
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import diameter, make_mesh, normalise
from ipjax.files.meshes.sampling import sample_appearance, sample_surface
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.meshes.textures import sample_texture
from ipjax.networks.dinov2 import Encoder
from ipjax.onboarding import mesh as onboarding


def ball(colours=True):
    shape = trimesh.creation.icosphere(subdivisions=2, radius=1.5)
    paint = np.round((shape.vertices / 3 + 0.5) * 255).astype(np.uint8) if colours else None
    return make_mesh(shape.vertices, shape.faces, colours=paint)


def quad(tmp_path, red=(255, 0, 0)):
    """A textured square: the image's upper left texel is `red`, the rest blue."""
    image = np.full((8, 8, 3), (0, 0, 255), np.uint8)
    image[:4, :4] = red
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    mesh = make_mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), uv=vertices[:, :2], texture=image)
    del tmp_path
    return mesh


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_vertex_colours_survive_writing_and_reading(tmp_path, kind):
    mesh = ball()
    save_mesh(mesh, tmp_path / f"ball.{kind}")
    back = load_mesh(tmp_path / f"ball.{kind}")
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.colours, mesh.colours)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_textures_survive_writing_and_reading(tmp_path, kind):
    mesh = quad(tmp_path)
    save_mesh(mesh, tmp_path / f"quad.{kind}")
    back = load_mesh(tmp_path / f"quad.{kind}")
    assert back.texture is not None and back.uv is not None
    # The corner (0, 1) of the square is red, whatever the format does with v.
    corner = np.argmin(np.abs(back.vertices - [0, 1, 0]).sum(1))
    colour = sample_texture(back.texture, back.uv[corner : corner + 1] * 0.8 + 0.1)
    np.testing.assert_array_equal(colour, [[255, 0, 0]])


def test_stl_is_grey(tmp_path):
    save_mesh(ball(), tmp_path / "ball.stl")
    mesh = load_mesh(tmp_path / "ball.stl")
    assert len(mesh.faces) == 320 and (mesh.colours == mesh.colours[0, 0]).all()
    assert any("grey" in note for note in mesh.notes)


def test_face_colours_stay_flat(tmp_path):
    shape = trimesh.creation.box()
    shape.visual.face_colors = np.random.default_rng(0).integers(0, 255, (12, 4), np.uint8) | np.uint8([0, 0, 0, 255])
    shape.export(tmp_path / "box.ply")
    mesh = load_mesh(tmp_path / "box.ply")
    corner = mesh.colours[mesh.faces]
    assert (corner == corner[:, :1]).all() and len(np.unique(corner[:, 0], axis=0)) == 12


def test_bop_ply_keeps_its_texture(tmp_path):
    Image.fromarray(quad(tmp_path).texture).save(tmp_path / "skin.png")
    rows = ["0 0 0 0 0", "1 0 0 1 0", "1 1 0 1 1", "0 1 0 0 1"]
    head = ["ply", "format ascii 1.0", "comment TextureFile skin.png", "element vertex 4"]
    head += [f"property float {name}" for name in ("x", "y", "z", "texture_u", "texture_v")]
    head += ["element face 2", "property list uchar int vertex_indices", "end_header", *rows, "3 0 1 2", "3 0 2 3"]
    (tmp_path / "quad.ply").write_text("\n".join(head) + "\n")
    mesh = load_mesh(tmp_path / "quad.ply")
    assert mesh.texture is not None and mesh.uv is not None
    np.testing.assert_array_equal(
        sample_texture(mesh.texture, np.array([[0.1, 0.9], [0.9, 0.1]])), [[255, 0, 0], [0, 0, 255]]
    )


def test_scene_graphs_are_baked_and_textures_packed(tmp_path):
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    turn[:3, 3] = [5, 0, 0]
    for name, colour, pose in (("a", (255, 0, 0), np.eye(4)), ("b", (0, 255, 0), turn)):
        mesh = quad(tmp_path, colour)
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(mesh.texture))
        shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        shape.visual = trimesh.visual.TextureVisuals(uv=mesh.uv, material=material)
        scene.add_geometry(shape, geom_name=name, node_name=name, transform=pose)
    grey = trimesh.creation.box()
    scene.add_geometry(grey, geom_name="c", transform=trimesh.transformations.translation_matrix([0, 0, 9]))
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    assert mesh.texture is not None and mesh.uv is not None
    np.testing.assert_allclose(mesh.vertices.max(0)[2], 9.5, atol=1e-6)

    def colour_near(point):
        corner = np.linalg.norm(mesh.vertices - point, axis=1).argmin()
        face = mesh.faces[(mesh.faces == corner).any(1)][0]
        blend = 0.8 * mesh.uv[corner] + 0.2 * mesh.uv[face].mean(0)
        return sample_texture(mesh.texture, blend[None])[0]

    np.testing.assert_array_equal(colour_near([0, 1, 0]), [255, 0, 0])
    np.testing.assert_array_equal(colour_near([4, 0, 0]), [0, 255, 0])  # (0, 1) turned by 90° and moved
    np.testing.assert_array_equal(colour_near([5, 0, 0]), [0, 0, 255])


def test_what_is_no_mesh_is_refused_in_one_sentence(tmp_path):
    def refuse(name, data, words):
        (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
        with pytest.raises(ValueError, match=words) as caught:
            load_mesh(tmp_path / name)
        assert "\n" not in str(caught.value)

    refuse("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "empty|no faces")
    refuse("nan.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite")
    refuse("dot.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "extent")
    refuse("mesh.xyz", "0 0 0", "not a mesh format")
    refuse("junk.ply", b"\x00" * 100, "no PLY header")
    refuse("junk.glb", b"glTF" + b"\x00" * 100, "glTF JSON")
    refuse("huge.ply", "ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n", "promises")
    refuse("huge.stl", b"\x00" * 80 + struct.pack("<I", 2**31) + b"\x00" * 50, "promises")
    tree = {"asset": {"version": "2.0"}, "accessors": [{"count": 10**12, "componentType": 5126, "type": "VEC3"}]}
    refuse("huge.gltf", json.dumps(tree), "accessor")
    with pytest.raises(FileNotFoundError):
        load_mesh(tmp_path / "nothing.obj")


def test_files_outside_the_folder_are_refused(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    (inner / "a.mtl").write_text("newmtl m\nmap_Kd ../secret.png\n")
    (inner / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    with pytest.raises(ValueError, match="outside its own folder"):
        load_mesh(inner / "a.obj")


def test_wrong_arrays_are_refused():
    corner = np.eye(3)
    for vertices, faces, words in (
        (corner, np.array([[0, 1, 3]]), "names vertex"),
        (corner, np.zeros((0, 3), int), "no faces"),
        (corner[:, :2], np.array([[0, 1, 2]]), "shape"),
        (corner * 1e20, np.array([[0, 1, 2]]), "no object"),
        (corner, np.array([[0, 1, 2, 0]]), "triangles"),
    ):
        with pytest.raises(ValueError, match=words):
            make_mesh(vertices, faces)


@given(st.integers(0, 2**32 - 1))
def test_normalising_keeps_the_way_back(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(30, 3)) * 10 ** random.uniform(-3, 3) + random.normal(size=3) * 100
    mesh = make_mesh(points, np.arange(30).reshape(10, 3))
    unit = normalise(mesh)
    gap = np.linalg.norm(unit.vertices[:, None] - unit.vertices[None], axis=-1)
    np.testing.assert_allclose(gap.max(), 1, rtol=1e-9)
    np.testing.assert_allclose(unit.vertices.max(0) + unit.vertices.min(0), 0, atol=1e-9)
    np.testing.assert_allclose(unit.to_file(unit.vertices), points, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(unit.from_file(points), unit.vertices, atol=1e-6)
    again = normalise(unit)
    np.testing.assert_allclose(again.to_file(again.vertices), points, rtol=1e-9, atol=1e-9)


def test_diameter_of_flat_and_thin_meshes():
    square = np.array([[0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0.0]])
    assert diameter(make_mesh(square, np.array([[0, 1, 2], [0, 2, 3]]))) == 5
    line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])
    assert diameter(make_mesh(line, np.array([[0, 1, 2]]))) == 2


BODIES = {
    "sphere": lambda d: d,
    "long": lambda d: d * [1, 0.8, 0.5],
    "disc": lambda d: d * [1, 1, 0.4],
    "rough": lambda d: d * (1 + 1e-3 * np.sin(40 * d[:, :1]) * np.cos(37 * d[:, 1:2])),
    "dome": lambda d: np.abs(d),
    # As wide everywhere as the ball that touches it is far: every point has a partner nearly as far as the farthest.
    "constant width": lambda d: (
        d
        * np.min(
            [
                d @ v + np.sqrt((d @ v) ** 2 - v @ v + 1)
                for v in np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 8**0.5
            ],
            axis=0,
        )[:, None]
    ),
    "cube": lambda d: np.clip(2 * d, -1, 1),
    "circle": lambda d: d / np.linalg.norm(d[:, :2], axis=1, keepdims=True) * [1, 1, 0],
}


@pytest.mark.parametrize("body", BODIES)
def test_the_farthest_two_points_are_those_of_all_pairs(body):
    random = np.random.default_rng(5)
    for count, stretch in ((2, 1), (3, 1), (60, 1e-6), (700, 1e5), (2000, 1)):
        d = random.normal(size=(count, 3))
        points = BODIES[body](d / np.linalg.norm(d, axis=1, keepdims=True)) * stretch + random.normal(size=3) * stretch
        slow = max(np.linalg.norm(points - point, axis=1).max() for point in points)
        np.testing.assert_allclose(largest_distance(points), slow, rtol=2e-9)


@pytest.mark.parametrize("body", BODIES)
def test_the_farthest_two_of_many_points_take_few_comparisons(body, monkeypatch):
    """How many pairs are compared, which is what time and memory are: far fewer than all."""
    compared = []
    real = np.matmul
    monkeypatch.setattr(
        farthest, "_multiply", lambda a, b: compared.append(a.shape[0] * a.shape[1] * b.shape[2]) or real(a, b)
    )
    d = np.random.default_rng(6).normal(size=(20_000, 3))
    points = BODIES[body](d / np.linalg.norm(d, axis=1, keepdims=True))
    found = largest_distance(points)
    assert found > 0 and sum(compared) < 0.15 * len(points) ** 2 / 2
    assert max(compared, default=0) <= farthest.PAIRS


def test_clean_repairs_and_says_so():
    base = ball()
    random = np.random.default_rng(1)
    faces = base.faces.copy()
    turned = random.random(len(faces)) < 0.4
    faces[turned] = faces[turned][:, ::-1]
    soup = faces.reshape(-1)  # three vertices per face: all shared ones are duplicates
    fleck = trimesh.creation.icosphere(subdivisions=0, radius=0.01).apply_translation([3, 0, 0])
    vertices = np.concatenate([base.vertices[soup], fleck.vertices, [[9.0, 9, 9]]])
    index = np.arange(len(soup)).reshape(-1, 3)
    index = np.concatenate([index, index[:5], fleck.faces + len(soup), [[0, 0, 1]]])
    colours = np.concatenate([base.colours[soup], np.zeros((len(fleck.vertices) + 1, 3), np.uint8)])
    mesh, report = clean(make_mesh(vertices, index, colours=colours))
    assert len(mesh.vertices) == len(base.vertices) and len(mesh.faces) == len(base.faces)
    text = "; ".join(report)
    for words in ("without area", "repeated", "components", "outwards", "duplicate"):
        assert words in text
    # All normals point outwards, and so do all windings.
    assert (np.einsum("ni,ni->n", mesh.normals, mesh.vertices) > 1.4).all()
    volume = np.einsum(
        "mi,mi->m", mesh.vertices[mesh.faces[:, 0]], np.cross(*mesh.vertices[mesh.faces[:, 1:]].swapaxes(0, 1))
    )
    assert (volume > 0).all()
    assert clean(mesh)[1] == ("nothing to repair",)
    np.testing.assert_array_equal(clean(mesh)[0].vertices, mesh.vertices)


def test_clean_turns_a_whole_mesh_and_keeps_many_parts():
    base = ball()
    mesh, report = clean(make_mesh(base.vertices, base.faces[:, ::-1], colours=base.colours))
    assert "320" in report[0] and (np.einsum("ni,ni->n", mesh.normals, mesh.vertices) > 0).all()
    # A thing made of nothing but small parts keeps them.
    part = trimesh.creation.box(extents=[0.05] * 3)
    many = trimesh.util.concatenate([part.copy().apply_translation([i % 15, i // 15, 0]) for i in range(150)])
    kept, _ = clean(make_mesh(many.vertices, many.faces))
    assert len(kept.faces) == 150 * 12


def test_surface_samples_are_even_repeatable_and_on_the_surface():
    mesh = normalise(ball())
    points, normals, seen = sample_surface(mesh, 200, seed=3)
    again = sample_surface(mesh, 200, seed=3)
    for one, two in zip((points, normals, seen), again, strict=True):
        np.testing.assert_array_equal(one, two)
    assert (sample_surface(mesh, 200, seed=4)[0] != points).any()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.49, atol=0.015)
    assert (np.einsum("ni,ni->n", normals, points) > 0.45).all() and (seen == 1).all()
    gap = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.eye(200)
    # 200 points on this sphere are at best 0.13 apart; independent ones come within 0.005.
    assert gap.min(1).min() > 0.07
    with pytest.raises(ValueError, match="positive"):
        sample_surface(mesh, 0)


def test_appearance_is_on_the_surface_in_its_colours():
    """A quad with a red left and a blue right half of its texture; and one with red and blue corners."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[:, :4, 0], texture[:, 4:, 2] = 255, 255
    textured = make_mesh(corners, faces, uv=corners[:, :2], texture=texture)
    points, normals, colours = sample_appearance(textured, 500)
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-6)
    np.testing.assert_allclose(np.abs(normals), np.tile([0, 0, 1], (500, 1)), atol=1e-6)
    assert (colours[(points[:, 0] > 0.1) & (points[:, 0] < 0.4), 0] > 200).all()
    assert (colours[(points[:, 0] > 0.6) & (points[:, 0] < 0.9), 2] > 200).all()
    painted = make_mesh(corners, faces, colours=np.array([[255, 0, 0], [0, 0, 255]] * 2, np.uint8)[[0, 1, 3, 2]])
    _, _, mixed = sample_appearance(painted, 500)
    np.testing.assert_allclose(mixed[:, 0], 255 * (1 - points[:, 0]), atol=2)
    np.testing.assert_array_equal(sample_appearance(painted, 500)[2], mixed)
    with pytest.raises(ValueError, match="positive"):
        sample_appearance(painted, 0)


def write_reconstruction(path, parts):
    """An OBJ as image-to-3D systems write it: six numbers to a vertex, the colours as floats, no normals."""
    lines, start = ["# a reconstruction"], 1
    for mesh in parts:
        shades = (0.5 + 0.5 * np.sin(3 * mesh.vertices)).round(8)
        lines += [f"v {' '.join(f'{x:.8f}' for x in (*p, *c))}" for p, c in zip(mesh.vertices, shades, strict=True)]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + start]
        start += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("crumbs", [0, 22])
def test_reconstructions_are_read_with_their_colours_and_lose_their_crumbs(tmp_path, crumbs):
    """A whole body, and specks that float about it."""
    random = np.random.default_rng(5)
    body = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    specks = [
        trimesh.creation.icosphere(subdivisions=0, radius=0.003).apply_translation(0.6 * directions)
        for directions in random.normal(size=(crumbs, 3)) / np.sqrt(3)
    ]
    write_reconstruction(tmp_path / "mesh.obj", [body, *specks])
    mesh = load_mesh(tmp_path / "mesh.obj")
    assert mesh.texture is None
    assert len(mesh.faces) == len(body.faces) + 20 * crumbs
    expected = np.rint(255 * (0.5 + 0.5 * np.sin(3 * mesh.vertices)))
    assert np.abs(mesh.colours - expected).max() <= 1 and len(np.unique(mesh.colours, axis=0)) > 500
    repaired, report = clean(mesh)
    assert len(repaired.faces) == len(body.faces)
    assert any("22 of 23 components" in line for line in report) == bool(crumbs)


class Blind(Encoder):
    """An encoder that is never asked."""

    def __init__(self):
        self.identity = "blind"


@pytest.mark.parametrize("noise", [0.0, 1e-7, 3e-4])
def test_a_line_is_refused_before_it_is_rendered(noise, monkeypatch):
    """Faces of almost no area along a line in space; anything wider is a shape, however flat."""
    random = np.random.default_rng(2)
    ladder = np.linspace(-1, 1, 40)[:, None] * [1.0, 2.0, -0.5] + noise * random.normal(size=(40, 3))
    faces = np.stack([np.arange(38), np.arange(1, 39), np.arange(2, 40)], axis=-1)
    monkeypatch.setattr(onboarding, "render", lambda *_, **__: pytest.fail("rendered"))
    with pytest.raises(ValueError, match=r"lie on a line|no face of the mesh has an area"):
        onboarding.onboard(make_mesh(ladder, faces), Blind())
    flat = ball().vertices * [1, 0.5, 0]
    axes = onboarding.box_axes(normalise(make_mesh(flat, ball().faces)).vertices)
    np.testing.assert_allclose(np.abs(axes[np.abs(axes[:, 2]).argmax()]), [0, 0, 1], atol=1e-6)


def test_the_box_of_a_smooth_body_is_that_of_its_axes():
    """Tens of thousands of corners, of which some are looked at: the box is as small as the axes' own within 2 %."""
    d = np.random.default_rng(3).normal(size=(30_000, 3))
    body = d / np.linalg.norm(d, axis=1, keepdims=True) * [0.5, 0.4, 0.25]
    axes = onboarding.box_axes(body)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    assert np.prod(np.ptp(body @ axes.T, axis=0)) < 1.02 * 1 * 0.8 * 0.5
