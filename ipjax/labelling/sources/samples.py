"""Frames whose files share a key: BOP's image-wise form, in a folder or in tar files as webdataset has them.

    KEY.rgb.jpg|png or KEY.gray.png   KEY.depth.png   KEY.camera.json   KEY.gt.json   KEY.gt_info.json
    KEY.mask_visib.json               run lengths, by the place of the instance in gt.json

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, image-wise. KEY is SCENE_IMAGE.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from ipjax.bop.dataset import VISIBLE
from ipjax.bop.records import MM
from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.depth import read_depth
from ipjax.files.images.opening import read_rgb
from ipjax.files.images.run_lengths import decode_rle
from ipjax.files.storage.parsing import parse_json
from ipjax.inference.depth import to_metres
from ipjax.labelling.sources.records import FrameKey, SourceError, SourceFrame

COLOURS = tuple(f"{kind}.{ending}" for kind in ("rgb", "gray") for ending in ("jpg", "jpeg", "png"))
MASKS = "mask_visib.json"
PARTS = (*COLOURS, "depth.png", "camera.json", "gt.json", "gt_info.json", MASKS)
_NUMBERS = re.compile(r"(\d+)_(\d+)")


def split_name(name: str) -> tuple[str, str] | None:
    """Key and part of a file's name without its folder; None where it is no part of a frame."""
    key, _, part = name.partition(".")
    return (key, part.lower()) if key and part.lower() in PARTS else None


def number_samples(names: Iterable[str]) -> list[FrameKey]:
    """Keys of frames by their names, SCENE_IMAGE; where some are not of this form, all are of scene 0, by their place.

    Raises SourceError where two frames have one name.
    """
    names = list(names)
    if len(set(names)) != len(names):
        twice = next(name for place, name in enumerate(names) if name in names[:place])
        raise SourceError(f"two frames are called {twice}: names must differ")
    matches = [_NUMBERS.fullmatch(name) for name in names]
    if all(matches):
        numbers = [(int(match[1]), int(match[2])) for match in matches if match is not None]
        if len(set(numbers)) == len(names):
            return [FrameKey(*pair, name) for pair, name in zip(numbers, names, strict=True)]
    return [FrameKey(0, place, name) for place, name in enumerate(names)]


def read_sample(
    where: str, parts: dict[str, str], load: Callable[[str], bytes], numbers: Sequence[int], *, use_masks: bool
) -> SourceFrame:
    """One frame from its parts.

    Args:
        where: of the frame, for messages.
        parts: what ``load`` wants for each part that there is.
        load: the content of a part.
        numbers: of the objects in the data set, in their order.
        use_masks: take the visible masks.

    Raises:
        ValueError: a part is missing or damaged; names it.
    """
    colours = next((name for name in COLOURS if name in parts), None)
    for needed, is_there in (("rgb.png or rgb.jpg", colours), ("depth.png", "depth.png" in parts),
                             ("camera.json", "camera.json" in parts)):  # fmt: skip
        if not is_there:
            raise ValueError(f"{where}: it has no {needed}")
    assert colours is not None
    rgb = read_rgb(f"{where}.{colours}", load(parts[colours]))
    depth = read_depth(f"{where}.depth.png", load(parts["depth.png"]))
    try:
        entry = parse_json(load(parts["camera.json"]))
        if not isinstance(entry, dict):
            raise ValueError("a dictionary is expected")
        # Where the data set does not say, a number of the depth images is a millimetre.
        intrinsics = read_camera({"depth_scale": 1.0} | entry)
    except ValueError as error:
        raise ValueError(f"{where}.camera.json: {error}") from None
    masks = None
    if use_masks and MASKS in parts and "gt.json" in parts:
        masks = _read_masks(where, parts, load, numbers, rgb.shape[:2])
    metres = to_metres(depth, MM if intrinsics.depth_scale is None else intrinsics.depth_scale)
    return SourceFrame(rgb, metres, intrinsics.matrix, masks, parts[colours])


def _read_masks(
    where: str, parts: dict[str, str], load: Callable[[str], bytes], numbers: Sequence[int], size: tuple[int, ...]
) -> tuple[tuple[int, np.ndarray], ...]:
    documents: dict[str, Any] = {}
    for name in ("gt.json", MASKS, *(["gt_info.json"] if "gt_info.json" in parts else [])):
        try:
            documents[name] = parse_json(load(parts[name]))
        except ValueError as error:
            raise ValueError(f"{where}.{name}: {error}") from None
    truths, runs, about = documents["gt.json"], documents[MASKS], documents.get("gt_info.json")
    found = []
    try:
        for place, truth in enumerate(truths):
            number = int(truth["obj_id"])
            share = float(about[place].get("visib_fract", 1)) if about is not None else 1.0
            if number not in numbers or share < VISIBLE:
                continue
            mask = decode_rle(runs[str(place)])
            if mask.shape != size:
                raise ValueError(f"a mask is {mask.shape[1]} × {mask.shape[0]} pixels")
            found.append((list(numbers).index(number), mask))
    except (KeyError, TypeError, IndexError, AttributeError):
        raise ValueError(f"{where}: gt.json and {MASKS} must have an entry for each instance") from None
    except (ValueError, OverflowError) as error:  # an infinite number is no integer
        raise ValueError(f"{where}, gt.json or {MASKS}: {error}") from None
    return tuple(found)
