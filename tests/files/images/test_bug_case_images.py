"""Camera, mask and depth files that other people's reports describe: each is read as what it is, or refused.

The files are not in the repository; laws with inputs made in code are in test_camera_files.py and test_images.py.
"""

import logging
import re

import numpy as np
import pytest

from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb
from ipjax.inference.frames import frame

K = np.array([[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]])
SIZE = (640, 480)
FIVE, FOUR = (0.02,) * 5, (0.02,) * 4
ROS2 = (-0.05, 0.06, 0.0003, 0.0006, -0.02)

# Lens, coefficients, and where they differ from the above, size and matrix.
READ = {
    "Brown_Conrady_5.yaml": ("plumb_bob", FIVE),
    "plumb_bob_5.yaml": ("plumb_bob", FIVE),
    "plumb_bob_0.yaml": ("plumb_bob", ()),
    "quoted_size.yaml": ("plumb_bob", FIVE),
    "empty_model.yaml": ("opencv", FIVE),
    "opencv_yaml.yaml": ("opencv", (-0.25, 0.12, 0.001, 0.0007, -0.03)),
    "rational_8.yaml": ("rational_polynomial", (0.02,) * 8),
    "rational_14.yaml": ("rational_polynomial", (0.02,) * 14),
    "equidistant_4.yaml": ("equidistant", FOUR),
    "fisheye_4.yaml": ("equidistant", FOUR),
    "kannala_brandt4.yaml": ("equidistant", FOUR),
    "ros2_echo.yaml": ("plumb_bob", ROS2),
    "P.txt": ("opencv", (), None, [[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]]),
    "kalibr.yaml": (
        "plumb_bob",
        (-0.28, 0.07, 0.0001, 0.00001),
        SIZE,
        [[1066.7, 0, 312.9], [0, 1067.4, 241.3], [0, 0, 1]],
    ),
    "ros2_roi.yaml": (
        "plumb_bob",
        ROS2,
        (400, 300),
        [[1066.778, 0, 212.9869], [0, 1067.487, 191.3109], [0, 0, 1]],
    ),
    # Pixel i is pixels 2 i and 2 i + 1 of the sensor.
    "ros2_binning_2.yaml": (
        "plumb_bob",
        ROS2,
        (320, 240),
        [[533.389, 0, 156.24345], [0, 533.7435, 120.40545], [0, 0, 1]],
    ),
}
REFUSED = {
    "equi_5.yaml": "5 distortion coefficients do not fit",
    "plumb_bob_8.yaml": "8 distortion coefficients do not fit",
    "rational_5.yaml": "5 distortion coefficients do not fit",
    "fov_1.yaml": "unknown lens model 'FOV'",
    "inverse.yaml": "unknown lens model 'inverse_brown_conrady'",
    "none_5.yaml": "says no distortion",
    "k_T.json": "row by row",
    "k_neg.json": "mirrored",
    "k_norm.json": "shares of the image",
    "k_skew.json": "skew of 5",
    "k_zero.json": "cx and cy are missing",
    "k_twice_size.json": "the camera is for images of 1280 × 960",  # when the image is there to compare
}
TOLD = {
    "k_half.json": r"multiply fx, fy, cx and cy by 2\.0",
    "k_2_3.json": r"multiply fx, fy, cx and cy by 1\.5",
    "k_1.25.json": r"multiply fx, fy, cx and cy by 0\.8",
    "k_1.5.json": r"multiply fx, fy, cx and cy by 0\.6",
    "k_twice.json": r"multiply fx, fy, cx and cy by 0\.5",
    "k_centre_swapped.json": "look exchanged",
    "k_far.json": "far from the middle",
}
# Of these, only the size of the mesh can tell: see `inference.estimator.check_size`.
SILENT = ("k_fx0.5,_centre_right.json", "k_fx1.2,_centre_right.json")
MASKS = {
    **{f"mask_palette/{n}": 14952 for n in ("adaptive.png", "convertP.png", "index0_is_white.png", "mask.gif")},
    "mask_palette/quantised.png": 14952,
    "mask_tiny/10x10.png": 100,
    "mask_tiny/1x1.png": 1,
    "mask_tiny/20x20.png": 400,
    "mask_tiny/3x3.png": 9,
    "mask_tiny/5x5.png": 25,
    "mask_tiny/line.png": 108,
    "mask_inverted/all.png": "covers all of the image",
    "mask_inverted/black_on_white.png": "looks inverted",
    "mask_labels/labels.npy": r"more than two values \(0, 1, 2, 3\)",
    "mask_labels/labels_16.png": r"more than two values \(0, 100, 200, 300\)",
    "mask_labels/labels_80_160_240.png": r"more than two values \(0, 80, 160, 240\)",
    "mask_labels/labels_L.png": r"more than two values \(0, 1, 2, 3\)",
    "mask_labels/labels_davis.png": "more than two",
    "mask_labels/labels_rgb.png": "more than two",
}
LABELS = {"labels.npy": 1, "labels_16.png": 100, "labels_80_160_240.png": 80, "labels_L.png": 1, "labels_davis.png": 1}


