"""What cropping, resizing and subsampling do to a camera: the changed image, seen by its camera, is where it was."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ipjax import cameras
from ipjax.cameras import mostly, project, unproject
from ipjax.records import Camera

HEIGHT, WIDTH = 60, 84
K = np.array([[70.3, 0, 40.2], [0, 68.9, 31.7], [0, 0, 1]])
# Each pixel holds its own place; linear, so that averages of pixels are exact, too.
PLACES = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(np.float32)

sides = st.tuples(st.integers(20, 200), st.integers(20, 200))
places = st.tuples(st.integers(-30, 50), st.integers(-30, 40))
steps = st.tuples(st.integers(1, 7), st.integers(1, 7))


def as_camera(matrix) -> Camera:
    return Camera(
        jnp.asarray([matrix[0, 0], matrix[1, 1]], jnp.float32), jnp.asarray([matrix[0, 2], matrix[1, 2]], jnp.float32)
    )


def seen_through(matrix, image) -> np.ndarray:
    """The place in the whole image of the ray that each pixel of a changed one sees."""
    height, width = image.shape[:2]
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], -1)
    return (pixels @ (K @ np.linalg.inv(matrix)).T)[..., :2]


@given(places, st.integers(4, 40))
def test_a_crop_sees_what_the_image_saw(first, side):
    left, top = abs(first[0]), abs(first[1]) % 20
    part = PLACES[top : top + side, left : left + side]
    np.testing.assert_allclose(seen_through(cameras.crop(K, (left, top)), part), part, atol=1e-4)


@given(places, steps)
def test_every_other_pixel_sees_what_the_image_saw(first, step):
    first = abs(first[0]) % 20, abs(first[1]) % 20
    few = PLACES[first[1] :: step[1], first[0] :: step[0]]
    np.testing.assert_allclose(seen_through(cameras.subsample(K, step, first), few), few, atol=1e-4)


@pytest.mark.parametrize("how", ["area", "linear", "pil"])
@given(st.integers(1, 6), st.integers(1, 6))
def test_a_resized_image_sees_what_the_image_saw(how, across, down):
    """By whole factors, where every pixel's average is exact; odd and even ones. At the border a mean is cut off."""
    if how == "area":
        size = WIDTH // across, HEIGHT // down
        image = cv2.resize(PLACES[: size[1] * down, : size[0] * across], size, interpolation=cv2.INTER_AREA)
        matrix, inner = cameras.resize(K, (size[0] * across, size[1] * down), size), np.s_[:, :]
    else:
        size = WIDTH * across, HEIGHT * down
        if how == "linear":
            image = cv2.resize(PLACES, size, interpolation=cv2.INTER_LINEAR)
        else:
            resized = [Image.fromarray(PLACES[..., k]).resize(size, Image.Resampling.BILINEAR) for k in (0, 1)]
            image = np.stack([np.asarray(one) for one in resized], -1)
        matrix, inner = cameras.resize(K, (WIDTH, HEIGHT), size), np.s_[down:-down, across:-across]
    np.testing.assert_allclose(seen_through(matrix, image)[inner], image[inner], atol=1e-3)


@given(places, sides, sides, steps, places)
def test_changes_of_an_image_are_changes_of_its_camera(first, before, after, step, begin):
    """One after another, in the graph, on the host and for pixels alike; and whatever the camera looks at."""
    pixels = np.random.default_rng(0).uniform(-50, 150, (9, 2))
    matrix, camera, moved = K, as_camera(K), pixels
    for name, arguments in (
        ("crop", (first,)),
        ("resize", (before, after)),
        ("subsample", (step, begin)),
        ("resize", (after, before)),
    ):
        matrix, camera = (getattr(cameras, name)(one, *arguments) for one in (matrix, camera))
        moved = getattr(cameras, name + "_pixels")(moved, *arguments)
    rays = np.concatenate([pixels, np.ones((9, 1))], axis=1) @ np.linalg.inv(K).T
    there = rays @ matrix.T
    np.testing.assert_allclose(there[:, :2] / there[:, 2:], moved, atol=1e-8)
    np.testing.assert_allclose(camera.focal, matrix[[0, 1], [0, 1]], rtol=1e-5)
    np.testing.assert_allclose(camera.centre, matrix[:2, 2], rtol=1e-4, atol=1e-3)


def test_a_resize_undoes_another_and_a_crop_its_opposite():
    back = cameras.resize(cameras.resize(K, (640, 480), (224, 97)), (224, 97), (640, 480))
    np.testing.assert_allclose(back, K, atol=1e-12)
    np.testing.assert_allclose(cameras.crop(cameras.crop(K, (3, -7)), (-3, 7)), K)
    # The middle of every block of three is what subsampling begins with, and an average is centred on.
    np.testing.assert_allclose(cameras.subsample(K, 3, (1, 1)), cameras.resize(K, (63, 63), (21, 21)), atol=1e-12)


def test_cameras_change_in_the_graph_and_in_batches():
    camera = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), as_camera(K))
    many = jax.jit(lambda c: cameras.resize(cameras.crop(c, (5, 4)), (30, 20), (15, 40)))(camera)
    assert many.focal.shape == many.centre.shape == (2, 2)
    points = jnp.asarray([[0.1, 0.2, 1.5], [-0.3, 0.1, 2.0]])
    whole = project(as_camera(K), points)
    one = jax.tree.map(lambda x: x[0], many)
    moved = cameras.resize_pixels(cameras.crop_pixels(whole, (5, 4)), (30, 20), (15, 40))
    np.testing.assert_allclose(project(one, points), moved, atol=1e-3)
    np.testing.assert_allclose(unproject(one, moved, points[:, 2]), points, atol=1e-5)


def test_a_mask_that_is_halved_grows_to_no_side():
    """Every place that a rectangle can have on a grid of two: the mean of its borders is theirs, ties included."""
    low, high, area = [], [], []
    for left in range(8, 12):
        for top in range(8, 12):
            mask = np.zeros((48, 48), np.float32)
            mask[top : top + 21, left : left + 17] = 1
            half = np.asarray(mostly(cv2.resize(mask, (24, 24), interpolation=cv2.INTER_AREA)))
            area.append(4 * half.sum() / mask.sum())
            found = np.argwhere(half).mean(0)
            wanted = cameras.resize_pixels(np.argwhere(mask).mean(0), (48, 48), (24, 24))
            low.append(found[0] - wanted[0])
            high.append(found[1] - wanted[1])
    assert abs(np.mean(low)) < 0.02 and abs(np.mean(high)) < 0.02
    assert np.mean(area) == pytest.approx(1, abs=0.01)
