"""Colour, depth and mask files: what is stored is what is read, in every way of storing it, or one sentence says no."""

import io
import itertools
import logging

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ipjax.files.images.depth import read_depth, remove_sentinel
from ipjax.files.images.masks import as_mask, read_mask
from ipjax.files.images.opening import read_rgb
from ipjax.inference.frames import frame
from ipjax.onboarding.foreground import read_photo
from ipjax.onboarding.photo import prepare_photo

HEIGHT, WIDTH = 96, 128
K = np.array([[110.0, 0, 63.2], [0, 108.0, 47.4], [0, 0, 1]])
RGB = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
Y, X = np.mgrid[:HEIGHT, :WIDTH]
DISC = np.hypot(X - 60, Y - 50) < 25
DEPTH = (0.8 + 0.002 * X + 0.001 * Y).astype(np.float32)


def labels() -> np.ndarray:
    """The disc is 1; a square is 2, and a stripe at the edge is 3."""
    found = DISC.astype(np.uint8)
    found[5:20, 5:30] = 2
    found[:, 110:] = 3
    return found


# --- files ------------------------------------------------------------------------------------------------------------


def test_images_are_read_as_they_were_taken(tmp_path):
    rgb, depth, mask = RGB, DEPTH, DISC
    Image.fromarray(rgb).save(tmp_path / "rgb.png")
    np.testing.assert_array_equal(read_rgb(tmp_path / "rgb.png"), rgb)
    for name, array in (
        ("d.png", (depth * 1e3).astype(np.uint16)),
        ("d.tif", depth),
        ("e.tif", depth.astype(np.uint16)),
    ):
        Image.fromarray(array).save(tmp_path / name)
        np.testing.assert_array_equal(read_depth(tmp_path / name), array)
    np.save(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy"), depth)
    for name, array in (("m.png", mask), ("n.png", mask.astype(np.uint8)), ("o.png", mask.astype(np.uint8) * 255)):
        Image.fromarray(array).save(tmp_path / name)
        np.testing.assert_array_equal(read_mask(tmp_path / name), mask)
    cut_out = np.dstack([rgb, mask.astype(np.uint8) * 255])
    Image.fromarray(cut_out).save(tmp_path / "p.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "p.png"), mask)


def test_bad_images_are_refused_by_name(tmp_path):
    rgb, depth = RGB, DEPTH
    Image.fromarray(rgb).save(tmp_path / "rgb.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "rgb.png").read_bytes()[:2000])
    (tmp_path / "text.png").write_text("no image")
    np.save(tmp_path / "flat.npy", depth[0])
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY")
    np.save(tmp_path / "object.npy", np.array([{}], dtype=object), allow_pickle=True)
    Image.fromarray((depth * 1000).astype(np.uint16)).save(tmp_path / "depth.png")
    for read, name, words in [
        (read_rgb, "none.png", "no such file"),
        (read_rgb, "cut.png", "broken image"),
        (read_rgb, "text.png", "not an image"),
        (read_rgb, "depth.png", "is this the depth"),
        (read_depth, "rgb.png", "16-bit or float"),
        (read_depth, "flat.npy", "height × width"),
        (read_depth, "cut.npy", "npy"),
        (read_depth, "object.npy", "npy"),
        (read_depth, "x.exr", "EXR"),
        (read_mask, "text.png", "not an image"),
    ]:
        with pytest.raises(ValueError, match=words) as caught:
            read(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="not finite"):
        as_mask(np.full((4, 4), np.nan))


# --- masks ------------------------------------------------------------------------------------------------------------


def store(array: np.ndarray, path, **how):
    Image.fromarray(array).save(path, **how)
    return path


@given(st.permutations(range(6)), st.integers(0, 3), st.integers(0, 3))
def test_a_palette_counts_as_its_colours(tmp_path_factory, order, black, white):
    """Whatever numbers a palette gives to black and white, the mask is white."""
    dark, bright = order[black], order[white if white != black else white + 1]
    image = Image.frombytes("P", (WIDTH, HEIGHT), np.where(DISC, bright, dark).astype(np.uint8).tobytes())
    palette = [90, 120, 30] * 256
    palette[3 * dark : 3 * dark + 3], palette[3 * bright : 3 * bright + 3] = [0, 0, 0], [255, 255, 255]
    image.putpalette(palette)
    path = tmp_path_factory.getbasetemp() / "palette.png"
    image.save(path)
    np.testing.assert_array_equal(read_mask(path), DISC)
    np.testing.assert_array_equal(read_mask(path, label=bright), DISC)


@pytest.mark.parametrize("name", ["m.png", "m.bmp", "m.gif", "m.tif", "m.webp", "m.jpg"])
def test_two_values_are_a_mask_in_every_format(tmp_path, name):
    white = DISC.astype(np.uint8) * 255
    for i, array in enumerate((white, np.dstack([white] * 3))):
        store(array, tmp_path / f"{i}{name}", **({"lossless": True} if name.endswith("webp") else {}))
        np.testing.assert_array_equal(read_mask(tmp_path / f"{i}{name}"), DISC)


@pytest.mark.parametrize(
    "mask",
    [
        DISC,
        DISC.astype(np.uint8),
        DISC.astype(np.uint8) * 255,
        DISC.astype(np.int64) * 7,
        DISC.astype(">u2") * np.array(65535, ">u2"),
        DISC.astype(np.float64),
        DISC.astype(np.float16) * 255,
        np.dstack([DISC * np.uint8(200), 0 * X, 0 * X]).astype(np.uint8),  # one colour
        cv2.GaussianBlur(DISC.astype(np.float32), (0, 0), 2),  # probabilities
        cv2.GaussianBlur(DISC * np.uint8(255), (0, 0), 3),
        (cv2.resize(cv2.resize(DISC * 255.0, (64, 48), interpolation=cv2.INTER_AREA), (128, 96)) + 0.5).astype(
            np.uint8
        ),
    ],
)
def test_masks_of_all_kinds_of_numbers(mask):
    found = as_mask(mask)
    assert found.dtype == bool and (found & DISC).sum() / (found | DISC).sum() > 0.95


# 300, three times 100, is no byte.
@pytest.mark.parametrize(
    ("dtype", "times"),
    [(d, t) for d in (np.uint8, np.int32, ">u2", np.float32) for t in (1, 60, 80, 100) if d != np.uint8 or t < 100],
)
def test_labels_are_refused_until_one_is_asked_for(tmp_path, times, dtype):
    array = (labels().astype(np.int64) * times).astype(dtype)
    np.save(tmp_path / "labels.npy", array)
    for read in (
        lambda label=None: read_mask(tmp_path / "labels.npy", label),
        lambda label=None: as_mask(array, label),
    ):
        with pytest.raises(ValueError, match=r"more than two values \(0, .*label"):
            read()
        for label in (1, 2, 3):
            np.testing.assert_array_equal(read(label * times), labels() == label)
        with pytest.raises(ValueError, match="no pixel of the mask has the label 7"):
            read(7)


@given(st.lists(st.integers(0, 255), min_size=3, max_size=3, unique=True))
def test_no_choice_of_label_numbers_passes_as_a_mask(numbers):
    """Three regions of three numbers are never taken for two: which would be the object?"""
    array = np.asarray(sorted(numbers), np.uint8)[np.minimum(labels(), 2)]
    with pytest.raises(ValueError, match="mask"):
        as_mask(array)


def test_labels_in_colour_and_palettes(tmp_path):
    palette = np.array([[0, 0, 0], [128, 0, 0], [0, 128, 0], [128, 128, 0]], np.uint8)
    image = Image.frombytes("P", (WIDTH, HEIGHT), labels().tobytes())
    image.putpalette(palette.tobytes())
    image.save(tmp_path / "davis.png")
    store(palette[labels()], tmp_path / "rgb.png")
    for name in ("davis.png", "rgb.png"):
        with pytest.raises(ValueError, match=rf"{name}: the mask has more than two"):
            read_mask(tmp_path / name)
    np.testing.assert_array_equal(read_mask(tmp_path / "davis.png", label=2), labels() == 2)
    with pytest.raises(ValueError, match="has colours"):
        read_mask(tmp_path / "rgb.png", label=2)


@pytest.mark.parametrize(
    "array", [RGB, RGB[..., 0], cv2.GaussianBlur(RGB, (0, 0), 6), (X * 255 // WIDTH).astype(np.uint8)]
)
def test_a_photo_is_no_mask(tmp_path, array):
    with pytest.raises(ValueError, match=r"photo\.png: the mask has"):
        read_mask(store(array, tmp_path / "photo.png"))


@given(st.integers(0, 90), st.integers(0, 60), st.integers(12, 60), st.integers(12, 60))
def test_an_inverted_mask_is_told(left, top, width, height):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top : top + height, left : left + width] = True
    border = np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]]).mean()
    frame(RGB, DEPTH, mask, K, resolution=56)
    if border < 0.25:
        with pytest.raises(ValueError, match="looks inverted"):
            frame(RGB, DEPTH, ~mask, K, resolution=56)


def test_a_mask_of_everything_is_none():
    for mask in (np.ones((HEIGHT, WIDTH), bool), np.full((HEIGHT, WIDTH), 255, np.uint8), np.ones((HEIGHT, WIDTH))):
        with pytest.raises(ValueError, match="the mask covers all of the image"):
            frame(RGB, DEPTH, mask, K)
        frame(RGB, DEPTH, mask, K, box=(30, 20, 40, 40))  # here the box says where the object is


# --- depth ------------------------------------------------------------------------------------------------------------

KINDS = ["u2", "i2", "u4", "i4", "i8", "u8", "f4", "f8", "f2"]


@pytest.mark.parametrize(("kind", "order"), list(itertools.product(KINDS, "<>")))
def test_byte_order_and_number_type_do_not_matter(tmp_path, kind, order):
    """The same depth in any type is the same crop, also where it is cut beyond the image's border."""
    mask = DISC & (X < 70)
    mask[:, :6] |= (Y > 40)[:, :6] & (Y < 60)[:, :6]
    exact = (DEPTH * 1000).round()  # millimetres; half floats have eleven bits
    exact = exact.clip(None, 2048) if kind == "f2" else exact
    depth = exact.astype(order + kind)
    scale = 1e-3
    expected = frame(RGB, exact.astype(np.float32), mask, K, depth_scale=scale, resolution=56)
    np.save(tmp_path / "depth.npy", depth)
    wide = (RGB.astype(np.uint16) * 257).astype(order + "u2")
    for given_depth in (depth, read_depth(tmp_path / "depth.npy"), depth[..., None]):
        view = frame(wide, given_depth, mask, K, depth_scale=scale, resolution=56)
        np.testing.assert_allclose(view.depth, expected.depth, atol=1e-6)
        np.testing.assert_allclose(view.rgb, expected.rgb, atol=0.01)


def tiff(array: np.ndarray, order: str) -> bytes:
    """An uncompressed TIFF of one strip, of any number type."""
    import struct

    kind = {"u": 1, "i": 2, "f": 3}[array.dtype.kind]
    data = array.astype(array.dtype.newbyteorder(order)).tobytes()
    height, width = array.shape
    entries = [
        (256, 4, width), (257, 4, height), (258, 3, 8 * array.dtype.itemsize), (259, 3, 1), (262, 3, 1), (273, 4, 8),
        (277, 3, 1), (278, 4, height), (279, 4, len(data)), (339, 3, kind),
    ]  # fmt: skip
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8 + len(data))
    block = struct.pack(order + "H", len(entries))
    for tag, size, value in entries:
        packed = struct.pack(order + "HH", value, 0) if size == 3 else struct.pack(order + "I", value)
        block += struct.pack(order + "HHI", tag, size, 1) + packed
    return head + data + block + b"\0\0\0\0"


