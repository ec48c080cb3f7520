"""Query frames: the crop sees what the frame saw, depth is cleaned, and bad input is refused in words."""

import json

import cv2
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from benchmarks.bias import frame_errors, summary
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb
from ipjax.inference.depth import clean_depth
from ipjax.inference.frames import frame, frame_turned
from ipjax.records import Camera

HEIGHT, WIDTH = 96, 128
K = np.array([[110.0, 0, 63.2], [0, 108.0, 47.4], [0, 0, 1]])


def plane(normal=(0.1, -0.2, 1.0), distance=0.8) -> np.ndarray:
    """Depth of a plane n·x = distance·n_z, metres."""
    x, y = np.meshgrid((np.arange(WIDTH) - K[0, 2]) / K[0, 0], (np.arange(HEIGHT) - K[1, 2]) / K[1, 1])
    normal = np.asarray(normal)
    return (distance * normal[2] / (normal[0] * x + normal[1] * y + normal[2])).astype(np.float32)


def scene(left=40, top=30, width=36, height=28):
    rng = np.random.default_rng(0)
    rgb = cv2.resize(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top : top + height, left : left + width] = True
    return rgb, plane(), mask


def lift(view) -> np.ndarray:
    """A point per pixel; NumPy, so that no shape is compiled."""
    focal, centre = np.asarray(view.camera.focal, np.float64), np.asarray(view.camera.centre, np.float64)
    depth = np.asarray(view.depth, np.float64)
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return np.stack([(x - centre[0]) / focal[0] * depth, (y - centre[1]) / focal[1] * depth, depth], -1)


@pytest.mark.parametrize("crop", ["square", "look_at"])
@given(st.integers(2, 80), st.integers(2, 50), st.integers(10, 44), st.integers(10, 44))
def test_points_of_the_crop_lie_where_the_frame_saw_them(crop, left, top, width, height):
    rgb, depth, mask = scene(left, top, width, height)
    view, camera_from_crop = frame_turned(rgb, depth, mask, K, crop=crop, resolution=56)
    seen = np.asarray(view.depth) > 0
    points = lift(view)[seen] @ np.asarray(camera_from_crop.rotation, np.float64).T
    assert len(points) > 20
    # Nearest neighbours: a crop pixel takes the depth of a source pixel up to half a source pixel away on either axis,
    # 4 mm here, on a plane that leans by 13° and is seen up to 30° from the axis.
    slack = 2.5e-3
    distance = np.abs(points @ [0.1, -0.2, 1.0] - 0.8) / np.linalg.norm([0.1, -0.2, 1.0])
    assert distance.max() < slack
    pixels = points[:, :2] / points[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    inside = np.asarray(view.mask)[seen]
    edge = 1.0
    assert (pixels[inside] >= (left - 0.5 - edge, top - 0.5 - edge)).all()
    assert (pixels[inside] <= (left + width - 0.5 + edge, top + height - 0.5 + edge)).all()


@pytest.mark.parametrize(
    ("crop", "size"),
    [
        ("square", (640, 480)),
        ("square", (641, 479)),
        ("square", (1280, 720)),
        ("square", (2560, 1440)),
        ("square", (2561, 1441)),
        ("square", (4096, 3072)),
        ("look_at", (641, 479)),
        ("look_at", (2561, 1441)),
    ],
)
def test_a_crop_is_off_to_no_side(size, crop):
    """Depth and mask of exact images, large and small: signed errors within three standard errors of zero."""
    found = [frame_errors(seed, *size, resolution=112, crop=crop, share=(0.2, 0.4)) for seed in range(12)]
    for what, finest in (("depth", 0.002), ("mask", 0.01)):  # pixels; the mask's size in %
        mean, error = summary([one[what] for one in found])
        assert (np.abs(mean) <= 3 * error + finest)[np.isfinite(mean)].all(), (what, mean, error)
    assert np.nanmax([np.abs(one["depth"]) for one in found]) < 0.05


def test_the_square_crop_pads_centres_and_keeps_pixel_centres():
    rgb, depth, mask = scene(40, 30, 40, 40)
    rgb[:] = 0
    rgb[30:70, 40:80] = 255  # what the mask covers
    view = frame(rgb, depth, mask, K, resolution=96, pad=0.2)
    rows, columns = np.nonzero(np.asarray(view.mask))
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (8, 87, 8, 87)  # 48 source pixels become 96
    np.testing.assert_allclose(view.camera.focal, 2 * np.array([110.0, 108.0]))
    # Source pixel 60 sits between crop pixels: (60 − 36 + ½)·2 − ½.
    x = (60 - K[0, 2]) / K[0, 0] * float(view.camera.focal[0]) + float(view.camera.centre[0])
    assert x == pytest.approx((60 - 36 + 0.5) * 2 - 0.5, abs=1e-4)
    assert np.asarray(view.rgb)[12:84, 12:84].min() > 0.99


def test_the_look_at_camera_looks_at_the_mask_and_only_turns():
    rgb, depth, mask = scene(84, 60, 36, 28)
    view, camera_from_crop = frame_turned(rgb, depth, mask, K, crop="look_at", resolution=56)
    rotation = np.asarray(camera_from_crop.rotation, np.float64)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-6)
    axis = rotation @ [0, 0, 1]
    pixel = axis[:2] / axis[2] * K[[0, 1], [0, 1]] + K[:2, 2]
    np.testing.assert_allclose(pixel, (84 + 17.5, 60 + 13.5), atol=1e-3)
    assert rotation[2, 0] != 0 and float(camera_from_crop.scale) == 1
    rows, columns = np.nonzero(np.asarray(view.mask))
    assert columns.min() >= 2 and columns.max() <= 53 and rows.min() >= 2 and rows.max() <= 53


