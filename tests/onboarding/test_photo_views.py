"""A photo's views: the photo itself, turned, to a fraction of a pixel; each patch knows which part of it it shows."""

import numpy as np
import pytest

from ipjax.cameras import look_at, project, unproject
from ipjax.config import OnboardConfig
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import onboard_photo
from ipjax.onboarding.photo_views import ROLLS, TILT, TILT_ROLLS, TILTS, PhotoSource, photo_poses, turn_photo
from ipjax.synthetic import problems
from ipjax.transforms import Similarity

K = np.array([[700.0, 0, 330.0], [0, 710.0, 215.0], [0, 0, 1]])
SIDE = 112


def paint(rays):
    """A smooth picture of directions [… 2]: what a camera sees along them, in [0, 255]."""
    x, y = rays[..., 0], rays[..., 1]
    return np.stack([128 + 90 * np.sin(12 * x), 128 + 90 * np.cos(15 * y), 128 + 90 * np.sin(9 * (x + y))], axis=-1)


@pytest.fixture(scope="module")
def source():
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1)
    rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    rotation = problems.random_rotation(np.random.default_rng(0))
    pose = Similarity(rotation, np.array([0.3, -0.2, 4.0]), np.ones(()))
    return PhotoSource(np.round(paint(rays)).astype(np.uint8), np.ones((480, 640), bool), pose, K)


def test_all_views_look_at_the_object_from_where_the_photo_was_taken(source):
    poses = photo_poses(source)
    count = ROLLS + TILTS * TILT_ROLLS
    assert poses.scale.shape == (count,)
    distance = np.linalg.norm(source.camera_from_object.translation)
    np.testing.assert_allclose(poses.translation, np.broadcast_to([0, 0, distance], (count, 3)), atol=1e-9)
    eye = source.camera_from_object.inverse().translation
    eyes = -np.einsum("vji,vj->vi", poses.rotation, poses.translation)
    np.testing.assert_allclose(eyes[:ROLLS], np.broadcast_to(eye, (ROLLS, 3)), atol=1e-9)
    cosine = eyes[ROLLS:] @ eye / distance**2
    np.testing.assert_allclose(np.arccos(cosine), TILT, atol=1e-9)
    apart = np.einsum("aij,bij->ab", poses.rotation, poses.rotation)
    assert (np.sort(apart, axis=1)[:, -2] < 2.99).all()  # no view twice


@pytest.mark.parametrize("view", [0, 1, 5])
def test_the_turned_photo_is_what_the_turned_camera_sees(source, view):
    poses = photo_poses(source)
    pose = Similarity(poses.rotation[view], poses.translation[view], poses.scale[view])
    camera = np.array([[260.0, 0, 54.0], [0, 260.0, 57.5], [0, 0, 1]])
    rgb, mask = turn_photo(source, pose, camera, SIDE)
    pixels = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2).astype(float)
    directions = unproject(camera, pixels, np.ones(len(pixels)))
    turned = directions @ (source.camera_from_object.rotation @ pose.rotation.T).T
    exact = paint(turned[:, :2] / turned[:, 2:]).reshape(SIDE, SIDE, 3)
    inner = mask.copy()
    inner[[0, -1]] = inner[:, [0, -1]] = False
    assert inner.mean() > 0.5
    gap = (rgb - exact)[inner]
    # In grey levels; a shift of a tenth of a pixel would be seen: the picture changes by some 5 levels a pixel.
    assert np.abs(gap.mean(0)).max() < 0.1
    assert gap.std() < 0.6
    right, left = np.roll(exact, -1, 1)[inner], np.roll(exact, 1, 1)[inner]
    slope = (right - left) / 2
    assert abs(np.sum(gap * slope) / np.sum(slope**2)) < 0.02  # pixels


def test_outside_the_mask_is_black_and_its_rim_is_not_dark(source):
    yy, xx = np.mgrid[:480, :640]
    masked = PhotoSource(
        np.full((480, 640, 3), 200, np.uint8),
        (xx - 380) ** 2 + (yy - 180) ** 2 < 60**2,
        *(source.camera_from_object, K),
    )
    poses = photo_poses(masked)
    pose = Similarity(poses.rotation[2], poses.translation[2], poses.scale[2])
    rgb, mask = turn_photo(masked, pose, np.array([[500.0, 0, 55.5], [0, 500.0, 55.5], [0, 0, 1]]), SIDE)
    assert (rgb[~mask] == 0).all()
    assert (rgb[mask] == 200).all()
    assert 0 < mask.sum() < mask.size


def test_patches_of_an_object_from_a_photo_know_their_place_in_it():
    """The rays on which the photo's camera sees the points of its patches, against where the patches lie in it."""
    whole = problems.make_frame(3)
    config = OnboardConfig(directions=2, rolls=1, resolution=112, surface=256, appearance=0)
    rgb = np.asarray(whole.rgb)
    made = onboard_photo(
        Photo(rgb), problems.make_encoder(), config, mask=whole.mask, camera=whole.matrix, lrm="inflate", progress=False
    )
    templates, reference = made.templates, made.templates.reference
    assert reference is not None
    assert len(templates.camera_from_object.scale) == ROLLS + TILTS * TILT_ROLLS
    np.testing.assert_array_equal(reference.camera_from_object.rotation, templates.camera_from_object.rotation[0])
    # The photo's pixel of each patch: its centre, seen through the turned camera.
    valid = np.asarray(reference.patches.valid)
    patch = 112 / 8
    inner = valid & (np.asarray(reference.view.mask).reshape(8, 14, 8, 14).mean((1, 3)).reshape(-1) == 1)
    placed = reference.camera_from_object @ reference.patches.points
    seen = np.asarray(project(reference.view.camera, placed))[inner]
    middle = (np.asarray(reference.patches.grid)[inner] + 0.5) * patch - 0.5
    gap = seen - middle
    assert np.abs(gap.mean(0)).max() < 0.05  # pixels
    assert np.abs(gap).max() < 0.6
    # The colours that they have are those of the photo there.
    where = made.info.reference.camera_from_mesh.to_numpy() @ made.info.object_from_mesh.to_numpy().inverse()
    turned = look_at(whole.matrix, project(whole.matrix, where.translation[None])[0])
    rays = unproject(reference.view.camera.to_matrix(), middle, np.ones(len(middle))) @ turned.T
    column, row = np.round(project(whole.matrix, rays)).astype(int).T
    shown = 255 * np.asarray(reference.view.rgb)[tuple(np.round(middle).astype(int).T[::-1])]
    assert np.abs((shown - rgb[row, column]).mean(0)).max() < 2  # grey levels
