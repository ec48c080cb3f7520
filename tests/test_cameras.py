"""What cropping, resizing, subsampling and turning do to a camera: its image, seen by it, is where it was."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ipjax import cameras
from ipjax.cameras import borders, look_at, mask_from_coverage, middle, project, turn, unproject
from ipjax.records import Camera
from ipjax.transforms import rotation_from_vector

HEIGHT, WIDTH = 60, 84
K = np.array([[70.3, 0, 40.2], [0, 68.9, 31.7], [0, 0, 1]])
# Each pixel holds its own place; linear, so that averages of pixels are exact, too.
PLACES = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(np.float32)

sides = st.tuples(st.integers(20, 200), st.integers(20, 200))
places = st.tuples(st.integers(-30, 50), st.integers(-30, 40))
steps = st.tuples(st.integers(1, 7), st.integers(1, 7))


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
    matrix, camera, moved = K, Camera.from_matrix(K), pixels
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


seeds = st.integers(0, 2**31)
each_kind = pytest.mark.parametrize("kind", ["NumPy", "JAX"])


def draw(seed, kind):
    """A camera, points before it, and the tolerance of its precision, in pixels."""
    rng = np.random.default_rng(seed)
    matrix = np.diag([*rng.uniform(50, 1500, 2), 1])
    matrix[:2, 2] = rng.uniform(-100, 1000, 2)
    points = rng.uniform([-1, -1, 0.3], [1, 1, 3], (7, 3))
    if kind == "NumPy":
        return matrix, points, 1e-9
    return Camera.from_matrix(matrix), jnp.asarray(points, jnp.float32), 5e-3


@each_kind
@given(seeds)
def test_projecting_and_lifting_are_inverse(kind, seed):
    camera, points, tolerance = draw(seed, kind)
    pixels = project(camera, points)
    assert pixels.dtype == points.dtype and type(pixels) is type(points)
    np.testing.assert_allclose(unproject(camera, pixels, points[:, 2]), points, atol=1e-3 * tolerance)
    np.testing.assert_allclose(project(camera, unproject(camera, pixels, points[:, 2])), pixels, atol=tolerance)


@each_kind
@given(seeds, places, sides, sides, steps, places)
def test_points_are_seen_where_their_pixel_went(kind, seed, first, before, after, step, begin):
    """A camera that was cropped, then resized, then subsampled, projects where the pixels of the full one moved to."""
    camera, points, tolerance = draw(seed, kind)
    pixels = project(camera, points)
    zoom = max(1, *np.divide(after, before))
    for name, arguments in (("crop", (first,)), ("resize", (before, after)), ("subsample", (step, begin))):
        camera = getattr(cameras, name)(camera, *arguments)
        pixels = getattr(cameras, name + "_pixels")(pixels, *arguments)
        np.testing.assert_allclose(project(camera, points), pixels, atol=tolerance * zoom)


@given(seeds, places, sides, sides)
def test_a_crop_that_is_resized_is_one_camera(seed, first, before, after):
    """One that sees the window's borders where the borders of the resized image are."""
    matrix, points, _ = draw(seed, "NumPy")
    changed = cameras.resize(cameras.crop(matrix, first), before, after)
    window = np.array(first, float) - 0.5, np.array(before, float)
    wanted = (project(matrix, points) - window[0]) / window[1] * after - 0.5
    np.testing.assert_allclose(project(changed, points), wanted, atol=1e-8)
    assert type(cameras.crop(Camera.from_matrix(matrix), first)) is Camera


@given(seeds)
def test_turning_is_a_group_action(seed):
    """No turn changes nothing, one after another is their product, and points are seen where they are."""
    rng = np.random.default_rng(seed)
    first, second = (rotation_from_vector(0.2 * rng.normal(size=3)) for _ in range(2))
    (one, points, _), (two, _, _), (three, _, _) = (draw(seed + k, "NumPy") for k in range(3))
    np.testing.assert_allclose(turn(one, np.eye(3), one), np.eye(3), atol=1e-12)
    both = turn(one, first, two) @ turn(two, second, three)
    np.testing.assert_allclose(turn(one, first @ second, three), both, rtol=1e-9, atol=1e-9 * np.abs(both).max())
    np.testing.assert_allclose(turn(one, first, two) @ turn(two, first.T, one), np.eye(3), atol=1e-8)
    points = points + np.array([0, 0, 2])
    seen = project(two, points @ first)  # rows: the inverse of the rotation
    back = np.concatenate([seen, np.ones((7, 1))], -1) @ turn(one, first, two).T
    np.testing.assert_allclose(back[:, :2] / back[:, 2:], project(one, points), atol=1e-7)