@pytest.mark.parametrize("crop", ["square", "look_at"])
def test_units_do_not_change_the_crop(crop):
    rgb, depth, mask = scene()
    metres = frame(rgb, depth, mask, K, resolution=56, crop=crop)
    millimetres = frame(
        rgb, (depth * 1000).round().astype(np.uint16), mask, K, depth_scale=1e-3, resolution=56, crop=crop
    )
    np.testing.assert_allclose(metres.depth, millimetres.depth, atol=6e-4)
    from_file = Intrinsics(K, depth_scale=1e-3)
    again = frame(rgb, (depth * 1000).round().astype(np.uint16), mask, from_file, resolution=56, crop=crop)
    np.testing.assert_array_equal(millimetres.depth, again.depth)


def test_every_kind_of_camera_gives_the_same_crop():
    rgb, depth, mask = scene()
    expected = frame(rgb, depth, mask, K, resolution=56)
    record = Camera(focal=jnp.asarray([110.0, 108.0]), centre=jnp.asarray([63.2, 47.4]))
    for camera in (record, (110.0, 108.0, 63.2, 47.4), {"fx": 110, "fy": 108, "cx": 63.2, "cy": 47.4}, Intrinsics(K)):
        got = frame(rgb, depth, mask, camera, resolution=56)
        np.testing.assert_allclose(got.camera.centre, expected.camera.centre, atol=1e-3)
        np.testing.assert_array_equal(got.depth, expected.depth)


def test_flying_pixels_are_removed_and_slanted_surfaces_kept():
    depth = np.full((40, 60), 1.5, np.float32)
    depth[10:30, 15:45] = 0.8
    depth[10:30, 45] = 1.1  # between object and wall: measured nowhere
    cleaned = clean_depth(depth)
    assert (cleaned[10:30, 45] == 0).all()
    assert (cleaned[10:30, 15:45] == 0.8).all() and (cleaned[35:, :] == 1.5).all()
    slanted = plane((0.9, 0.0, 1.0))
    assert (clean_depth(slanted)[2:-2, 2:-2] > 0).mean() > 0.99


def test_unknown_depth_stays_unknown_and_the_rim_is_not_trusted():
    rgb, depth, mask = scene(40, 30, 40, 40)
    depth[40:50, 50:60] = np.nan
    depth[52:56, 50:60] = np.inf
    depth[58:60, 50:60] = -1
    view = frame(rgb, depth, mask, K, resolution=48, pad=0.2, erosion=2)
    crop = np.asarray(view.depth)
    assert np.isfinite(crop).all() and (crop >= 0).all()
    assert (crop[40 - 26 : 50 - 26, 50 - 36 : 60 - 36] == 0).all()
    assert (crop[4:6, 4:44] == 0).all() and (crop[4:44, 4:6] == 0).all()  # the mask begins at 4
    assert (crop[8:12, 8:40] > 0).all()
    assert (crop[:2, :] > 0).any()  # outside the mask depth is kept: it shows what occludes


