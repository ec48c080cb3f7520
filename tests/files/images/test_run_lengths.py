"""Run-length masks come back, and damaged ones are refused."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given

from ipjax.files.images.run_lengths import decode_rle, encode_rle


@given(hnp.arrays(bool, (7, 9)))
def test_masks_survive_run_length_coding(mask):
    for compressed in (True, False):
        np.testing.assert_array_equal(decode_rle(encode_rle(mask, compressed=compressed)), mask)


def test_long_runs_and_cocos_text():
    mask = np.zeros((400, 600), bool)
    mask[100:300, 200:500] = True
    coded = encode_rle(mask)
    np.testing.assert_array_equal(decode_rle(coded), mask)
    # Worked by hand from COCO's rule: runs go down the columns and begin with background. 33 = 1 + 1 · 32 is the
    # characters 1 + 32 and 1, each plus 48.
    one = np.zeros((10, 10), bool)
    one[3, 3] = True
    assert encode_rle(one)["counts"] == "Q11R2"
    assert encode_rle(one, compressed=False)["counts"] == [33, 1, 66]
    np.testing.assert_array_equal(decode_rle({"size": [2, 2], "counts": [0, 1, 3]}), [[True, False], [False, False]])


def test_pycocotools_text():
    """What pycocotools 2.0.11 writes for this mask (``encode`` of an array in Fortran's order)."""
    mask = np.zeros((23, 31), bool)
    mask[4:9, 3:20] = mask[12:20, 10:13] = mask[0, 30] = True
    text = "Y25b00000000000000A34ML34ML34M;00000000000R7LRI"
    assert encode_rle(mask)["counts"] == text
    np.testing.assert_array_equal(decode_rle({"size": [23, 31], "counts": text.encode()}), mask)


@pytest.mark.parametrize(
    "segmentation",
    [
        {"size": [2, 2], "counts": [1, 2]},
        {"size": [2, 2], "counts": [5, -1]},
        {"size": [2, 2], "counts": "Q"},
        {"size": [2, 2], "counts": "é"},
        {"counts": [4]},
    ],
)
def test_damaged_masks_are_refused(segmentation):
    with pytest.raises(ValueError, match="mask"):
        decode_rle(segmentation)