@given(seeds, st.tuples(st.floats(-500, 1500), st.floats(-500, 1500)))
def test_a_camera_looks_at_a_pixel_by_the_least_turn(seed, pixel):
    matrix, _, _ = draw(seed, "NumPy")
    rotation = look_at(matrix, np.array(pixel))
    axis = unproject(matrix, np.array([pixel]), np.ones(1))[0]
    np.testing.assert_allclose(rotation.T @ axis, [0, 0, np.linalg.norm(axis)], atol=1e-9 * np.linalg.norm(axis))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.trace(rotation) == pytest.approx(1 + 2 * axis[2] / np.linalg.norm(axis), abs=1e-12)
    np.testing.assert_array_equal(look_at(matrix, matrix[:2, 2]), np.eye(3))


def test_the_borders_of_an_image_are_half_a_pixel_from_its_centres():
    """As a renderer finds them: the first and the last pixel end there, seen with y up."""
    left, right, bottom, top = borders(K, WIDTH, HEIGHT)
    corners = project(K, np.array([[left, -top, 1], [right, -bottom, 1]]))
    np.testing.assert_allclose(corners, [[-0.5, -0.5], [WIDTH - 0.5, HEIGHT - 0.5]])
    straight = np.array([[9.0, 0, 0], [0, 9, 0], [0, 0, 1]])
    straight[:2, 2] = middle(WIDTH, HEIGHT)
    left, right, bottom, top = borders(straight[None], WIDTH, HEIGHT)[0]
    assert left == -right and bottom == -top


def test_a_camera_is_its_matrix():
    np.testing.assert_allclose(Camera.from_matrix(K).to_matrix(), K, rtol=1e-6)
    many = Camera.from_matrix(np.stack([K, 2 * K]))
    assert many.focal.shape == many.centre.shape == (2, 2) and many.to_matrix().shape == (2, 3, 3)
    np.testing.assert_array_equal(many.to_matrix()[:, 2], [[0, 0, 1]] * 2)


def test_a_resize_undoes_another_and_a_crop_its_opposite():
    back = cameras.resize(cameras.resize(K, (640, 480), (224, 97)), (224, 97), (640, 480))
    np.testing.assert_allclose(back, K, atol=1e-12)
    np.testing.assert_allclose(cameras.crop(cameras.crop(K, (3, -7)), (-3, 7)), K)
    # The middle of every block of three is what subsampling begins with, and an average is centred on.
    np.testing.assert_allclose(cameras.subsample(K, 3, (1, 1)), cameras.resize(K, (63, 63), (21, 21)), atol=1e-12)


def test_cameras_change_in_the_graph_and_in_batches():
    camera = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), Camera.from_matrix(K))
    many = jax.jit(lambda c: cameras.resize(cameras.crop(c, (5, 4)), (30, 20), (15, 40)))(camera)
    assert many.focal.shape == many.centre.shape == (2, 2)
    points = jnp.asarray([[0.1, 0.2, 1.5], [-0.3, 0.1, 2.0]])
    whole = project(Camera.from_matrix(K), points)
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
            half = np.asarray(mask_from_coverage(cv2.resize(mask, (24, 24), interpolation=cv2.INTER_AREA)))
            area.append(4 * half.sum() / mask.sum())
            found = np.argwhere(half).mean(0)
            wanted = cameras.resize_pixels(np.argwhere(mask).mean(0), (48, 48), (24, 24))
            low.append(found[0] - wanted[0])
            high.append(found[1] - wanted[1])
    assert abs(np.mean(low)) < 0.02 and abs(np.mean(high)) < 0.02
    assert np.mean(area) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("xp", [np, jnp])
def test_whole_pixels_and_whole_focal_lengths_do_not_lose_their_halves(xp):
    pixels = xp.array([[10, 21]])
    np.testing.assert_allclose(cameras.resize_pixels(pixels, (640, 480), (320, 240)), [[4.75, 10.25]])
    np.testing.assert_allclose(cameras.subsample_pixels(pixels, 2, (1, 0)), [[4.5, 10.5]])
    np.testing.assert_allclose(cameras.crop_pixels(pixels, (0.5, 2)), [[9.5, 19]])
    whole = jax.tree.map(lambda x: x.astype(int), Camera(jnp.array([501.0, 500.0]), jnp.array([320.0, 240.0])))
    seen = cameras.resize(whole, (640, 480), (320, 240))
    np.testing.assert_allclose([seen.focal, seen.centre], [[250.5, 250], [159.75, 119.75]])


def test_images_without_pixels_are_refused_in_words():
    with pytest.raises(ValueError, match="sizes of images are positive"):
        cameras.resize(K, (640, 480), (0, 240))
    with pytest.raises(ValueError, match="step between pixels is positive"):
        cameras.subsample(K, 0)