def test_depth_that_cannot_be_the_object_is_dropped():
    rgb, depth, mask = scene()
    depth[35:45, 45:55] = 3.0
    kept = frame(rgb, depth, mask, K, resolution=56, drop_outliers=False)
    dropped = frame(rgb, depth, mask, K, resolution=56)
    assert (np.asarray(kept.depth)[np.asarray(kept.mask)] > 2).any()
    assert not (np.asarray(dropped.depth)[np.asarray(dropped.mask)] > 2).any()


def test_a_box_finds_the_near_object():
    rgb, _, _ = scene()
    depth = np.full((HEIGHT, WIDTH), 1.6, np.float32)
    yy, xx = np.mgrid[:HEIGHT, :WIDTH]
    disc = (xx - 60) ** 2 + (yy - 48) ** 2 < 18**2
    depth[disc] = 0.7
    view = frame(rgb, depth, None, K, box=(40, 28, 40, 40), resolution=56)
    assert (np.asarray(view.depth)[np.asarray(view.mask) & (np.asarray(view.depth) > 0)] < 0.8).all()
    with_mask = frame(rgb, depth, disc, K, resolution=56)
    overlap = (np.asarray(view.mask) & np.asarray(with_mask.mask)).sum() / np.asarray(with_mask.mask).sum()
    assert overlap > 0.9


def test_specks_do_not_blow_up_the_crop():
    rgb, depth, mask = scene()
    clean = frame(rgb, depth, mask, K, resolution=56)
    mask[2, 2] = True
    np.testing.assert_array_equal(frame(rgb, depth, mask, K, resolution=56).rgb, clean.rgb)


@pytest.mark.parametrize(("background", "colour"), [("black", 0.0), ("grey", 0.5)])
def test_the_background_is_what_was_asked_for(background, colour):
    rgb, depth, mask = scene()
    view = frame(rgb, depth, mask, K, background=background, resolution=56)
    assert (np.asarray(view.rgb)[~np.asarray(view.mask)] == colour).all()
    kept = frame(rgb, depth, mask, K, background="keep", resolution=56)
    assert np.asarray(kept.rgb)[~np.asarray(kept.mask)].std() > 0.05


@pytest.mark.parametrize("lens", ["plumb_bob", "equidistant"])
def test_lens_distortion_is_undone(lens):
    """A checkerboard of depth edges seen through a lens comes back to where the pinhole sees it."""
    rgb, depth, mask = scene()
    coefficients = (-0.3, 0.08, 0.001, -0.002, 0.0) if lens == "plumb_bob" else (0.05, -0.01, 0.002, 0.0)
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(-1, 1, 2).astype(np.float64)
    undo = cv2.undistortPoints if lens == "plumb_bob" else cv2.fisheye.undistortPoints
    ideal = undo(pixels, K, np.array(coefficients), P=K).reshape(HEIGHT, WIDTH, 2).astype(np.float32)

    def through(image, how):
        return cv2.remap(image, ideal[..., 0], ideal[..., 1], how, borderMode=cv2.BORDER_REPLICATE)

    view = frame(
        through(rgb, cv2.INTER_LINEAR),
        through(depth, cv2.INTER_NEAREST),
        through(mask.astype(np.uint8), cv2.INTER_NEAREST),
        Intrinsics(K, distortion=coefficients, lens=lens),
        resolution=56,
        background="keep",
    )
    seen = np.asarray(view.mask) & (np.asarray(view.depth) > 0)
    points = lift(view)[seen]
    distance = np.abs(points @ [0.1, -0.2, 1.0] - 0.8)
    assert seen.sum() > 500 and distance.max() < 6e-3
    centre = points.mean(0)
    pixel = centre[:2] / centre[2] * K[[0, 1], [0, 1]] + K[:2, 2]
    np.testing.assert_allclose(pixel, (40 + 17.5, 30 + 13.5), atol=1.0)