@pytest.mark.parametrize(("kind", "order"), list(itertools.product(["u2", "i2", "i4", "f4", "f8"], "<>")))
def test_tiffs_of_every_number_type(tmp_path, kind, order):
    depth = (DEPTH * 1000).astype(kind)
    (tmp_path / "d.tif").write_bytes(tiff(depth, order))
    found = read_depth(tmp_path / "d.tif")
    np.testing.assert_array_equal(found, depth)
    assert found.dtype.isnative


@pytest.mark.parametrize("largest", [200, 300, 4095, 10000, 65535])
@pytest.mark.parametrize("comment", ["", "# 1 2 3\n"])
def test_numbers_of_a_pgm_are_those_in_the_file(tmp_path, largest, comment):
    values = np.arange(DEPTH.size).reshape(DEPTH.shape) % (largest + 1)
    head = f"P5\n{comment}{values.shape[1]} {values.shape[0]}\n{largest}\n".encode()
    (tmp_path / "d.pgm").write_bytes(head + values.astype("u1" if largest < 256 else ">u2").tobytes())
    if largest > 255:
        np.testing.assert_array_equal(read_depth(tmp_path / "d.pgm"), values)
    np.testing.assert_array_equal(read_mask(tmp_path / "d.pgm", label=7), values == 7)


