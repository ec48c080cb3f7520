"""Drawn objects and scenes: the truth that comes with them is true. One scene without noise, one with."""

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ipjax.synthetic.objects import KINDS, make_object
from ipjax.synthetic.scenes import make_scene
from ipjax.synthetic.sensor import PERFECT
from ipjax.synthetic.textures import make_texture


@pytest.fixture(scope="module")
def objects():
    return [make_object("corner"), make_object("drum")]


@pytest.fixture(scope="module")
def scene(objects):
    return make_scene(objects, 3, sizes=(0.2, 0.15), clutter=1, sensor=PERFECT, oversample=1, least_visible=0.7)


def find_depths(mesh, pose, matrix, rows, columns):
    """Where the rays of some pixels first meet a mesh: depth along z, metres; inf where they miss."""
    import trimesh

    rotation, scale = np.asarray(pose.rotation, float), float(pose.scale)
    vertices = scale * mesh.vertices @ rotation.T + np.asarray(pose.translation, float)
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(matrix).T
    shape = trimesh.Trimesh(vertices, mesh.faces, process=False)
    places, ray, _ = shape.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    depth = np.full(len(rays), np.inf)
    np.minimum.at(depth, ray, places[:, 2])
    return depth


@pytest.mark.parametrize("kind", KINDS)
def test_objects_are_normalised_and_textured(kind):
    mesh = make_object(kind)
    assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.normals).all()
    np.testing.assert_allclose(mesh.vertices.min(0) + mesh.vertices.max(0), 0, atol=1e-6)
    reach = np.linalg.norm(mesh.vertices[:, None, :] - mesh.vertices[None, ::7], axis=-1).max()
    assert 0.97 < reach <= 1 + 1e-5
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
    assert mesh.texture is not None and mesh.texture.std() > 10
    assert mesh.uv is not None and mesh.uv.min() >= -1e-6 and mesh.uv.max() <= 1 + 1e-6


def test_seeds_decide():
    one, same, other = make_object("pot", 1), make_object("pot", 1), make_object("pot", 2)
    np.testing.assert_array_equal(one.vertices, same.vertices)
    np.testing.assert_array_equal(make_texture(1), make_texture(1))
    assert one.vertices.shape != other.vertices.shape or np.abs(one.vertices - other.vertices).max() > 1e-3
    assert np.abs(make_texture(1).astype(int) - make_texture(2)).mean() > 5


def test_depth_is_that_of_the_mesh_at_its_pose(objects, scene):
    """Rays through the mask's pixels meet the object where the depth image says, in metres."""
    rng = np.random.default_rng(0)
    for mesh, mask, pose in zip(objects, scene.masks, scene.camera_from_object, strict=True):
        rows, columns = np.nonzero(mask)
        assert len(rows) > 200
        chosen = rng.choice(len(rows), 100, replace=False)
        expected = find_depths(mesh, pose, scene.matrix, rows[chosen], columns[chosen])
        off = np.abs(expected - scene.depth[rows[chosen], columns[chosen]])
        assert np.median(off) < 1e-4 and np.mean(off < 1e-3) > 0.95


def test_shapes_masks_and_sizes(scene):
    assert scene.rgb.shape == (480, 640, 3) and scene.rgb.dtype == np.uint8
    assert scene.depth.shape == (480, 640) and scene.masks.shape == (2, 480, 640)
    assert not (scene.masks[0] & scene.masks[1]).any()
    np.testing.assert_allclose([float(pose.scale) for pose in scene.camera_from_object], (0.2, 0.15), rtol=1e-6)
    for pose in scene.camera_from_object:
        rotation = np.asarray(pose.rotation, float)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(rotation) > 0
    assert (scene.visible >= 0).all() and (scene.visible <= 1).all()
    assert scene.depth.min() > 0.1  # a perfect sensor loses nothing


def test_the_sensor_loses_and_shifts_depth(objects, scene):
    noisy = make_scene(objects, 3, sizes=(0.2, 0.15), clutter=1, oversample=1, least_visible=0.7)
    lost = noisy.depth == 0
    assert 0.005 < lost.mean() < 0.4
    off = np.abs(noisy.depth - scene.depth)[~lost]
    assert 2e-4 < np.median(off) < 0.01
    np.testing.assert_array_equal(noisy.masks, scene.masks)


def test_objects_touch_where_that_is_wanted():
    """Half a millimetre apart on the table, as solid things can be."""
    mesh = make_object("carton")
    sizes = (0.2, 0.2, 0.2)
    made = make_scene([mesh] * 3, 1, sizes=sizes, clutter=0, touching=True, sensor=PERFECT, oversample=1)
    clouds = [pose.to_numpy() @ mesh.vertices for pose in made.camera_from_object]
    gaps = [cKDTree(a).query(b)[0].min() for a, b in itertools.pairwise(clouds)]
    assert max(gaps) < 0.02 and min(gaps) > 4e-4  # vertices lie apart from one another on their surfaces


def test_bad_inputs_are_refused_in_words(objects):
    with pytest.raises(ValueError, match="unknown kind"):
        make_object("teapot")
    with pytest.raises(ValueError, match="at least one object"):
        make_scene([])
    with pytest.raises(ValueError, match="2 objects need as many positive sizes"):
        make_scene(objects, sizes=[0.1])