def refusals():
    rgb, depth, mask = scene()
    none = np.zeros_like(mask)
    singular = np.diag([0.0, 100, 1])
    yield "align the depth", (rgb, depth[:-1], mask, K), {}
    yield "but the mask is", (rgb, depth, mask[:, :-1], K), {}
    yield "the mask is empty", (rgb, depth, none, K), {}
    yield "outside the image", (rgb, depth, None, K), {"box": (500, 10, 20, 20)}
    yield "positive size", (rgb, depth, None, K), {"box": (10, 10, 0, 20)}
    yield "four numbers", (rgb, depth, None, K), {"box": (10, 10, np.nan, 20)}
    yield "a mask or a box", (rgb, depth, None, K), {}
    yield "no depth inside the mask", (rgb, np.zeros_like(depth), mask, K), {}
    yield "no depth inside the mask", (rgb, np.full_like(depth, np.nan), mask, K), {}
    yield "no depth inside the box", (rgb, np.zeros_like(depth), None, K), {"box": (10, 10, 20, 20)}
    yield "looks like millimetres; pass depth_scale=0.001", (rgb, depth * 1000, mask, K), {}
    yield "looks like millimetres", (rgb, (depth * 1000).astype(np.uint16), mask, K), {}
    yield "looks like tenths of a millimetre", (rgb, (depth * 2e4).astype(np.uint16), mask, K), {}
    yield "looks like millimetres", (rgb, (depth * 1000).astype(np.uint16), mask, K), {"depth_scale": 1.0}
    yield "looks like metres; pass depth_scale=1", (rgb, depth, mask, K), {"depth_scale": 1e-3}
    yield "pass depth_scale, the metres per", (rgb, depth * 1e-9, mask, K), {}
    yield "positive number", (rgb, depth, mask, K), {"depth_scale": -1.0}
    yield "singular", (rgb, depth, mask, singular), {}
    yield "not finite", (rgb, depth, mask, K * np.nan), {}
    yield "skew", (rgb, depth, mask, K + np.array([[0, 5, 0], [0, 0, 0], [0, 0, 0]])), {}
    yield "3 × 3", (rgb, depth, mask, np.eye(4)), {}
    yield "not finite", (np.full(rgb.shape, np.nan), depth, mask, K), {}
    yield "in \\[0, 1\\]", (rgb.astype(np.float32), depth, mask, K), {}
    yield "height × width × 3", (rgb[None], depth, mask, K), {}
    yield "the camera is for images of 640", (rgb, depth, mask, Intrinsics(K, size=(640, 480))), {}
    yield "crop must be", (rgb, depth, mask, K), {"crop": "round"}
    yield "background must be", (rgb, depth, mask, K), {"background": "pink"}
    yield "resolution", (rgb, depth, mask, K), {"resolution": 3}
    for name in ("pad", "edge_tolerance"):
        for value in (-1.5, np.nan, np.inf):
            yield f"{name} must be a finite number from 0 on", (rgb, depth, mask, K), {name: value}
    for value in (-1, 1.5):
        yield "erosion must be a whole number of pixels", (rgb, depth, mask, K), {"erosion": value}


@pytest.mark.parametrize(("words", "positional", "named"), list(refusals()))
def test_bad_frames_are_refused_in_words(words, positional, named):
    import jaxtyping

    jaxtyping.config.update("jaxtyping_disable", True)  # our own words are under test, not the shape checker's
    try:
        with pytest.raises(ValueError, match=words):
            frame(*positional, **named)
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_a_real_frame(shared):
    """A can that a bottle hides in part: most of its mask has depth, and its depth is the annotated one."""
    folder = shared / "data" / "ycbv" / "test" / "000050"
    camera = read_camera(folder / "scene_camera.json", 2)
    truth = json.loads((folder / "scene_gt.json").read_text())["2"][1]
    for crop in ("square", "look_at"):
        view = frame(
            read_rgb(folder / "rgb" / "000002.png"),
            read_depth(folder / "depth" / "000002.png"),
            read_mask(folder / "mask_visib" / "000002_000001.png"),
            camera,
            crop=crop,
        )
        mask, depth = np.asarray(view.mask), np.asarray(view.depth)
        assert (depth[mask] > 0).mean() > 0.6
        assert np.median(depth[mask & (depth > 0)]) == pytest.approx(truth["cam_t_m2c"][2] / 1e3, abs=0.05)
