"""What detectors and segmenters write: BOP's and COCO's JSON, CNOS's and SAM-6D's npz, SAM's own list of masks.

An annotation is read without its mask, which is decoded when it is asked for:
a file may hold those of a whole data set.

* BOP, CNOS, SAM-6D: a list of scene_id, image_id, category_id, score, bbox, segmentation, time
  (https://bop.felk.cvut.cz/challenges/bop-challenge-2022/, 5.1).
* CNOS, SAM-6D as npz: the same names, an array each; masks n × h × w
  (https://github.com/nv-nguyen/cnos, src/model/utils.py).
* COCO: results, or a data set with images and annotations (https://cocodataset.org/#format-data).
* SAM: a list of segmentation, predicted_iou, stability_score
  (https://github.com/facebookresearch/segment-anything, automatic_mask_generator.py).
* Grounded-SAM: annotations with segmentation and score, img_width, img_height
  (https://github.com/IDEA-Research/Grounded-SAM-2).
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.images.arrays import as_native, load_npz
from ipjax.files.images.masks import as_mask
from ipjax.files.images.polygons import fill_polygons
from ipjax.files.images.run_lengths import decode_rle
from ipjax.files.storage.budget import check_budget
from ipjax.files.storage.parsing import read_json

Box = tuple[float, float, float, float]  # x, y, width, height; pixels
Size = tuple[int, int]  # height, width
_MASKS = ("segmentation", "segmentations", "masks", "mask")
_SCORES = ("score", "scores", "predicted_iou", "iou_predictions")
_CATEGORIES = ("category_id", "category_ids")
_BYTES_PER_ENTRY = 1024  # of an annotation and its columns, without its mask
_NPZ = (*_MASKS, *_SCORES, *_CATEGORIES, "scene_id", "image_id", "im_id", "bbox", "time")


@dataclass(frozen=True)
class Annotation:
    """One detection as its file has it; what the file does not say is None."""

    scene_id: int | None
    image_id: int | None
    category_id: int | None
    score: float | None
    box: Box | None
    time: float  # seconds for the whole image; −1 = unknown
    segmentation: Any = field(repr=False)  # run lengths, polygons, or an array; None = there is only a box
    size: Size | None  # of the mask, where the file says it beside the mask
    where: str  # the file and the entry, for messages

    def decode(self, size: Size | None = None) -> np.ndarray | None:
        """The mask as bool [h, w]; None where there is only a box.

        Args:
            size: of the image, for polygons, which do not know it.

        Raises:
            ValueError: damaged, or of another size; names the file and the entry.
        """
        if self.segmentation is None:
            return None
        try:
            mask = decode_segmentation(self.segmentation, self.size or size)
        except ValueError as error:
            raise ValueError(f"{self.where}: {error}") from None
        if size is not None and mask.shape != tuple(size):
            raise ValueError(
                f"{self.where}: its mask is {mask.shape[1]} × {mask.shape[0]}, but the image {size[1]} × {size[0]}"
            )
        return mask


def decode_segmentation(segmentation: Any, size: Size | None = None) -> np.ndarray:
    """A mask as bool [h, w], from whatever form its file has.

    Args:
        segmentation: COCO's run lengths (compressed or not), polygons, rows of 0 and 1, or an array.
        size: of the mask, for polygons.

    Raises:
        ValueError: none of these, or damaged.
    """
    if isinstance(segmentation, dict):
        return decode_rle(segmentation)
    if isinstance(segmentation, np.ndarray):
        values = as_native(segmentation)
        # What a segmenter gives before its threshold is below 0 outside the object.
        is_raw = values.dtype.kind == "f" and bool((values < 0).any())
        return as_mask(values > 0 if is_raw else values)
    if not isinstance(segmentation, list) or not segmentation:
        raise ValueError("a segmentation must be run lengths (size, counts), polygons, or rows of 0 and 1")
    rows = segmentation if isinstance(segmentation[0], list) else [segmentation]
    if _is_matrix(rows):
        return np.asarray(rows, bool)
    if size is None:
        raise ValueError("polygons do not say how large the image is, and nothing else does")
    return fill_polygons(rows, size)


def _is_matrix(rows: list[Any]) -> bool:
    """Whether rows are those of a mask, in 0 and 1, and not the corners of polygons."""
    width = len(rows[0])
    return len(rows) > 1 and all(
        isinstance(row, list) and len(row) == width and all(value in (0, 1) for value in row) for row in rows
    )


def read_annotations(path: str | Path, *, problems: list[str] | None = None) -> list[Annotation]:
    """The detections of a JSON or npz file, in its order; the module says of which kinds.

    Args:
        problems: gets a sentence for each entry that is damaged, which is then left out.

    Raises:
        ValueError: missing, unreadable, of none of these kinds, or with entries that are damaged; names file and entry.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        return _read_npz(path)
    content = read_json(path, "file of detections")
    images: dict[int, Size] = {}
    whole: Size | None = None
    if isinstance(content, dict):
        if isinstance(content.get("annotations"), list):
            whole = _read_size(content, "img_height", "img_width")
            for entry in content["images"] if isinstance(content.get("images"), list) else ():
                if isinstance(entry, dict) and isinstance(entry.get("id"), int):
                    size = _read_size(entry, "height", "width")
                    images |= {} if size is None else {entry["id"]: size}
            corners = content.get("box_format") == "xyxy"
            content = content["annotations"]
        elif "segmentation" in content or "counts" in content:
            content = [content if "segmentation" in content else {"segmentation": content}]
            corners = False
        else:
            raise ValueError(f"{path}: neither detections (a list) nor a data set of COCO's (annotations)")
    else:
        corners = False
    if not isinstance(content, list):
        raise ValueError(f"{path}: a list of detections is expected")
    found = []
    for number, entry in enumerate(content):
        where = f"{path}, entry {number}"
        try:
            found.append(_read_entry(entry, where, images, whole, corners))
        except ValueError as error:
            if problems is None:
                raise ValueError(f"{where}: {error}") from None
            problems.append(f"{where}: {error}")
    return found


