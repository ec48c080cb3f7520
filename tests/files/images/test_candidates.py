"""Other people's masks: every form gives the same masks back, and damaged or hostile files are one sentence."""

import io
import json
import zipfile

import numpy as np
import pytest
from PIL import Image

from ipjax.files.images.candidates import read_candidates
from ipjax.files.images.polygons import fill_polygons
from ipjax.files.images.run_lengths import encode_rle

SIZE = (48, 64)
FIRST, SECOND = np.zeros(SIZE, bool), np.zeros(SIZE, bool)
FIRST[5:20, 10:30] = True
SECOND[25:44, 33:60] = True
BOTH = np.stack([FIRST, SECOND])


def polygon(mask):
    y, x = np.nonzero(mask)
    left, right, top, bottom = x.min(), x.max() + 1, y.min(), y.max() + 1
    return [[int(v) for v in (left, top, right, top, right, bottom, left, bottom)]]


def bop(mask, **more):
    return {"scene_id": 3, "image_id": 7, "category_id": 5, "score": 0.5, "bbox": [1, 2, 3, 4], "time": 0.2} | {
        "segmentation": encode_rle(mask),
        **more,
    }


def write(path, content):
    if path.suffix == ".json":
        path.write_text(json.dumps(content))
    elif path.suffix == ".npz":
        np.savez_compressed(path, **content)
    elif path.suffix == ".npy":
        np.save(path, content)
    else:
        content.save(path)
    return path


def palette_image(labels):
    image = Image.fromarray(labels.astype(np.uint8), "P")
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0])
    return image


LABELS = (FIRST * 1 + SECOND * 2).astype(np.uint8)
COLOURS = np.zeros((*SIZE, 3), np.uint8)
COLOURS[FIRST], COLOURS[SECOND] = (200, 30, 30), (30, 30, 200)
SAM = {"predicted_iou": 0.9, "stability_score": 0.97, "area": 300, "crop_box": [0, 0, 64, 48], "point_coords": [[1, 2]]}
CNOS = {"scene_id": 3, "image_id": 7, "category_id": np.array([5, 2]), "score": np.array([0.5, 0.25], np.float32)} | {
    "bbox": np.array([[10, 5, 20, 15], [33, 25, 27, 19]]),
    "time": 0.2,
}
# The file's name, what is in it, and the scores and categories that are read; the masks are always these two.
TWO = {
    "BOP JSON": ("d.json", [bop(FIRST), bop(SECOND, score=0.25, category_id=2)], [0.5, 0.25], [5, 2]),
    "CNOS npz": ("d.npz", CNOS | {"segmentation": BOTH}, [0.5, 0.25], [5, 2]),
    "CNOS npz of raw values": ("d.npz", CNOS | {"segmentation": 9.0 * BOTH - 4}, [0.5, 0.25], [5, 2]),
    "plain npz": ("d.npz", {"masks": BOTH[:, None], "scores": np.array([0.5, 0.25])}, [0.5, 0.25], [None, None]),
    "COCO results, runs not compressed": (
        "d.json",
        [
            {"image_id": 1, "category_id": 5, "score": s, "segmentation": encode_rle(m, compressed=False)}
            for m, s in ((FIRST, 0.5), (SECOND, 0.25))
        ],
        [0.5, 0.25],
        [5, 5],
    ),
    "COCO data set with polygons": (
        "d.json",
        {
            "images": [{"id": 4, "height": 48, "width": 64}, {"id": 9, "height": 3, "width": 3}],
            "annotations": [
                {"id": i, "image_id": 4, "category_id": 6, "segmentation": polygon(m)}
                for i, m in enumerate((FIRST, SECOND))
            ],
        },
        [None, None],
        [6, 6],
    ),
    "SAM's generator": ("d.json", [SAM | {"segmentation": encode_rle(m)} for m in BOTH], [0.9, 0.9], [None, None]),
    "SAM's generator, rows of booleans": (
        "d.json",
        [SAM | {"segmentation": m.tolist()} for m in BOTH],
        [0.9, 0.9],
        [None, None],
    ),
    "Grounded-SAM": (
        "d.json",
        {
            "annotations": [
                {"class_name": "mug", "bbox": [1, 2, 9, 9], "segmentation": encode_rle(m), "score": [0.5]} for m in BOTH
            ],
            "box_format": "xyxy",
            "img_width": 64,
            "img_height": 48,
        },
        [0.5, 0.5],
        [None, None],
    ),
    "masks alone": ("d.json", [encode_rle(m) for m in BOTH], [None, None], [None, None]),
    "boolean stack": ("d.npy", BOTH, [None, None], [None, None]),
    "stack with a channel": ("d.npy", BOTH[:, None].astype(np.uint8), [None, None], [None, None]),
    "labels, 8 bits": ("d.png", Image.fromarray(LABELS), [None, None], [None, None]),
    "labels, 16 bits": ("d.png", Image.fromarray(LABELS.astype(np.uint16) * 1000), [None, None], [None, None]),
    "labels of nearly the same number": (
        "d.png",
        Image.fromarray((FIRST * 14 + SECOND * 15).astype(np.uint8)),
        [None, None],
        [None, None],
    ),
    "labels as an array": ("d.npy", LABELS.astype(np.int64), [None, None], [None, None]),
    "palette of three": ("d.png", palette_image(LABELS), [None, None], [None, None]),
    "flat colours": ("d.png", Image.fromarray(COLOURS), [None, None], [None, None]),
}


