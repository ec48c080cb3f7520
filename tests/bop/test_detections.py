"""Detections are read, the best of them become targets, and damage is named."""

import dataclasses
import json

import numpy as np
import pytest

from ipjax.bop.detections import detected_targets, read_detections
from ipjax.bop.records import DatasetError, TargetRow
from ipjax.files.images.run_lengths import encode_rle


def test_detections_and_the_best_of_them(tmp_path):
    mask = np.zeros((4, 5), bool)
    mask[1:3, 2:4] = True
    entry = {"scene_id": 0, "image_id": 1, "category_id": 2, "score": 0.5, "bbox": [2, 1, 2, 2], "time": 0.1}
    path = tmp_path / "detections.json"
    path.write_text(json.dumps([entry | {"segmentation": encode_rle(mask)}, entry | {"score": 0.9}]))
    found = read_detections(path)
    np.testing.assert_array_equal(found[0].mask, mask)
    assert found[1].mask is None
    # What is read of a whole data set keeps no decoded masks, and damage says where it is.
    assert not any(isinstance(value, np.ndarray) for value in vars(found[0]).values())
    with pytest.raises(DatasetError, match="mask of object 2 in scene 0, image 1: the runs of a mask cover 3"):
        _ = dataclasses.replace(found[0], segmentation={"size": [4, 5], "counts": [3]}).mask
    targets = detected_targets(found, [TargetRow(0, 1, 2, 1)])
    assert [t.score for t in targets] == [0.9]
    path.write_text(json.dumps([{"scene_id": 1}]))
    with pytest.raises(DatasetError, match="entry 0: a detection needs"):
        read_detections(path)
