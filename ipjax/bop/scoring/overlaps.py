"""The average precision of detections in two dimensions, boxes and masks, as BOP's challenges define it.

Protocol: https://github.com/thodan/bop_toolkit (calc_gt_coco.py, eval_bop22_coco.py) and COCO's
(https://cocodataset.org/#detection-eval). What is annotated and less than a tenth visible need not be found, and a
detection that is matched to it is neither right nor wrong (``ignore`` of https://github.com/MartinSmeyer/cocoapi; there
are no crowds). What is not visible at all is not there. Boxes are those of whole silhouettes inside the image
("amodal"), masks of what is visible. Sizes of objects (small, medium, large) are not told apart.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ipjax.bop.dataset import VISIBLE, Dataset
from ipjax.bop.detections import Detection, read_detections
from ipjax.bop.records import DatasetError, Truth
from ipjax.files.images.masks import box_of
from ipjax.files.storage.writing import write_text
from ipjax.metrics.precision import OVERLAPS, box_overlaps, mask_overlaps, overlap_precision

DETECTIONS = 100  # of one object in one image that count
Kind = Literal["bbox", "segm"]
Images = list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # IoU [d, g], scores [d], ignored [g]; of each image


@dataclass(frozen=True)
class Precision:
    """COCO's figures for boxes or for masks: means over objects that are there to be found."""

    ap: float  # over IoU .5, .55 … .95
    ap50: float
    ap75: float
    ar: float  # the largest recall, over the same IoU
    objects: dict[int, float]  # AP of each object