@pytest.mark.parametrize("name", TWO)
def test_each_form_of_two_masks(name, tmp_path):
    file, content, scores, categories = TWO[name]
    path = write(tmp_path / file, content)
    found = read_candidates(path, size=SIZE)
    # Colours are in the order of their numbers; all else in that of the file.
    order = found[::-1] if name == "flat colours" else found
    np.testing.assert_array_equal(np.stack([one.mask for one in order]), BOTH)
    assert [one.index for one in found] == [0, 1]
    assert [one.score for one in found] == pytest.approx(scores)
    assert [one.category for one in found] == categories
    assert all(str(path) in one.source for one in found) and found[0].source != found[1].source


ALPHA = np.dstack([np.full((*SIZE, 3), 90, np.uint8), FIRST * np.uint8(255)])
ONE = {
    "0 and 1": Image.fromarray(FIRST.astype(np.uint8)),
    "0 and 255": Image.fromarray(FIRST.astype(np.uint8) * 255),
    "one bit": Image.fromarray(FIRST),
    "palette of two": palette_image(FIRST),
    "transparency": Image.fromarray(ALPHA, "RGBA"),
    "colour": Image.fromarray(np.dstack([FIRST] * 3).astype(np.uint8) * 255),
}


@pytest.mark.parametrize("name", ONE)
def test_an_image_of_one_mask_is_one_candidate(name, tmp_path):
    (one,) = read_candidates(write(tmp_path / "m.png", ONE[name]), size=SIZE)
    np.testing.assert_array_equal(one.mask, FIRST)
    assert (one.score, one.category, one.index) == (None, None, 0)


def test_the_image_of_several_is_chosen(tmp_path):
    third = bop(FIRST, scene_id=4)
    path = write(tmp_path / "d.json", [bop(SECOND, image_id=8), bop(FIRST), third])
    with pytest.raises(ValueError, match="detections of 3 images: say which"):
        read_candidates(path)
    with pytest.raises(ValueError, match="image 7 in 2 scenes"):
        read_candidates(path, image=7)
    with pytest.raises(ValueError, match="no detections of image 6"):
        read_candidates(path, image=6)
    (one,) = read_candidates(path, image=8)
    assert one.index == 0
    (one,) = read_candidates(path, image=7, scene=4)
    assert one.index == 2


def test_the_only_image_of_a_file_is_taken_and_told(tmp_path, caplog):
    path = write(tmp_path / "d.json", [bop(FIRST)])
    with caplog.at_level("INFO", "ipjax"):
        for image, told in ((None, 0), (7, 0), (6, 1)):
            caplog.clear()
            (one,) = read_candidates(path, image=image)
            assert one.index == 0 and len(caplog.records) == told
    assert "of image 7, and are taken for those of image 6" in caplog.text


def test_a_small_number_close_to_a_large_one_is_a_label_and_no_dirt(tmp_path):
    labels = np.zeros(SIZE, np.uint8)
    labels[10:20, 10:20], labels[10:30, 21:40] = 1, 21
    first, second = read_candidates(write(tmp_path / "m.png", Image.fromarray(labels)), size=SIZE)
    assert (first.mask == (labels == 1)).all() and (second.mask == (labels == 21)).all()


class Hostile:
    """What unpickles to a program."""

    def __reduce__(self):
        return (eval, ("__import__('pathlib').Path('touched').touch()",))


