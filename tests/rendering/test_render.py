"""Rendering against ray casting, by every backend that works here; the rasteriser always does."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from ipjax.files.meshes.mesh import make_mesh, normalise
from ipjax.onboarding.viewpoints import viewpoints
from ipjax.records import Camera, Similarity
from ipjax.rendering.render import available_backends, render, render_each, render_frames, render_scene


@pytest.fixture(scope="module")
def report():
    return available_backends()


@pytest.fixture(scope="module", params=["raster", "gl"])
def backend(request, report):
    if request.param == "raster":
        assert report["raster"] == "ok"
        return "raster"
    working = [name for name, word in report.items() if word == "ok" and name != "raster"]
    if not working:
        pytest.skip(f"no GL backend: {report}")
    return working[0]


def knot():
    """Two interlocked rings of different colour gradients: occlusion, silhouettes, both orientations of faces."""
    one = trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)
    two = one.copy().apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    two.apply_translation([1.0, 0, 0])
    vertices = np.concatenate([one.vertices, two.vertices])
    faces = np.concatenate([one.faces, two.faces[:, ::-1] + len(one.vertices)])
    colours = np.round(255 * (vertices - vertices.min(0)) / np.ptp(vertices, axis=0)).astype(np.uint8)
    return normalise(make_mesh(vertices, faces, colours=colours))


def camera(fx, fy, cx, cy):
    return Camera(focal=jnp.array([fx, fy], jnp.float32), centre=jnp.array([cx, cy], jnp.float32))


def pose(rotation, translation, scale=1.0):
    return Similarity(jnp.asarray(rotation, jnp.float32), jnp.asarray(translation, jnp.float32), jnp.float32(scale))


def cast(mesh, rotation, translation, fx, fy, cx, cy, height, width):
    """Depth by ray casting, and the colour of the surface there."""
    rows, columns = np.mgrid[:height, :width]
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(rows.shape)], -1).reshape(-1, 3)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    caster = trimesh.ray.ray_triangle.RayMeshIntersector(shape)
    origin = np.broadcast_to(-translation @ rotation, rays.shape)
    place, ray, face = caster.intersects_location(origin, rays @ rotation, multiple_hits=True)
    z = (place @ rotation.T + translation)[:, 2]
    depth, colour = np.zeros(len(rays)), np.zeros((len(rays), 3))
    order = np.argsort(-z)  # the nearest is written last
    weights = trimesh.triangles.points_to_barycentric(mesh.vertices[mesh.faces[face]], place)
    depth[ray[order]] = z[order]
    colour[ray[order]] = np.einsum("kc,kci->ki", weights, mesh.colours[mesh.faces[face]].astype(float))[order]
    return depth.reshape(height, width), colour.reshape(height, width, 3)


def away_from_steps(depth, by=0.01):
    """Pixels whose neighbours are all on the same sheet of the surface."""
    flat = depth > 0
    for axis in (0, 1):
        for step in (-1, 1):
            flat &= np.abs(np.roll(depth, step, axis) - depth) < by
    return flat


def test_templates_agree_with_ray_casting(backend):
    mesh, poses, lens = knot(), viewpoints(5, 1), camera(200, 200, 35.5, 35.5)
    calls = []
    images = render(
        mesh, poses, lens, 72, 72, backend=backend, progress=lambda done, total: calls.append((done, total))
    )
    assert calls == [(i + 1, 5) for i in range(5)] and images.backend == backend and len(images) == 5
    fx, cx = float(lens.focal[0]), float(lens.centre[0])
    for view in range(5):
        rotation = np.asarray(poses.rotation[view], np.float64)
        translation = np.asarray(poses.translation[view], np.float64)
        depth, colour = cast(mesh, rotation, translation, fx, fx, cx, cx, 72, 72)
        wrong = images.mask[view] != (depth > 0)
        assert wrong.sum() <= 2
        inner = away_from_steps(depth, 0.05)
        assert inner.sum() > 200
        assert np.abs(images.depth[view] - depth)[inner].max() < 1e-5
        # Colours come out as they are on the mesh: no light, no blur, no neighbour's texel. GL blends in 8 bits.
        assert np.abs(images.rgb[view] - colour)[inner].max() <= 3
        assert (images.rgb[view][~images.mask[view]] == 0).all()


def test_scene_camera_with_its_own_centre_and_focals(backend):
    """Metres, a wide image, different focals, the principal point off the middle, a scaled object near the border."""
    mesh = knot()
    random = np.random.default_rng(3)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    scale, translation = 0.17, np.array([-0.16, 0.1, 0.71])
    lens = (110.0, 95.0, 47.3, 20.8)
    image = render(mesh, pose(rotation, translation, scale), camera(*lens), 60, 90, backend=backend)
    moved = make_mesh(mesh.vertices * scale, mesh.faces, colours=mesh.colours)
    depth, _ = cast(moved, rotation, translation, *lens, 60, 90)
    assert (image.mask[0] != (depth > 0)).sum() <= 2 and image.mask.sum() > 150
    inner = away_from_steps(depth, 0.01)
    assert np.abs(image.depth[0] - depth)[inner].max() < 1e-5 * scale + 1e-7


def checker():
    """A square, 1 wide, in the xy plane; its texture's quarters are red, green, blue and white, row by row."""
    image = np.full((64, 64, 3), 255, np.uint8)
    image[:32, :32], image[:32, 32:], image[32:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    return make_mesh(corners - [0.5, 0.5, 0], np.array([[0, 1, 2], [0, 2, 3]]), uv=corners[:, :2], texture=image)


@pytest.mark.parametrize("oversample", [1, 3])
def test_textures_are_not_mirrored(backend, oversample):
    upright = np.diag([1.0, -1.0, -1.0])  # the object's y is up in the image, its front to us
    image = render(
        checker(),
        pose(upright, [0, 0, 2.0]),
        camera(50, 50, 19.5, 19.5),
        40,
        40,
        backend=backend,
        oversample=oversample,
    )
    for row, column, colour in (
        (12, 12, (255, 0, 0)),
        (12, 27, (0, 255, 0)),
        (27, 12, (0, 0, 255)),
        (27, 27, (255,) * 3),
    ):
        np.testing.assert_array_equal(image.rgb[0, row, column], colour)
    np.testing.assert_allclose(image.depth[0][image.mask[0]], 2, atol=1e-6)
    rows, columns = np.nonzero(image.mask[0])
    # ±0.5 at depth 2 with focal 50: 12.5 px around the centre, so the pixels 7.0 < x < 32.0.
    assert rows.min() in (7, 8) and rows.max() in (31, 32) and columns.min() in (7, 8) and columns.max() in (31, 32)


def test_scenes_have_instances_and_occlusion(backend):
    near = make_mesh(checker().vertices * 0.3, checker().faces, colours=np.tile(np.uint8([9, 90, 200]), (4, 1)))
    objects = [(checker(), pose(np.eye(3), [0, 0, 2.0])), (near, pose(np.eye(3), [0, 0, 1.0]))]
    image = render_scene(objects, camera(50, 50, 19.5, 19.5), 40, 40, backend=backend)
    assert image.ids is not None
    assert set(np.unique(image.ids)) == {-1, 0, 1} and image.ids[0, 20, 20] == 1 and image.ids[0, 9, 9] == 0
    np.testing.assert_array_equal(image.mask, image.ids >= 0)
    np.testing.assert_allclose(image.depth[image.ids == 1], 1, atol=1e-6)
    np.testing.assert_array_equal(image.rgb[0, 20, 20], [9, 90, 200])
    # Half of the light from ahead, half from everywhere: a surface that faces the light keeps its colour.
    light = {"direction": [0, 0, 1.0], "ambient": 0.5, "diffuse": 0.5}
    turned = [(near, pose(np.diag([1.0, -1.0, -1.0]), [0, 0, 1.0]))]
    lit = render_scene(turned, camera(50, 50, 19.5, 19.5), 40, 40, backend=backend, light=light)
    assert np.abs(lit.rgb[0, 20, 20].astype(int) - [9, 90, 200]).max() <= 2
    light["direction"] = [1.0, 0, 0]
    side = render_scene(turned, camera(50, 50, 19.5, 19.5), 40, 40, backend=backend, light=light)
    assert np.abs(side.rgb[0, 20, 20].astype(int) - [4, 45, 100]).max() <= 3


def test_frames_of_a_scene_are_those_drawn_alone_each_under_its_own_light(backend):
    facing = np.diag([1.0, -1.0, -1.0])
    places = np.array([[0, 0, 2.0], [0.3, 0, 1.5]])
    poses = Similarity(np.stack([facing, facing]), places, np.ones(2))
    light = {"direction": np.array([[0, 0, 1.0], [1.0, 0, 1.0]]), "ambient": 0.3, "diffuse": 0.6}
    heard = []
    frames = render_frames(
        [(checker(), poses)],
        camera(50, 50, 19.5, 19.5),
        40,
        40,
        backend=backend,
        light=light,
        progress=lambda done, total: heard.append((done, total)),
    )
    assert frames.ids is not None and heard == [(1, 2), (2, 2)]
    for index, place in enumerate(places):
        alone = {**light, "direction": light["direction"][index]}
        objects = [(checker(), pose(facing, place))]
        image = render_scene(objects, camera(50, 50, 19.5, 19.5), 40, 40, backend=backend, light=alone)
        assert image.ids is not None
        np.testing.assert_array_equal(frames.rgb[index], image.rgb[0])
        np.testing.assert_allclose(frames.depth[index], image.depth[0], atol=1e-6)
        np.testing.assert_array_equal(frames.ids[index], image.ids[0])
    assert frames.rgb[0].max() > frames.rgb[1].max() + 20
    growing = Similarity(poses.rotation, poses.translation, np.array([1.0, 1.1]))
    with pytest.raises(ValueError, match="keeps its size"):
        render_frames([(checker(), growing)], camera(50, 50, 19.5, 19.5), 40, 40, backend=backend)


def test_one_triangle_and_nothing_in_view(backend):
    triangle = make_mesh(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    poses = Similarity(
        jnp.broadcast_to(jnp.eye(3), (2, 3, 3)), jnp.array([[0, 0, 3.0], [0, 0, -3.0]]), jnp.ones(2, jnp.float32)
    )
    image = render(triangle, poses, camera(10, 10, 7.5, 7.5), 16, 16, backend=backend)
    assert image.mask[0].any() and not image.mask[1].any() and np.isfinite(image.depth).all()
    view = image[0]
    assert view.rgb.dtype == jnp.float32 and view.rgb.shape == (16, 16, 3) and float(view.rgb.max()) <= 1
    np.testing.assert_array_equal(view.mask, image.mask[0])


def test_bad_arguments_are_told():
    triangle, one, lens = make_mesh(np.eye(3), np.array([[0, 1, 2]])), pose(np.eye(3), [0, 0, 3.0]), camera(9, 9, 7, 7)
    for call in (
        lambda: render(triangle, one, lens, 0, 16),
        lambda: render(triangle, one, lens, 16, 16, oversample=2),
        lambda: render(triangle, one, lens, 16, 16, backend="vulkan"),
        lambda: render(triangle, pose(np.eye(3), [0, 0, np.nan]), lens, 16, 16),
        lambda: render(triangle, pose(np.eye(3), [0, 0, 1.0], 0.0), lens, 16, 16),
        lambda: render(triangle, one, camera(0, 9, 7, 7), 16, 16),
        lambda: render_scene([], lens, 16, 16),
    ):
        with pytest.raises(ValueError, match=r"\w+ \w+"):
            call()


def test_each_image_shows_its_own_mesh_with_its_own_texture():
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    colours = [(200, 30, 40), (20, 180, 60), (50, 70, 210)]
    meshes = [
        make_mesh(
            corners,
            np.array([[0, 1, 2], [0, 2, 3]]),
            uv=(corners[:, :2] + 1) / 2,
            texture=np.full((4, 4, 3), colour, np.uint8),
        )
        for colour in colours
    ]
    which = [2, 0, 1, 2]
    pose = Similarity(
        jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32), (4, 3, 3)),
        jnp.broadcast_to(jnp.array([0.0, 0, 4], jnp.float32), (4, 3)),
        jnp.ones(4, jnp.float32),
    )
    camera = Camera(focal=jnp.full(2, 20.0, jnp.float32), centre=jnp.full(2, 7.5, jnp.float32))
    for backend in ("auto", "raster"):
        drawn = render_each(meshes, which, pose, camera, 16, 16, backend=backend)
        middle = drawn.rgb[:, 7, 7].astype(int)
        np.testing.assert_allclose(middle, [colours[i] for i in which], atol=1)
        np.testing.assert_allclose(drawn.depth[:, 7, 7], 4.0, atol=1e-5)
