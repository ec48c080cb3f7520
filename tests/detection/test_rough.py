"""A rough mask is mended by the poses in it and in proposals like it."""

import cv2
import numpy as np
from builders.detections import MATRIX, detector, make_frame, place
from builders.tiny_pipeline import assert_near

from ipjax.detection.assignment import overlap
from ipjax.detection.crops import cut_crop
from ipjax.detection.rough import mend_mask


def test_masks_that_are_wrong_come_out_as_the_object():
    """Half of it missing, a part of its neighbour, or too wide: what comes out is the object, and it is told what was
    added and removed."""
    frame = make_frame(place(-0.1, 0.02, seed=1), place(0.12, 0.0, seed=2))
    sought = detector()
    sight = sought.look(frame.rgb, frame.depth, MATRIX)
    truth, other = frame.masks
    half, wide = truth.copy(), cv2.dilate(truth.astype(np.uint8), np.ones((13, 13))) > 0
    half[:, : int(np.median(np.nonzero(truth)[1]))] = False
    beside = np.cumsum(other.any(0)) <= 0.3 * other.any(0).sum()
    for given in (half, wide, truth | (other & beside)):
        mended = mend_mask(sought, 0, sight, given)
        assert mended is not None and np.array_equal(mended.given, given)
        assert overlap(mended.mask, truth) > max(0.8, overlap(given, truth))
        assert mended.overlap == overlap(mended.mask, given)
        assert (mended.added > mended.removed) == (given is half)
        assert_near(mended.result.estimate.camera_from_object, frame.poses[0], 0.08, 0.1, 20)
    again = mend_mask(sought, 0, sight, half)
    crop = cut_crop(sight.scene, half, **sought.options)
    assert again is not None and crop is not None
    plain = sought.estimator.run(0, crop.view, crop.camera_from_crop)  # as it is told without mending
    assert float(again.first.estimate.confidence) == float(plain.estimate.confidence)
    assert again is not None and again.used and again.proposal in sight.rankings[0].proposals


def test_a_mask_without_depth_gives_nothing():
    frame, sought = make_frame(place(-0.1, 0.02, seed=1)), detector()
    depth = np.where(frame.masks[0], 0, frame.depth)
    assert mend_mask(sought, 0, sought.look(frame.rgb, depth, MATRIX), frame.masks[0]) is None
