"""Detections in two dimensions, as BOP's challenges keep them: reading, writing, and the targets that they give.

A JSON file is a list of scene_id, image_id, category_id, score, bbox (x, y, width, height of the whole silhouette),
segmentation (run lengths of what is visible) and time (seconds for the whole image, the same in all of its entries);
https://bop.felk.cvut.cz/challenges/bop-challenge-2022/, section 5.1. Files of CNOS and SAM-6D (npz, one an image) are
read as well.
"""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from ipjax.bop.records import DatasetError, Target, TargetRow
from ipjax.files.images.annotations import Annotation, decode_segmentation, read_annotations
from ipjax.files.images.masks import box_of
from ipjax.files.images.run_lengths import encode_rle
from ipjax.files.storage.writing import write_text

TIME_SLACK = 1e-3  # seconds by which times of one image may differ (inout.py, check_consistent_timings)


@dataclass(frozen=True)
class Detection:
    """A detection or segmentation in BOP's JSON form; the mask is decoded when asked for."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    box: tuple[float, float, float, float] | None  # x, y, width, height; pixels
    time: float  # for the whole image, seconds; −1 = unknown
    segmentation: Any = field(repr=False, default=None)  # of any form that `decode_segmentation` knows
    size: tuple[int, int] | None = field(repr=False, default=None)  # height, width; polygons need it

    @property
    def mask(self) -> np.ndarray | None:
        """The segmentation as bool [h, w], decoded anew: those of a data set would not fit into memory together.

        None where there is only a box. Raises DatasetError for what is damaged; names scene, image and object.
        """
        if self.segmentation is None:
            return None
        try:
            return decode_segmentation(self.segmentation, self.size)
        except ValueError as error:
            where = f"the mask of object {self.obj_id} in scene {self.scene_id}, image {self.im_id}"
            raise DatasetError(f"{where}: {error}") from None


def as_detection(
    scene_id: int,
    im_id: int,
    obj_id: int,
    score: float,
    mask: Bool[np.ndarray, "h w"],
    time: float = -1.0,
    box: Sequence[float | int] | None = None,
) -> Detection:
    """A mask as a detection; without a ``box`` (of the whole silhouette, pixels) it gets that of the mask.

    Raises ValueError where the mask is empty.
    """
    if box is None:
        box = box_of(mask)
        if box is None:
            raise ValueError(f"the mask of object {obj_id} in scene {scene_id}, image {im_id} is empty")
    x, y, width, height = map(float, box)
    return Detection(scene_id, im_id, obj_id, float(score), (x, y, width, height), float(time), encode_rle(mask))


def read_detections(path: str | Path, *, problems: list[str] | None = None) -> list[Detection]:
    """Detections or segmentations of a BOP JSON file (also .json.gz), of CNOS's npz, or of a folder of such npz.

    Raises DatasetError (file, entry, what is wrong) for what is no such file, for entries without scene, image or
    category, numbers that are not finite, boxes of negative size, and times that differ within an image. Give a list as
    ``problems`` to have such entries left out, and the sentences collected there, instead.
    """
    path = Path(path)
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if not files:
        raise DatasetError(f"{path}: there are no npz files of detections in this folder")
    found: list[Detection] = []
    times: dict[tuple[int, int], float] = {}
    for file in files:
        try:
            annotations = read_annotations(file, problems=problems)
        except ValueError as error:
            raise DatasetError(str(error)) from None
        for annotation in annotations:
            try:
                detection = _as_detection(annotation)
                first = times.setdefault((detection.scene_id, detection.im_id), detection.time)
                if abs(first - detection.time) > TIME_SLACK:
                    raise ValueError(
                        f"time is for the whole image: {detection.time:g} s here, but {first:g} s in another entry of "
                        f"scene {detection.scene_id}, image {detection.im_id}"
                    )
            except ValueError as error:
                message = f"{annotation.where}: {error}"
                if problems is None:
                    raise DatasetError(message) from None
                problems.append(message)
            else:
                found.append(detection)
    return found


def write_detections(path: str | Path, detections: Iterable[Detection]) -> Path:
    """Write detections as BOP's toolkit does: a JSON list, an entry a line; whole or not at all.

    A missing box is ``[]``, a missing mask ``{}``. Raises ValueError for numbers that are not finite, times that are
    negative (but −1, unknown) or differ within an image: the challenge refuses such files.
    """
    lines = []
    times: dict[tuple[int, int], float] = {}
    for one in detections:
        where = f"a detection of scene {one.scene_id}, image {one.im_id}, object {one.obj_id}"
        if not all(map(math.isfinite, (one.score, one.time, *(one.box or ())))):
            raise ValueError(f"{where} is not finite")
        if one.time < 0 and one.time != -1:
            raise ValueError(f"{where}: time must be seconds, or -1 where it is unknown, got {one.time:g}")
        first = times.setdefault((one.scene_id, one.im_id), one.time)
        if abs(first - one.time) > TIME_SLACK:
            raise ValueError(f"{where}: time is for the whole image: {one.time:g} s, but {first:g} s in another")
        entry = {
            "scene_id": int(one.scene_id),
            "image_id": int(one.im_id),
            "category_id": int(one.obj_id),
            "score": float(one.score),
            "bbox": [] if one.box is None else [int(x) if float(x).is_integer() else float(x) for x in one.box],
            "segmentation": {} if (mask := one.mask) is None else encode_rle(mask, compressed=False),
            "time": float(one.time),
        }
        lines.append(json.dumps(entry, sort_keys=True))
    return write_text(path, "[\n" + ",\n".join(f"  {line}" for line in lines) + "\n]", parents=True)


def detected_targets(detections: Iterable[Detection], rows: Sequence[TargetRow]) -> list[Target]:
    """For each target row of one image its best detections, as many as it has instances."""
    detections = list(detections)
    found = []
    for row in rows:
        mine = [d for d in detections if (d.scene_id, d.im_id, d.obj_id) == (row.scene_id, row.im_id, row.obj_id)]
        mine.sort(key=lambda d: -d.score)
        found += [Target(d.obj_id, d.mask, d.score) for d in mine[: row.count]]
    return found


def every_target(detections: Iterable[Detection], objects: Iterable[int] | None, most: int = 100) -> list[Target]:
    """Of one image every detection of these objects as a target, the surest first: the task of 6-D detection, in which
    nobody says what is there. BOP counts the ``most`` estimates of an image."""
    wanted = None if objects is None else set(objects)
    mine = sorted((d for d in detections if wanted is None or d.obj_id in wanted), key=lambda d: -d.score)
    return [Target(d.obj_id, d.mask, d.score) for d in mine[:most]]


def _as_detection(one: Annotation) -> Detection:
    for name in ("scene_id", "image_id", "category_id"):
        if getattr(one, name) is None:
            raise ValueError(f"a detection needs scene_id, image_id, category_id, score ({name} is missing)")
    assert one.scene_id is not None and one.image_id is not None and one.category_id is not None
    if one.time < 0 and one.time != -1:
        raise ValueError(f"time must be seconds, or -1 where it is unknown, got {one.time:g}")
    segmentation = one.segmentation
    if isinstance(segmentation, np.ndarray):  # those of a data set would not fit into memory
        segmentation = encode_rle(decode_segmentation(segmentation))
    score = 1.0 if one.score is None else one.score
    return Detection(one.scene_id, one.image_id, one.category_id, score, one.box, one.time, segmentation, one.size)
