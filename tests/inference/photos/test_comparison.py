"""The query drawn into the photo's view lies where the photo's camera sees it, and the picture says so."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from builders.estimates import make_estimate
from builders.photo_pairs import estimate_at_the_truth, make_photo_pair

from ipjax.cameras import project
from ipjax.inference.photos.comparison import compare_with_photo, photo_panels
from ipjax.inference.photos.drawing import draw_query_into_photo, reference_from_query
from ipjax.synthetic import problems

ANGLES = {0: 15, 1: 30, 2: 45}


@pytest.fixture(scope="module")
def pairs():
    return {seed: make_photo_pair(seed, angle) for seed, angle in ANGLES.items()}


def shifts(pair, drawing):
    """Of every drawn pixel, how far it is from where the photo's camera sees what it shows (pixels)."""
    coordinate = (drawing.rgb - 0.5) / 0.45  # the ellipsoid's colour says where on it we are
    whole = drawing.shown & np.asarray(pair.reference.view.mask)
    whole &= np.abs(np.linalg.norm(coordinate, axis=-1) - 1) < 0.03  # not the rim, mixed with the wall
    assert whole.sum() > 0.7 * drawing.shown.sum()
    matrix = pair.reference.view.camera.to_matrix()
    expected = project(matrix, pair.photo_from_ellipsoid @ (coordinate[whole] * problems.AXES))
    return np.argwhere(whole)[:, ::-1] - expected


@pytest.mark.parametrize("seed", ANGLES)
def test_the_photos_camera_is_what_the_pose_was_made_of(pairs, seed):
    pair = pairs[seed]
    found, true = estimate_at_the_truth(pair)[0], pair.reference_from_query
    camera = reference_from_query(pair.reference, found.camera_from_object)
    np.testing.assert_allclose(camera.rotation, true.rotation, atol=1e-5)
    np.testing.assert_allclose(camera.translation, true.translation, atol=1e-5)
    np.testing.assert_allclose(camera.scale, 1, atol=1e-6)


@pytest.mark.parametrize("seed", ANGLES)
def test_the_query_is_drawn_where_the_photo_sees_it(pairs, seed):
    pair = pairs[seed]
    apart = shifts(pair, draw_query_into_photo(pair.templates, pair.query, estimate_at_the_truth(pair)[0]))
    print(apart.mean(axis=0), apart.std(axis=0))
    assert np.abs(apart.mean(axis=0)).max() < 0.3
    assert np.abs(apart).mean() < 0.5


@pytest.mark.parametrize("larger", [0.8, 1.25])
@pytest.mark.parametrize("seed", ANGLES)
def test_a_given_size_does_not_move_the_drawing(pairs, seed, larger):
    """The object is moved along the ray then, and the photo's camera must not be."""
    pair = pairs[seed]
    found, behind = estimate_at_the_truth(pair, larger)
    drawing = draw_query_into_photo(pair.templates, pair.query, found)
    distance = pair.photo_from_ellipsoid.translation[2]
    print(drawing.behind / distance, behind / distance)
    assert abs(drawing.behind - behind) < 0.03 * distance
    assert np.abs(shifts(pair, drawing).mean(axis=0)).max() < 0.3


def test_the_picture_shows_photo_query_and_both(pairs):
    pair = pairs[0]
    found = estimate_at_the_truth(pair)[0]
    page = compare_with_photo(pair.templates, pair.query, found, "mug", side=224)
    assert page.dtype == np.uint8 and page.shape[1] == 3 * 224 + 4 * 14
    photo, alone, both = (x.astype(int) for x in photo_panels(pair.templates, pair.query, found, 224))
    middle = np.s_[80:144, 80:144]
    assert photo[middle].std() > 5
    np.testing.assert_allclose(alone[middle], photo[middle], atol=12)
    np.testing.assert_allclose(both[middle], photo[middle], atol=12)
    turned = found.camera_from_object.rotation @ jnp.asarray([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    wrong = make_estimate(dataclasses.replace(found.camera_from_object, rotation=turned))
    assert np.abs(photo_panels(pair.templates, pair.query, wrong, 224)[1][middle] - photo[middle]).mean() > 30


def test_without_a_pose_only_the_photo_is_shown(pairs):
    pair = pairs[0]
    found = estimate_at_the_truth(pair)[0]
    none = dataclasses.replace(found, success=jnp.asarray(False))
    photo, alone, _ = photo_panels(pair.templates, pair.query, none, 224)
    assert photo[80:144, 80:144].std() > 5
    assert alone[:60, :60].reshape(-1, 3).std(axis=0).max() < 1 and (alone != photo).any()
    with pytest.raises(ValueError, match="no pose was found"):
        draw_query_into_photo(pair.templates, pair.query, none)


def test_an_object_without_such_a_photo_is_refused(pairs):
    pair = pairs[0]
    scan = dataclasses.replace(pair.templates, reference=None)
    with pytest.raises(ValueError, match="keeps no photo"):
        compare_with_photo(scan, pair.query, estimate_at_the_truth(pair)[0])
    with pytest.raises(ValueError, match="keeps no photo"):
        draw_query_into_photo(scan, pair.query, estimate_at_the_truth(pair)[0])
