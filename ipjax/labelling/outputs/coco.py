"""Labels as a COCO data set with run-length masks, written as it comes: all of a data set would not fit into memory.

https://cocodataset.org/#format-data
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ipjax.files.storage.writing import writing
from ipjax.labelling.entries import Entry
from ipjax.labelling.outputs.bop_files import count_pixels, labels_of

SLOTS = 1000  # annotations of image n are numbered from this · n


def write_coco(path: Path, names: Mapping[int, str], entries: Callable[[], Iterable[tuple[int, Entry]]]) -> Path:
    """Write labels with their masks, boxes and confidence (``score``); whole or not at all.

    Args:
        names: of the objects, by number.
        entries: called twice, for the images and for the annotations: frames with their numbers, from 1 on.

    Raises:
        OSError: it cannot be written.
    """
    with writing(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as file:
        file.write('{\n"info": {"description": "labels made by ipjax"},\n"licenses": [],\n"categories": ')
        file.write(json.dumps([{"id": n, "name": name, "supercategory": "object"} for n, name in names.items()]))
        file.write(',\n"images": [')
        _write_list(file, _images(entries()))
        file.write('],\n"annotations": [')
        _write_list(file, _annotations(entries()))
        file.write("]\n}\n")
    return path


def _write_list(file: Any, items: Iterable[dict[str, Any]]) -> None:
    for place, item in enumerate(items):
        file.write(("," if place else "") + "\n" + json.dumps(item))


def _images(entries: Iterable[tuple[int, Entry]]) -> Iterator[dict[str, Any]]:
    for number, entry in entries:
        if not entry["error"]:
            height, width = entry["size"]
            yield {"id": number, "file_name": entry["file"], "height": height, "width": width}


def _annotations(entries: Iterable[tuple[int, Entry]]) -> Iterator[dict[str, Any]]:
    for number, entry in entries:
        for one in labels_of(entry):
            yield {
                "id": SLOTS * number + one["slot"],
                "image_id": number,
                "category_id": one["number"],
                "iscrowd": 0,
                "ignore": False,
                "score": one["confidence"],
                "area": count_pixels(one["mask"]),
                "bbox": one["box"],
                "segmentation": {"size": entry["size"], "counts": one["mask"]},
            }
