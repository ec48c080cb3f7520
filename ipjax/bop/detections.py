"""Detections and segmentations in BOP's JSON form, and the targets that they give an estimator."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ipjax.bop.records import DatasetError, Target, TargetRow
from ipjax.files.images.run_lengths import decode_rle
from ipjax.files.storage.parsing import read_json


@dataclass(frozen=True)
class Detection:
    """A detection or segmentation in BOP's JSON form; the mask is decoded when asked for."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    box: tuple[float, float, float, float] | None
    time: float
    segmentation: dict | None = field(repr=False, default=None)

    @cached_property
    def mask(self) -> np.ndarray | None:
        """The segmentation as bool [h, w]; None where there is only a box."""
        return None if self.segmentation is None else decode_rle(self.segmentation)


def read_detections(path: str | Path) -> list[Detection]:
    """Detections or segmentations in BOP's JSON form (scene_id, image_id, category_id, score, bbox, segmentation)."""
    path = Path(path)
    try:
        entries = read_json(path)
    except ValueError as error:
        raise DatasetError(str(error)) from None
    if not isinstance(entries, list):
        raise DatasetError(f"{path}: a list of detections is expected")
    found = []
    for number, entry in enumerate(entries):
        where = f"{path}, entry {number}"
        try:
            box = entry.get("bbox")
            detection = Detection(
                int(entry["scene_id"]),
                int(entry["image_id"]),
                int(entry["category_id"]),
                float(entry.get("score", 1.0)),
                None if box is None else (float(box[0]), float(box[1]), float(box[2]), float(box[3])),
                float(entry.get("time", -1.0)),
                entry.get("segmentation"),
            )
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise DatasetError(
                f"{where}: a detection needs scene_id, image_id, category_id, score ({error!r})"
            ) from None
        if not math.isfinite(detection.score):
            raise DatasetError(f"{where}: the score is not a finite number")
        found.append(detection)
    return found


def detected_targets(detections: Iterable[Detection], rows: Sequence[TargetRow]) -> list[Target]:
    """For each target row of one image its best detections, as many as it has instances."""
    detections = list(detections)
    found = []
    for row in rows:
        mine = [d for d in detections if (d.scene_id, d.im_id, d.obj_id) == (row.scene_id, row.im_id, row.obj_id)]
        mine.sort(key=lambda d: -d.score)
        found += [Target(d.obj_id, d.mask, d.score) for d in mine[: row.count]]
    return found