@pytest.mark.parametrize(
    ("dtype", "sentinel", "scale"),
    [
        (np.uint16, 65535, 1e-3),
        (np.uint16, 65535, 1e-4),
        (np.int32, 65535, 1e-3),
        (np.int32, 2**31 - 1, 1e-3),
        (np.uint16, 10000, 1e-3),
        (np.uint16, 1, 1e-3),
        (np.float32, 65.535, 1.0),
        (np.float32, 1e10, 1.0),
        (np.float32, 100.0, 1.0),
        (np.float64, 1e-6, 1.0),
    ],
)
@pytest.mark.parametrize("share", [0.2, 0.6, 0.9])
def test_a_number_for_unknown_is_not_depth(dtype, sentinel, scale, share, caplog):
    rng = np.random.default_rng(1)
    holes = rng.uniform(size=DEPTH.shape) < share
    depth = (DEPTH / scale).astype(dtype)
    known = depth.copy()
    known[holes] = 0
    depth[holes] = sentinel
    with caplog.at_level(logging.INFO, "ipjax"):
        view = frame(RGB, depth, DISC, K, depth_scale=scale, resolution=56)
    assert "is taken for unknown" in caplog.text
    expected = frame(RGB, known, DISC, K, depth_scale=scale, resolution=56)
    np.testing.assert_array_equal(view.depth, expected.depth)
    if np.dtype(dtype).kind != "f":
        # The advice about the unit looks at what was measured.
        with pytest.raises(ValueError, match=f"median depth {np.median(known[known > 0]):.4g}: this looks like"):
            frame(RGB, depth, DISC, K)