def _read_entry(entry: Any, where: str, images: dict[int, Size], whole: Size | None, corners: bool) -> Annotation:
    if isinstance(entry, dict) and set(entry) >= {"size", "counts"}:
        entry = {"segmentation": entry}  # a mask alone
    if not isinstance(entry, dict):
        raise ValueError("a detection must be a dictionary")
    image_id, time = _read_integer(entry, "image_id"), _read_number(entry, "time")
    return Annotation(
        _read_integer(entry, "scene_id"),
        image_id,
        _read_integer(entry, "category_id"),
        next((score for name in _SCORES if (score := _read_number(entry, name)) is not None), None),
        _read_box(entry.get("bbox"), corners),
        -1.0 if time is None else time,
        entry.get("segmentation") or None,  # BOP's toolkit writes {} where there is none
        _read_size(entry, "height", "width") or images.get(-1 if image_id is None else image_id) or whole,
        where,
    )


def _read_npz(path: Path) -> list[Annotation]:
    arrays = load_npz(path, _NPZ)
    masks = next((arrays[name] for name in _MASKS if name in arrays), None)
    if masks is None:
        raise ValueError(f"{path}: it has no masks (an array of the name {', '.join(_MASKS)})")
    masks = as_stack(masks, path)
    count = len(masks)

    def read_column(names: tuple[str, ...]) -> list[Any]:
        for name in names:
            if name in arrays:
                values = np.asarray(arrays[name])
                if values.dtype.kind not in "iuf":
                    raise ValueError(f"{path}: {name} must be numbers, not {values.dtype}")
                values = values.reshape(-1)
                if values.size == 1 and count != 1:
                    values = np.repeat(values, count)  # of the image
                if values.size != count:
                    raise ValueError(f"{path}: {count} masks, but {values.size} of {name}")
                return values.tolist()
        return [None] * count

    columns = {
        "scene_id": read_column(("scene_id",)),
        "image_id": read_column(("image_id", "im_id")),
        "category_id": read_column(_CATEGORIES),
        "score": read_column(_SCORES),
        "time": read_column(("time",)),
    }
    boxes = arrays.get("bbox")
    if boxes is not None and boxes.shape != (count, 4):
        raise ValueError(f"{path}: bbox must be {count} × 4, not {' × '.join(map(str, boxes.shape))}")
    found = []
    for number, mask in enumerate(masks):
        where = f"{path}, entry {number}"
        entry = {name: values[number] for name, values in columns.items()}
        try:
            scene, image, category = (_read_integer(entry, n) for n in ("scene_id", "image_id", "category_id"))
            time = _read_number(entry, "time")
            box = None if boxes is None else _read_box(boxes[number].tolist(), False)
            score = _read_number(entry, "score")
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        found.append(Annotation(scene, image, category, score, box, -1.0 if time is None else time, mask, None, where))
    return found


def as_stack(masks: np.ndarray, path: Path) -> np.ndarray:
    """Masks as an array [n, h, w]: one mask, a stack, or a stack with an axis of one channel. Raises ValueError."""
    if masks.ndim == 4 and masks.shape[1] == 1:
        masks = masks[:, 0]
    elif masks.ndim == 2:
        masks = masks[None]
    if masks.ndim != 3 or masks.dtype.kind not in "buif" or (len(masks) and not masks.size):
        shape = " × ".join(map(str, masks.shape)) or "a number"
        raise ValueError(f"{path}: masks must be numbers, n × height × width, not {masks.dtype}, {shape}")
    # Masks of a pixel or two take next to nothing, but what is kept of each does not.
    check_budget(_BYTES_PER_ENTRY * len(masks), f"{path}: {len(masks):,} masks")
    return masks


def _read_integer(entry: dict, name: str) -> int | None:
    value = entry.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or value % 1:
        raise ValueError(f"{name} must be a whole number, not {value!r}")
    return int(value)


def _read_number(entry: dict, name: str) -> float | None:
    value = entry.get(name)
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} must be a number, not {value!r:.60}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"the {name} is not a finite number")
    return number


def _read_box(value: Any, corners: bool) -> Box | None:
    """x, y, width, height; [] is none, as BOP's toolkit writes it."""
    if value is None or value == []:
        return None
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError(f"bbox must be x, y, width, height, not {value!r:.60}")
    numbers = [_read_number({"bbox": number}, "bbox") for number in value]
    x, y, width, height = (math.nan if number is None else number for number in numbers)
    if corners:
        width, height = width - x, height - y
    if None in numbers or width < 0 or height < 0:
        raise ValueError(f"bbox must be x, y, width, height, none of the last two negative, not {value!r:.60}")
    return x, y, width, height


def _read_size(entry: dict, height: str, width: str) -> Size | None:
    rows, columns = entry.get(height), entry.get(width)
    if isinstance(rows, bool) or isinstance(columns, bool) or not isinstance(rows, int) or not isinstance(columns, int):
        return None
    return (rows, columns) if rows > 0 and columns > 0 else None