@dataclass(frozen=True)
class DetectionScore:
    """How well a file of detections fits the annotations of a data set."""

    dataset: str
    method: str
    kinds: dict[str, Precision]  # "bbox", "segm": of what the file has
    images: int
    instances: int  # that are to be found
    ignored: int  # annotated, but hardly visible
    detections: int  # in the images of the targets
    seconds_per_image: float | None  # None where a time is unknown
    notes: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and text."""
        return asdict(self)

    def write_json(self, path: str | Path) -> Path:
        """The whole score as JSON."""
        return write_text(path, json.dumps(self.to_dict(), indent=1), parents=True)


def score_detections(
    detections: str | Path | Sequence[Detection],
    dataset: Dataset,
    kinds: Sequence[Kind] = ("bbox", "segm"),
    *,
    objects: Iterable[int] | None = None,
    boxes: Literal["amodal", "modal"] = "amodal",
    on_error: Literal["raise", "skip"] = "raise",
    method: str | None = None,
) -> DetectionScore:
    """Score detections on the images of a data set's targets.

    Args:
        detections: a file of `read_detections`, or what it holds.
        kinds: "bbox" scores the boxes, "segm" the masks, of what detections have them; what none has is left out.
        objects: only these.
        boxes: of the whole silhouette, or ("modal") of what is visible.
        on_error: "raise" stops at the first damaged entry; "skip" leaves it out and lists it in ``problems``.

    Raises DatasetError, one sentence with file and entry, for damaged files; ValueError for an unknown kind.
    """
    unknown = set(kinds) - {"bbox", "segm"}
    if unknown:
        raise ValueError(f"unknown kind {sorted(unknown)[0]!r}; choose from bbox, segm")
    problems: list[str] = []
    notes: list[str] = []
    source = "detections"
    if isinstance(detections, str | Path):
        source = str(detections)
        method = method or Path(detections).name.split(".")[0]
        detections = read_detections(detections, problems=problems if on_error == "skip" else None)
    known = set(dataset.models())
    chosen = known if objects is None else set(objects)
    grouped: dict[tuple[int, int], list[Detection]] = {image: [] for image in dataset.target_images}
    strays = 0
    for number, one in enumerate(detections):
        if one.obj_id not in known:
            message = f"{source}, entry {number}: the data set has no object {one.obj_id}"
            if on_error == "raise":
                raise DatasetError(message)
            problems.append(message)
        elif (one.scene_id, one.im_id) not in grouped:
            strays += 1
        elif one.obj_id in chosen:
            grouped[one.scene_id, one.im_id].append(one)
    if strays:
        notes.append(f"{strays} of {len(detections)} detections are of no target image and count for nothing")
    held = {
        "bbox": any(one.box is not None for mine in grouped.values() for one in mine),
        "segm": any(one.segmentation is not None for mine in grouped.values() for one in mine),
    }
    used = [kind for kind in kinds if held[kind]] or list(kinds)
    notes += [f"{'boxes' if k == 'bbox' else 'masks'} are not scored: there are none" for k in kinds if k not in used]
    table: dict[str, dict[int, Images]] = {kind: {} for kind in used}
    instances = ignored = 0
    for image, mine in grouped.items():
        truths = [t for t in dataset.truths(*image) if t.obj_id in chosen]
        shown = _read_visible(dataset, image, truths)
        truths = [t for t in truths if t.index in shown]
        skipped = np.array([0 <= t.visible < VISIBLE for t in truths], bool)
        instances, ignored = instances + int((~skipped).sum()), ignored + int(skipped.sum())
        whole = {}
        if "bbox" in used:
            whole = {t.index: _read_box(dataset, image, t, shown[t.index], boxes, notes) for t in truths}
        masks: dict[int, np.ndarray] = {}
        if "segm" in used:
            mine, masks = _decode_masks(mine, list(shown.values()), problems if on_error == "skip" else None)
        for obj in sorted({t.obj_id for t in truths} | {one.obj_id for one in mine}):
            here = [(t, s) for t, s in zip(truths, skipped, strict=True) if t.obj_id == obj]
            for kind in used:
                found = [
                    d for d in mine if d.obj_id == obj and (d.box if kind == "bbox" else d.segmentation) is not None
                ]
                found = sorted(found, key=lambda d: -d.score)[:DETECTIONS]
                if kind == "bbox":
                    overlaps = box_overlaps(
                        np.array([d.box for d in found], np.float64).reshape(-1, 4),
                        np.array([whole[t.index] for t, _ in here], np.float64).reshape(-1, 4),
                    )
                else:
                    overlaps = np.zeros((len(found), len(here)))
                    if overlaps.size:
                        given = np.stack([masks[id(d)] for d in found])
                        overlaps = mask_overlaps(given, np.stack([shown[t.index] for t, _ in here]))
                scores = np.array([d.score for d in found], np.float64)
                row = overlaps, scores, np.array([s for _, s in here], bool)
                table[kind].setdefault(obj, []).append(row)
    times = {image: d.time for image, mine in grouped.items() for d in mine}
    return DetectionScore(
        f"{dataset.name}-{dataset.split}",
        method or source,
        {kind: _summarise(by_object) for kind, by_object in table.items()},
        len(grouped),
        instances,
        ignored,
        sum(map(len, grouped.values())),
        float(np.mean(list(times.values()))) if times and min(times.values()) >= 0 else None,
        tuple(dict.fromkeys(notes)),
        tuple(problems),
    )


def format_detections(found: DetectionScore) -> str:
    """The score as a table for people."""
    names = {"bbox": "boxes", "segm": "masks"}
    lines = [
        f"{found.method} on {found.dataset}: {found.detections} detections in {found.images} images; {found.instances} "
        f"instances to be found, {found.ignored} hardly visible",
        "",
        f"{'':8}{'AP':>8}{'AP50':>8}{'AP75':>8}{'AR100':>8}",
    ]
    for kind, part in found.kinds.items():
        cells = (part.ap, part.ap50, part.ap75, part.ar)
        lines.append(f"{names[kind]:8}" + "".join(f"{100 * value:8.1f}" for value in cells))
    lines += ["", f"{'object':8}" + "".join(f"{'AP ' + names[kind]:>10}" for kind in found.kinds)]
    for obj in sorted({obj for part in found.kinds.values() for obj in part.objects}):
        cells = (part.objects.get(obj) for part in found.kinds.values())
        lines.append(f"{obj:<8}" + "".join("         –" if x is None else f"{100 * x:10.1f}" for x in cells))
    if found.seconds_per_image is not None:
        lines.append(f"Time per image: {found.seconds_per_image:.2f} s.")
    lines += [f"Note: {note}." for note in found.notes]
    if found.problems:
        lines.append(f"{len(found.problems)} problems, the first: {found.problems[0]}")
    return "\n".join(lines)


def _read_visible(dataset: Dataset, image: tuple[int, int], truths: list[Truth]) -> dict[int, np.ndarray]:
    """The visible mask of each instance of which anything is visible."""
    masks = {t.index: dataset.mask(*image, t.index) for t in truths}
    return {index: mask for index, mask in masks.items() if mask.any()}


def _read_box(
    dataset: Dataset, image: tuple[int, int], truth: Truth, visible: np.ndarray, boxes: str, notes: list[str]
) -> tuple[int | float, ...]:
    """The box of an instance; of a whole silhouette where there is its mask, or its box in scene_gt_info.json."""
    if boxes == "amodal":
        if dataset.has_silhouettes(image[0]):
            box = box_of(dataset.mask(*image, truth.index, visible=False))
            if box is not None:
                return box
        elif truth.whole is not None and min(truth.whole[2:]) > 0:
            height, width = visible.shape
            x, y, w, h = truth.whole
            left, top = max(x, 0), max(y, 0)
            return left, top, min(x + w, width) - left, min(y + h, height) - top
        notes.append("some boxes are of what is visible: there are no masks or boxes of whole silhouettes")
    box = box_of(visible)
    assert box is not None
    return box


def _decode_masks(
    found: list[Detection], shown: list[np.ndarray], problems: list[str] | None
) -> tuple[list[Detection], dict[int, np.ndarray]]:
    """The detections of one image whose masks are whole, and the masks, by the detections' identity.

    Args:
        shown: annotated masks of the image, which say how large it is.
        problems: gets a sentence for each of the others; None = DatasetError is raised.
    """
    kept, masks = [], {}
    for one in found:
        try:
            mask = one.mask
            if mask is not None and shown and mask.shape != shown[0].shape:
                where = f"the mask of object {one.obj_id} in scene {one.scene_id}, image {one.im_id}"
                size, other = (f"{w} × {h}" for h, w in (mask.shape, shown[0].shape))
                raise DatasetError(f"{where} is {size}, but the image {other}")
        except DatasetError as error:
            if problems is None:
                raise
            problems.append(str(error))
            continue
        kept.append(one)
        if mask is not None:
            masks[id(one)] = mask
    return kept, masks


def _summarise(by_object: dict[int, Images]) -> Precision:
    rows = {obj: overlap_precision(images) for obj, images in sorted(by_object.items())}
    rows = {obj: row for obj, row in rows.items() if row is not None}
    if not rows:
        return Precision(0.0, 0.0, 0.0, 0.0, {})
    precision, recall = (np.stack([row[i] for row in rows.values()]) for i in (0, 1))
    fifty, seventy_five = (int(np.argmin(abs(OVERLAPS - x))) for x in (0.5, 0.75))
    each = {obj: float(values.mean()) for obj, values in zip(rows, precision, strict=True)}
    half, strict = float(precision[:, fifty].mean()), float(precision[:, seventy_five].mean())
    return Precision(float(precision.mean()), half, strict, float(recall.mean()), each)
