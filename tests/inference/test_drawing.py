"""Pictures: lines and outlines fall on the pixels that the pose says."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from builders.estimates import make_estimate
from PIL import Image

from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.cards import Evidence
from ipjax.inference.drawing import draw, draw_overlay, silhouette, write_image
from ipjax.records import Similarity

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
INFO = ObjectInfo("ball", "none", vertices=np.asarray(BALL.vertices), faces=np.asarray(BALL.faces))


def placed(x=0.0, y=0.0, z=1.0, scale=0.3) -> Similarity:
    return Similarity(jnp.eye(3), jnp.asarray([x, y, z], jnp.float32), jnp.asarray(scale, jnp.float32))


def test_the_silhouette_of_a_ball_is_its_disc():
    vertices = 0.3 * np.asarray(BALL.vertices) + [0.1, -0.05, 1.0]
    cover = silhouette(vertices, np.asarray(BALL.faces), K, 240, 320)
    y, x = np.mgrid[:240, :320]
    rays = np.stack([(x - 159.5) / 300, (y - 119.5) / 300, np.ones_like(x)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ [0.1, -0.05, 1.0]
    disc = np.dot([0.1, -0.05, 1.0], [0.1, -0.05, 1.0]) - along**2 < 0.15**2
    assert (cover & disc).sum() / (cover | disc).sum() > 0.96  # the ball has flat faces


def test_faces_behind_the_camera_are_left_out():
    cover = silhouette(0.3 * np.asarray(BALL.vertices) + [0, 0, -1.0], np.asarray(BALL.faces), K, 60, 80)
    assert not cover.any()


def test_the_overlay_marks_the_object_and_leaves_the_rest():
    photo = np.full((240, 320, 3), 90, np.uint8)
    drawn = draw_overlay(photo, K, [placed()], [INFO])
    changed = (drawn != photo).any(-1)
    rows, columns = np.nonzero(changed)
    # Half of the ball is 0.15 m at 1 m: 45 pixels; the box's near side is at 0.85 m, and lines have a width.
    assert 40 < 159.5 - columns.min() < 62 and 40 < columns.max() - 159.5 < 62
    assert 40 < 119.5 - rows.min() < 62 and 40 < rows.max() - 119.5 < 62
    assert changed[119, 159] and photo.max() == 90
    red = (drawn[..., 0] > 200) & (drawn[..., 1] < 110) & (drawn[..., 2] < 110)
    assert red[115:125, 165:195].any() and not red[115:125, 100:150].any()  # the x axis points right


def test_zooming_moves_nothing():
    photo = np.zeros((240, 320, 3), np.uint8)
    small = draw_overlay(photo, K, [placed(0.1, 0.05)], [INFO]).any(-1)
    large = draw_overlay(photo, K, [placed(0.1, 0.05)], [INFO], height=720).any(-1)
    centre = lambda image: np.mean(np.nonzero(image), axis=1)
    np.testing.assert_allclose((centre(large) + 0.5) / 3 - 0.5, centre(small), atol=1.5)


@pytest.mark.parametrize("pose", [placed(z=-1.0), placed(z=0.05), placed(x=50.0), placed(scale=1e6)])
def test_absurd_poses_do_no_harm(pose):
    drawn = draw_overlay(np.zeros((60, 80, 3), np.uint8), K, [pose], [INFO])
    assert drawn.shape == (60, 80, 3)


def test_the_page_holds_photo_cards_and_pairs():
    rng = np.random.default_rng(0)
    photo = rng.integers(0, 60, (240, 320, 3), dtype=np.uint8)
    crop = np.zeros((56, 56, 3), np.float32)
    points = rng.uniform(5, 50, (30, 2))
    proof = Evidence(crop, np.zeros((28, 28, 3), np.uint8), points, points / 56, np.arange(30) % 3 > 0)
    page = draw(photo, K, make_estimate(placed()), INFO, proof, height=480)
    assert page.dtype == np.uint8 and page.shape[0] >= 480 and page.shape[1] > 640 + 500
    without = draw(
        photo, K, make_estimate(placed()), INFO, dataclasses.replace(proof, inlier=np.zeros(30, bool)), height=480
    )
    assert (page != without).any()
    two = draw(photo, K, [make_estimate(placed()), make_estimate(placed(0.2))], [INFO, INFO], [proof, None], height=480)
    assert two.shape[1] > page.shape[1] - 200
    nothing = draw(photo, K, make_estimate(placed(), success=False), INFO, height=480)
    np.testing.assert_array_equal(nothing[14:494, 14:654], draw_overlay(photo, K, [], [], height=480))


def test_lists_of_different_length_are_refused():
    with pytest.raises(ValueError, match="2 objects"):
        draw(np.zeros((24, 32, 3), np.uint8), K, make_estimate(placed()), [INFO, INFO])


def test_pictures_are_written_whole_or_not_at_all(tmp_path):
    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    write_image(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), picture)
    with pytest.raises(ValueError, match="gif"):
        write_image(tmp_path / "a.gif", picture)
    with pytest.raises(OSError):
        write_image(tmp_path / "none" / "a.png", picture)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_card_tells_of_doubt():
    """An absent object and a loose turn each add a line to the card."""
    photo = np.full((240, 320, 3), 90, np.uint8)
    sure = draw(photo, K, make_estimate(placed()), INFO, height=480)
    guess = draw(photo, K, make_estimate(placed(), present=False), INFO, height=480)
    loose = draw(photo, K, make_estimate(placed(), turn=1.5), INFO, height=480)
    assert (guess != sure).any() and (loose != sure).any()


def test_a_size_that_was_given_is_not_told_as_exact():
    """Rounded to ± 0.0 mm is another thing than not estimated at all."""
    photo = np.full((240, 320, 3), 90, np.uint8)
    given, exact = (
        draw(photo, K, dataclasses.replace(make_estimate(placed()), scale_std=jnp.float32(std)), INFO, height=480)
        for std in (0, 1e-9)
    )
    assert (given != exact).any()