def npz_of_zeros(shape):
    """A few kilobytes that unpack to as much as the shape says."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("masks.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
        file.write(bytes(2**20))
    return buffer.getvalue()


PICKLED = np.array([Hostile()], object)
COARSE = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
REFUSED = {
    "pickled npy": ("d.npy", PICKLED, "Python objects"),
    "pickled npz": ("d.npz", {"masks": PICKLED}, "Python objects"),
    "npz of gigabytes": ("d.npz", npz_of_zeros((2000, 2000, 2000)), "MB of memory"),
    "npz of masks without pixels": ("d.npz", npz_of_zeros((10**10, 0, 0)), "masks must be numbers"),
    "npz of millions of pixels, a mask each": ("d.npz", npz_of_zeros((2**20, 1, 1)), "1,048,576 masks would take"),
    "npy of masks without pixels": ("d.npy", np.ones((10**10, 0, 0), bool), "masks must be numbers"),
    "npy of nothing but NaN": ("d.npy", np.full((2, *SIZE), np.nan, np.float32), "mask 0: .* not finite"),
    "npz cut short": ("d.npz", npz_of_zeros((20, 2000, 2000)), "not a readable npz file"),
    "npz of something else": ("d.npz", {"vertices": np.zeros(3)}, "it has no masks"),
    "npz with scores of others": ("d.npz", {"masks": BOTH, "scores": np.ones(3)}, "2 masks, but 3 of scores"),
    "no zip file": ("d.npz", b"hello", "not a readable npz file"),
    "giant run": ("d.json", [{"size": [48, 64], "counts": [10**30]}], "whole numbers"),
    "giant mask": ("d.json", [{"size": [10**9, 10**9], "counts": [10**18]}], "MB of memory"),
    "endless number": ("d.json", [{"size": [48, 64], "counts": "o" * 300_000}], "no image has pixels for"),
    "infinite size": ("d.json", '[{"size": [1e999, 5], "counts": [5]}]', "needs size"),
    "counts of counts": ("d.json", [{"size": [48, 64], "counts": [[1, 2], 3]}], "whole numbers"),
    "runs too few": ("d.json", [{"size": [48, 64], "counts": [7]}], "entry 0: the runs of a mask cover 7"),
    "another size": (
        "d.json",
        [encode_rle(np.eye(9, dtype=bool))],
        "entry 0: its mask is 9 × 9, but the image 64 × 48",
    ),
    "another size, an image": ("m.png", Image.fromarray(np.eye(9) > 0), "rgb is 64 × 48 but the mask is 9 × 9"),
    "another size, a stack": ("d.npy", np.ones((2, 5, 5), bool), "mask 0: rgb is 64 × 48 but the mask is 5 × 5"),
    "boxes only": ("d.json", [bop(FIRST, segmentation={})], "boxes, but no masks"),
    "nothing": ("d.json", [], "no detections"),
    "neither": ("d.json", {"a": 1}, "neither detections"),
    "a number": ("d.json", [3], "entry 0: a detection must be a dictionary"),
    "half a corner": ("d.json", [bop(FIRST, segmentation=[[1, 2, 3, 4, 5]])], "three corners"),
    "corner at infinity": ("d.json", '[{"segmentation": [[1, 2, 3, 4, 1e999, 5]]}]', "finite"),
    "score of text": ("d.json", [bop(FIRST, score="high")], "score must be a number"),
    "score not finite": ("d.json", '[{"score": NaN, "segmentation": [[1, 2, 3, 4, 1, 5]]}]', "not a finite number"),
    "category of a half": ("d.json", [bop(FIRST, category_id=1.5)], "whole number"),
    "a photo": ("m.png", Image.fromarray(COARSE), "photo"),
    "a grey photo": ("m.png", Image.fromarray(COARSE[..., 0]), "photo"),
    "missing": ("d.json", None, "no such"),
    "not JSON": ("d.json", "[{", "not valid JSON"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_and_hostile_files_are_one_sentence(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file, content, words = REFUSED[name]
    path = tmp_path / file
    if isinstance(content, str | bytes):
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    elif content is not None:
        write(path, content)
    with pytest.raises(ValueError, match=words) as caught:
        read_candidates(path, size=SIZE)
    assert file in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "touched").exists()


def test_polygons_hold_the_pixels_whose_centres_are_inside():
    """Against the definition, pixel by pixel: the even-odd rule on a ray from each centre."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        corners = rng.uniform(-5, 40, (rng.integers(3, 9), 2))
        found = fill_polygons([corners.ravel().tolist()], (30, 36))
        slow = np.zeros((30, 36), bool)
        for y, x in np.ndindex(slow.shape):
            inside = False
            for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                if (x0 <= x + 0.5) != (x1 <= x + 0.5):
                    inside ^= y0 + (x + 0.5 - x0) / (x1 - x0) * (y1 - y0) <= y + 0.5
            slow[y, x] = inside
        np.testing.assert_array_equal(found, slow)
    two = fill_polygons([[0, 0, 4, 0, 4, 4, 0, 4], [2, 2, 6, 2, 6, 6, 2, 6]], (8, 8))
    assert two.sum() == 28  # of several polygons the union, as COCO has it