@pytest.fixture
def cases(shared):
    folder = shared / "data" / "bug_cases"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    return folder


def see(camera, mask=None):
    """A frame of `SIZE` through a camera."""
    width, height = SIZE
    y, x = np.mgrid[:height, :width]
    mask = (np.hypot(x - 320, y - 240) < 60) if mask is None else mask
    return frame(np.full((height, width, 3), 0.5), np.full((height, width), 0.9), mask, camera, depth_scale=1.0)


def test_the_tables_name_every_file(cases):
    cameras = {path.name for path in (cases / "camera").iterdir()}
    assert cameras == READ.keys() | REFUSED.keys() | TOLD.keys() | set(SILENT)
    assert {f"{path.parent.name}/{path.name}" for path in cases.glob("mask_*/*")} == MASKS.keys()


@pytest.mark.parametrize("name", READ)
def test_cameras_that_are_understood(cases, name):
    lens, coefficients, size, matrix = (*READ[name], SIZE, K)[:4] if len(READ[name]) == 2 else READ[name]
    camera = read_camera(cases / "camera" / name)
    assert (camera.lens, camera.distortion, camera.size) == (lens, coefficients, size)
    np.testing.assert_allclose(camera.matrix, matrix)


@pytest.mark.parametrize("name", REFUSED)
def test_cameras_that_are_not(cases, name):
    with pytest.raises(ValueError, match=REFUSED[name]) as caught:
        see(read_camera(cases / "camera" / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [*TOLD, *SILENT])
def test_cameras_of_other_images_are_told(cases, name, caplog):
    with caplog.at_level(logging.WARNING, "ipjax"):
        see(read_camera(cases / "camera" / name))
    assert len(caplog.messages) == (0 if name in SILENT else 1)
    assert re.search(TOLD.get(name, ""), caplog.text)


@pytest.mark.parametrize("name", MASKS)
def test_masks(cases, name):
    right = MASKS[name]
    if isinstance(right, int):
        assert read_mask(cases / name).sum() == right
        return
    with pytest.raises(ValueError, match=right):
        see(K, read_mask(cases / name))


@pytest.mark.parametrize("name", LABELS)
def test_a_label_that_is_asked_for(cases, name):
    np.testing.assert_array_equal(
        read_mask(cases / "mask_labels" / name, LABELS[name]), read_mask(cases / "mask_palette" / "convertP.png")
    )


def test_byte_order(cases):
    folder = cases / "depth_endian"
    views = []
    for name in ("depth.png", "depth_be_u2.npy", "depth_be_f4.npy"):
        scale = 1.0 if "f4" in name else 1e-3
        raw = read_depth(folder / "depth.png") if name.endswith("png") else np.load(folder / name)
        for depth in (read_depth(folder / name), raw):
            views.append(
                frame(
                    read_rgb(folder / "rgb.png"),
                    depth,
                    read_mask(folder / "mask.png"),
                    read_camera(folder / "camera.txt"),
                    depth_scale=scale,
                )
            )
    for view in views:
        np.testing.assert_allclose(view.depth, views[0].depth, atol=1e-6)
    assert float(np.asarray(views[0].depth).max()) < 2.5
