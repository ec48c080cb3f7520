"""The object in a photo: every kind of file, every way to a mask, and one sentence for what cannot work."""

import numpy as np
import pytest
from builders.golden import GOLDEN
from golden.make_triposr import digest
from PIL import Image

from ipjax.onboarding import foreground
from ipjax.onboarding.foreground import ForegroundError, Photo


def _scene(height=120, width=160, background=(200, 205, 210)):
    """A ball on a plain ground, with a little noise; and its mask."""
    y, x = np.mgrid[:height, :width]
    mask = (x - 80) ** 2 + (y - 55) ** 2 < 30**2
    rgb = np.full((height, width, 3), background, float)
    rgb[mask] = (180, 40, 30)
    rgb += np.random.default_rng(0).normal(0, 2, rgb.shape)
    return np.clip(rgb, 0, 255).astype(np.uint8), mask


def _overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_cut_and_composite_are_the_official_ones():
    """Bit by bit what the published model was trained with."""
    with np.load(GOLDEN / "triposr_tiny.npz") as golden:
        rgba = golden["pre/rgba_in"]
        for name, ratio in (("085", 0.85), ("05", 0.5), ("10", 1.0)):
            square, (x, y) = foreground.crop_foreground(rgba, ratio)
            assert digest(square) == str(golden[f"pre/resize_foreground_{name}_sha256"])
            row, column = np.argwhere(square[..., 3] == 255)[0]
            np.testing.assert_array_equal(square[row, column], rgba[row + y, column + x])  # where the corner lies
        square, _ = foreground.crop_foreground(rgba)
        np.testing.assert_array_equal(foreground.composite_grey(square), golden["pre/composite_u8"])


@pytest.mark.parametrize("kind", ["cmyk.jpg", "palette.png", "grey16.png", "grey.png", "la.png", "rgba.png"])
def test_every_kind_of_file_becomes_rgb(tmp_path, kind):
    rgb, mask = _scene()
    image = Image.fromarray(rgb)
    path = tmp_path / kind
    if kind == "cmyk.jpg":
        image.convert("CMYK").save(path, quality=95)
    elif kind == "palette.png":
        image.quantize(64).save(path)
    elif kind == "grey16.png":
        Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 257).save(path)
    elif kind == "grey.png":
        image.convert("L").save(path)
    else:
        image = image.convert("LA" if kind == "la.png" else "RGBA")
        image.putalpha(Image.fromarray(mask.astype(np.uint8) * 255))
        image.save(path)
    photo = foreground.read_photo(path)
    assert photo.rgb.shape == rgb.shape and photo.rgb.dtype == np.uint8
    expected = np.asarray(Image.fromarray(rgb).convert("L").convert("RGB")) if "gr" in kind or kind == "la.png" else rgb
    assert np.abs(photo.rgb[mask].astype(int).mean(0) - expected[mask].mean(0)).max() < 12
    found = foreground.find_foreground(photo)
    assert found.method == ("alpha" if kind in ("la.png", "rgba.png") else "background")
    # JPEG and the palette smear colours over the edge.
    assert _overlap(found.mask, mask) > 0.9


def test_exif_is_obeyed_and_huge_photos_are_reduced(tmp_path):
    rgb, _ = _scene()
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by a quarter
    Image.fromarray(rgb).save(tmp_path / "turned.jpg", exif=exif, quality=95)
    turned = foreground.read_photo(tmp_path / "turned.jpg")
    assert turned.rgb.shape == (160, 120, 3)
    assert np.abs(turned.rgb.astype(int) - np.rot90(rgb, -1)).mean() < 4
    Image.fromarray(rgb).resize((1600, 1200)).save(tmp_path / "huge.jpg")
    small = foreground.read_photo(tmp_path / "huge.jpg", max_side=160)
    assert small.rgb.shape == (120, 160, 3)
    assert small.scale == pytest.approx(0.1)
    assert any("reduced to 160 × 120" in note for note in small.notes)
    # A box is in pixels of the file; a mask may be as large as the file.
    box = foreground.find_foreground(small, box=(480, 230, 1120, 870))
    assert _overlap(box.mask, _scene()[1]) > 0.9
    given = foreground.find_foreground(small, mask=np.kron(_scene()[1], np.ones((10, 10), bool)))
    assert _overlap(given.mask, _scene()[1]) > 0.95


@pytest.mark.parametrize("how", [{"box": (40, 15, 120, 95)}, {"click": (80, 55)}])
def test_grabcut_finds_the_object_on_a_busy_ground(how, tmp_path):
    rgb, mask = _scene()
    y, x = np.mgrid[:120, :160]
    busy = np.stack([60 + 90 * ((x // 8 + y // 8) % 2), 120 + 0 * x, 200 - 90 * ((x // 8 + y // 8) % 2)], -1)
    photo = Photo(np.where(mask[..., None], rgb, busy).astype(np.uint8))
    found = foreground.find_foreground(photo, **how)
    assert found.method == "grabcut"
    assert _overlap(found.mask, mask) > 0.9
    with pytest.raises(ForegroundError, match="background is not plain: give a mask, a box"):
        foreground.find_foreground(photo, tried=tmp_path / "tried.png")
    with Image.open(tmp_path / "tried.png") as sheet:
        assert sheet.size == (320, 144)  # the photo and one attempt, with a title each


def test_photos_without_an_object_are_refused_in_one_sentence(tmp_path):
    rgb, mask = _scene()
    zero = np.zeros_like(mask)
    tiny = zero.copy()
    tiny[50:54, 50:54] = True
    cases = [
        (Photo(np.full_like(rgb, 90)), {}, "blank"),
        (Photo(rgb, np.zeros(mask.shape, np.uint8)), {}, "transparent everywhere"),
        (Photo(rgb), {"mask": zero}, "mask is empty"),
        (Photo(rgb), {"mask": ~zero}, "covers the whole photo"),
        (Photo(rgb), {"mask": ~mask}, "touches all four borders"),
        (Photo(rgb), {"mask": tiny}, "only 4 × 4 pixels"),
        (Photo(rgb), {"mask": mask[:50]}, "do not belong together"),
        (Photo(rgb), {"click": (500, 5)}, "outside the photo"),
        (Photo(rgb), {"box": (300, 10, 400, 50)}, "does not enclose"),
    ]
    for photo, how, words in cases:
        with pytest.raises(ForegroundError, match=words) as error:
            foreground.find_foreground(photo, **how)
        assert "\n" not in str(error.value)
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ValueError, match=r"text\.png: not an image"):
        foreground.read_photo(tmp_path / "text.png")
    with pytest.raises(ValueError, match="no such file"):
        foreground.read_photo(tmp_path / "none.png")


def test_specks_are_dropped_and_borders_are_told():
    rgb, mask = _scene()
    speckled = mask.copy()
    speckled[5:14, 5:14] = True
    found = foreground.find_foreground(Photo(rgb), mask=speckled)
    np.testing.assert_array_equal(found.mask, mask)
    assert any("specks" in note for note in found.notes)
    cut = np.roll(mask, -35, axis=0)
    cut[60:] = False
    assert any("touches the top border" in n for n in foreground.find_foreground(Photo(rgb), mask=cut).notes)
