"""A focal length by EXIF: what cameras write, and what cannot be."""

import math

import numpy as np
import pytest
from builders.exif import FOCAL, HEIGHT, WIDTH, make_exif
from builders.exif import FOCAL_ON_FILM as FILM
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from ipjax.files.cameras.exif import DEVIATION, UNUSUAL_DEVIATION, find_focal
from ipjax.files.images.opening import get_tags, open_image

PLANE_X, PLANE_UNIT, ZOOM = 0xA20E, 0xA210, 0xA404
PHONE = {FOCAL: IFDRational(57, 10), FILM: 26, WIDTH: 4032, HEIGHT: 3024}
ON_FILM = 26 * math.hypot(4032, 3024) / math.hypot(36, 24)  # 3028 px
REFLEX = {FOCAL: IFDRational(50), PLANE_X: IFDRational(5184000, 905), PLANE_UNIT: 2, WIDTH: 5184, HEIGHT: 3456}
ON_PLANE = 50 * 5184000 / 905 / 25.4  # 11 275 px


@pytest.mark.parametrize(
    ("tags", "size", "pixels", "deviation"),
    [
        (PHONE, (4032, 3024), ON_FILM, DEVIATION),
        (PHONE, (3024, 4032), ON_FILM, DEVIATION),  # turned by an editor, or by its orientation
        (PHONE, (1008, 756), ON_FILM / 4, DEVIATION),  # reduced since
        (REFLEX, (5184, 3456), ON_PLANE, DEVIATION),
        (REFLEX, (2592, 1728), ON_PLANE / 2, DEVIATION),
        (REFLEX | {PLANE_X: 5184000 / 905 / 2.54, PLANE_UNIT: 3}, (5184, 3456), ON_PLANE, DEVIATION),
        (REFLEX | {FILM: 80}, (5184, 3456), 80 * math.hypot(5184, 3456) / math.hypot(36, 24), DEVIATION),
        (REFLEX | {FILM: 0}, (5184, 3456), ON_PLANE, DEVIATION),  # 0 is unknown
        ({FILM: 26}, (1920, 1080), 26 * math.hypot(1920, 1080) / math.hypot(36, 24), UNUSUAL_DEVIATION),
    ],
)
def test_what_cameras_write(tags, size, pixels, deviation):
    found = find_focal(tags, size)
    assert found.pixels == pytest.approx(pixels, rel=1e-9) and found.deviation == deviation
    assert "EXIF tells" in found.note


@pytest.mark.parametrize(
    ("tags", "size", "words"),
    [
        ({}, (4032, 3024), ""),
        ({FOCAL: 5.7}, (4032, 3024), "in pixels"),
        (PHONE, (3024, 3024), "is a part"),  # cropped to a square
        (PHONE, (900, 756), "is a part"),
        ({FILM: 65535}, (4032, 3024), "no usual lens"),
        ({FILM: 1}, (4032, 3024), "no usual lens"),
        ({FILM: -26}, (4032, 3024), "in pixels"),
        ({FILM: "wide"}, (4032, 3024), "in pixels"),
        ({FOCAL: IFDRational(50, 0), PLANE_X: IFDRational(0, 0)}, (4032, 3024), "in pixels"),
        ({FOCAL: (50, 1, 3), FILM: float("nan")}, (4032, 3024), "in pixels"),
        (REFLEX | {ZOOM: 2}, (5184, 3456), "no pixels per millimetre"),
        (REFLEX | {PLANE_UNIT: 1}, (5184, 3456), "in pixels"),  # pixels per nothing
    ],
)
def test_nonsense_and_parts_of_images_are_ignored_in_words(tags, size, words):
    found = find_focal(tags, size)
    assert found.pixels is None and words in found.note and bool(found.note) == bool(words)


@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "tif"])
def test_every_kind_of_file_tells_its_tags(tmp_path, kind):
    exif = make_exif({FILM: 26, WIDTH: 40, HEIGHT: 30}, orientation=6)
    path = tmp_path / f"photo.{kind}"
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(path, exif=exif)
    tags = get_tags(open_image(path))
    assert (tags[FILM], tags[WIDTH], tags[HEIGHT]) == (26, 40, 30)


def test_a_broken_block_of_exif_is_none(tmp_path):
    path = tmp_path / "photo.jpg"
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(path, exif=b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + b"\xa5" * 40)
    assert find_focal(get_tags(open_image(path)), (40, 30)).pixels is None