@pytest.mark.parametrize("behind", [65535, 2000])
def test_a_flat_object_before_a_number_for_unknown_is_kept(behind):
    depth = np.where(DISC, 300, behind).astype(np.uint16)
    kept, said = remove_sentinel(depth)
    assert (kept[DISC] == 300).all() and not kept[~DISC].any() and said.count("%") == 1


def test_where_nothing_was_measured_there_is_no_depth():
    for depth in (np.full(DEPTH.shape, 65535, np.uint16), np.where(DISC, 65535, 0).astype(np.uint16)):
        with pytest.raises(ValueError, match="there is no depth inside the mask"):
            frame(RGB, depth, DISC, K, depth_scale=1e-3)
    hidden = np.random.default_rng(0).uniform(size=DEPTH.shape) < 0.3
    expected = frame(RGB, np.where(hidden, 0, DEPTH), DISC, K, resolution=56)
    view = frame(RGB, np.ma.masked_array(np.where(hidden, 0.3, DEPTH), hidden), DISC, K, resolution=56)
    np.testing.assert_array_equal(view.depth, expected.depth)


def test_depth_that_only_looks_alike_is_kept():
    wall = DEPTH.copy()
    wall[:, 64:] = 1.3  # a wall seen straight on, behind everything
    for depth in (DEPTH, wall, np.minimum(DEPTH, 1.0), (DEPTH * 1000).astype(np.uint16)):
        kept, said = remove_sentinel(depth)
        assert kept is depth and said == ""


# --- which way up -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [2, 3, 4, 5, 6, 7, 8])
def test_images_that_are_to_be_turned_are_refused_where_others_belong_to_them(tmp_path, turn):
    exif = Image.Exif()
    exif[0x0112] = turn
    stored = RGB[:96, :96]
    for name in ("rgb.jpg", "rgb.png", "rgb.tif"):
        store(stored, tmp_path / name, exif=exif)
        with pytest.raises(ValueError, match=rf"EXIF orientation \({turn}\)"):
            read_rgb(tmp_path / name)
    mask = DISC[:96, :96].astype(np.uint8) * 255
    with pytest.raises(ValueError, match=rf"EXIF orientation \({turn}\)"):
        read_mask(store(mask, tmp_path / "m.png", exif=exif))
    with pytest.raises(ValueError, match=rf"EXIF orientation \({turn}\)"):
        read_depth(store((DEPTH * 1000).astype(np.uint16), tmp_path / "d.png", exif=exif))
    # A photo alone is shown as it is to be shown, a TIFF too, which Pillow turns by itself. With a mask, nobody knows
    # which way up that one is.
    assert read_photo(tmp_path / "rgb.png").orientation == turn
    np.testing.assert_array_equal(read_photo(tmp_path / "rgb.tif").rgb, read_photo(tmp_path / "rgb.png").rgb)
    plain = store(mask, tmp_path / "plain.png")
    for beside in ({"mask": plain}, {"mask": mask}, {"box": (30, 20, 60, 60), "camera": K}):
        with pytest.raises(ValueError, match=rf"EXIF orientation \({turn}\)"):
            prepare_photo(tmp_path / "rgb.png", **beside)


def test_images_that_are_upright_say_so_or_nothing(tmp_path):
    exif = Image.Exif()
    for turn in (None, 0, 1, 9, 77):
        if turn is not None:
            exif[0x0112] = turn
        store(RGB, tmp_path / "rgb.png", exif=exif)
        np.testing.assert_array_equal(read_rgb(tmp_path / "rgb.png"), RGB)


def test_pixels_come_back_from_lossless_files(tmp_path):
    for name, how in (("a.png", {}), ("a.bmp", {}), ("a.tif", {}), ("a.webp", {"lossless": True}), ("a.ppm", {})):
        np.testing.assert_array_equal(read_rgb(store(RGB, tmp_path / name, **how)), RGB)
    buffer = io.BytesIO()
    Image.fromarray(RGB).save(buffer, "JPEG2000")
    (tmp_path / "b.png").write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="not an image"):
        read_rgb(tmp_path / "b.png")
