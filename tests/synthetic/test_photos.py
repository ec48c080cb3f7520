"""Photos of one object alone: the true pose and the true angle are true, and the product finds the object by itself."""

import jax.numpy as jnp
import numpy as np
import pytest

from ipjax.cameras import project
from ipjax.onboarding.foreground import Photo, find_foreground
from ipjax.records import Camera, Similarity
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.photos import make_photo
from ipjax.transforms import rotation_from_vector

CAMERA = Camera(focal=jnp.asarray([600.0, 590.0]), centre=jnp.asarray([322.0, 238.0]))
SEEN = Similarity(rotation_from_vector(np.array([0.4, -0.7, 0.2])), np.array([0.12, -0.05, 0.6]), np.asarray(0.15))


@pytest.fixture(scope="module")
def mesh():
    return make_object("bottle", 3)


@pytest.fixture(scope="module")
def photo(mesh):
    return make_photo(mesh, SEEN.to_jax(), CAMERA, 5)


def test_the_object_is_where_the_pose_says(mesh, photo):
    """Its vertices and the mask cover the same pixels, from border to border."""
    pixels = project(photo.matrix, photo.camera_from_object.to_numpy() @ mesh.vertices)
    rows, columns = np.nonzero(photo.mask)
    shown = np.stack([columns, rows], -1)
    np.testing.assert_allclose(shown.min(0), pixels.min(0), atol=1.5)
    np.testing.assert_allclose(shown.max(0), pixels.max(0), atol=1.5)
    assert float(photo.camera_from_object.scale) == pytest.approx(0.15)


def test_the_angle_is_that_between_the_directions_to_both_cameras(photo):
    first, second = (pose.to_numpy().inverse().translation for pose in (SEEN.to_jax(), photo.camera_from_object))
    cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
    assert np.degrees(np.arccos(cosine)) == pytest.approx(photo.angle, abs=1e-3)
    assert 25 <= photo.angle <= 35


def test_its_background_is_plain_and_the_object_is_found_without_a_mask(photo):
    found = find_foreground(Photo(photo.rgb))
    assert found.method == "background"
    assert (found.mask & photo.mask).sum() / (found.mask | photo.mask).sum() > 0.9


def test_seeds_decide(mesh, photo):
    again, other = (make_photo(mesh, SEEN.to_jax(), CAMERA, seed) for seed in (5, 6))
    np.testing.assert_array_equal(again.rgb, photo.rgb)
    assert other.angle != photo.angle and (other.rgb != photo.rgb).any()


def test_angles_out_of_order_are_refused(mesh):
    with pytest.raises(ValueError, match="180 degrees, the smaller first"):
        make_photo(mesh, SEEN.to_jax(), CAMERA, angles=(40.0, 30.0))
