"""Other people's masks: whatever a segmenter or a detector has written, as candidates of one image."""

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from ipjax.files.images.annotations import Annotation, Size, as_stack, decode_segmentation, read_annotations
from ipjax.files.images.arrays import load_npy
from ipjax.files.images.masks import as_mask, read_values
from ipjax.files.images.opening import BYTES_PER_PIXEL
from ipjax.files.storage.budget import check_budget

log = logging.getLogger("ipjax")

DETECTIONS = (".json", ".npz")
_MOST_LABELS = 1000  # of one image; a photo has more colours
_MOST_EDGES = 0.25  # share of neighbouring pixels that differ: in a photo nearly all do


@dataclass(frozen=True)
class Candidate:
    """A mask that may be the object's."""

    mask: Bool[np.ndarray, "h w"] = field(repr=False)
    score: float | None  # of whoever made it; None where the file has none
    category: int | None  # of the object, in the file's numbers; None where the file has no classes
    index: int  # its number in the file, from 0
    source: str  # the file, and which of its entries, labels or colours


def read_candidates(
    path: str | Path,
    *,
    size: Size | None = None,
    image: int | None = None,
    scene: int | None = None,
) -> list[Candidate]:
    """The masks of one image that a file holds, in its order.

    | file | candidates |
    |---|---|
    | image of 0/1, 0/255, soft edges, a palette, transparency (RGBA) | one, as `read_mask` |
    | image of labels: 8 or 16 bits, a palette, flat colours | one for each label but 0, or each colour but black |
    | npy | the same two; or a stack n × height × width, as SAM returns it: n |
    | npz, JSON | one for each detection, `ipjax.files.images.annotations` says of which kinds |

    Args:
        size: height and width of the image; masks of another are refused, and polygons need it.
        image, scene: which image, where the file holds the detections of several.

    Raises:
        ValueError: missing, unreadable, a photo, pickled, of another size, no masks at all, or several images and none
            chosen; names the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in DETECTIONS:
        found = _decode(choose_image(read_annotations(path), path, image, scene), path, size)
    elif suffix == ".npy":
        array = load_npy(path)
        found = _split_stack(array, path) if _is_stack(array, size) else _split_labels(array, path)
    else:
        found = _split_labels(read_values(path), path)
    if size is not None:
        for one in found:
            height, width = one.mask.shape
            if (height, width) != tuple(size):
                raise ValueError(f"{one.source}: rgb is {size[1]} × {size[0]} but the mask is {width} × {height}")
    return found


def choose_image(
    annotations: list[Annotation], path: Path, image: int | None = None, scene: int | None = None
) -> list[tuple[int, Annotation]]:
    """The annotations of one image, each with its number in the file.

    An image that only one scene has is found without its scene. What does not say of which image it is, is of any. Of
    a file of one image that is the one, and a note says where its number is another: segmenters number as they like.

    Raises:
        ValueError: there are several images and none was chosen, or none of the one that was.
    """
    keys = {(one.scene_id, one.image_id) for one in annotations}
    if len(keys) > 1:
        keys = {key for key in keys if image is None or key[1] in (None, image)}
        if len({key[0] for key in keys}) > 1 and scene is not None:
            keys = {key for key in keys if key[0] in (None, scene)}
        if not keys:
            raise ValueError(f"{path}: it has no detections of image {image}")
        if len(keys) > 1:
            what = f"image {image} in {len(keys)} scenes" if image is not None else f"{len(keys)} images"
            raise ValueError(f"{path}: it has detections of {what}: say which is this one (--image, --scene)")
    other = next((key[1] for key in keys), None)
    if image is not None and other not in (None, image):
        log.info("%s: its detections are of image %s, and are taken for those of image %s", path, other, image)
    return [(i, one) for i, one in enumerate(annotations) if (one.scene_id, one.image_id) in keys]


def _decode(annotations: list[tuple[int, Annotation]], path: Path, size: Size | None) -> list[Candidate]:
    masked = [(number, one) for number, one in annotations if one.segmentation is not None]
    if not masked:
        missing = "it has no detections" if not annotations else "its detections have boxes, but no masks"
        raise ValueError(f"{path}: {missing}")
    needed, found = 0, []
    for number, one in masked:
        mask = one.decode(size)
        assert mask is not None
        needed += mask.size
        check_budget(needed, f"{path}: masks of {len(masked)} detections")
        found.append(Candidate(mask, one.score, one.category_id, number, one.where))
    return found


def _is_stack(array: np.ndarray, size: Size | None) -> bool:
    """Whether an array is n × height × width, and not an image with channels."""
    if array.ndim == 4:
        return True
    if array.ndim != 3:
        return False
    if size is not None and array.shape[-2:] == tuple(size):
        return True
    return array.shape[-1] not in (1, 3, 4)


def _split_stack(array: np.ndarray, path: Path) -> list[Candidate]:
    stack = as_stack(array, path)
    if not len(stack):
        raise ValueError(f"{path}: it has no masks")
    found = []
    for number, values in enumerate(stack):
        where = f"{path}, mask {number}"
        try:
            found.append(Candidate(decode_segmentation(values), None, None, number, where))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    return found


def _split_labels(values: np.ndarray, path: Path) -> list[Candidate]:
    """The mask of an image of two values, or one for each label."""
    try:
        return [Candidate(as_mask(values), None, None, 0, str(path))]
    except ValueError as error:
        labels = _as_labels(values)
        if labels is None:
            raise ValueError(f"{path}: {error}") from None
    kinds = [int(kind) for kind in np.unique(labels) if kind != 0]
    check_budget(len(kinds) * labels.size + BYTES_PER_PIXEL * labels.size, f"{path}: masks of {len(kinds)} labels")
    word = "label" if values.ndim == 2 else "colour"
    names = kinds if values.ndim == 2 else [f"#{kind:06x}" for kind in kinds]
    return [
        Candidate(labels == kind, None, None, number, f"{path}, {word} {name}")
        for number, (kind, name) in enumerate(zip(kinds, names, strict=True))
    ]


def _as_labels(values: np.ndarray) -> np.ndarray | None:
    """Whole numbers of which each is an object, 0 none; None where it is no such image: a photo, or no background."""
    if values.ndim == 3 and values.shape[-1] in (1, 3, 4) and values.dtype == np.uint8:
        values = values[..., :3].astype(np.int64)
        values = values @ np.array([65536, 256, 1]) if values.shape[-1] == 3 else values[..., 0]
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "ui":
        return None
    edges = np.concatenate([np.diff(values, axis=0).ravel() != 0, np.diff(values, axis=1).ravel() != 0])
    kinds = np.unique(values)
    if len(kinds) > _MOST_LABELS or kinds[0] != 0 or edges.mean() > _MOST_EDGES:
        return None
    return values
