"""Entries as BOP's result rows and as the annotations of its scenes.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md; millimetres.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ipjax.bop.records import MM, Estimate
from ipjax.bop.results import ResultRow, as_row
from ipjax.files.images.run_lengths import decode_counts
from ipjax.labelling.entries import Entry
from ipjax.transforms import Similarity


def find_pose(instance: Entry) -> Similarity[np.ndarray]:
    """``camera_from_mesh`` of an instance that has a pose: metres from the unit of the mesh file."""
    matrix: Any = np.asarray(instance["camera_from_mesh"], np.float64).reshape(4, 4)
    pose: Any = Similarity.from_matrix(matrix)
    return pose


def metres_per_unit(infos: Mapping[int, Any]) -> dict[int, float]:
    """Metres per unit of the mesh file of each object; a millimetre where nobody said so, as BOP has it."""
    return {number: info.metres_per_unit or MM for number, info in infos.items()}


def as_rows(entry: Entry, units: Mapping[int, float]) -> list[tuple[ResultRow, float]]:
    """The result rows of a frame, one for each pose that was found, and the size of each, estimated over true.

    The time is not told: it differs from run to run.

    Args:
        units: metres per unit of the mesh file, by the object's number.
    """
    rows = []
    for one in entry["instances"]:
        if not one["success"]:
            continue
        pose = find_pose(one)
        scale = float(pose.scale) / units[one["number"]]
        estimate = Estimate(one["number"], one["confidence"], pose.rotation, pose.translation, scale)
        rows.append((as_row(entry["scene"], entry["image"], estimate), scale))
    return rows


def labels_of(entry: Entry) -> list[Entry]:
    """The instances of a frame that are labels: those that are to be believed and of which something is seen."""
    return [one for one in entry["instances"] if one["present"] and one["mask"]]


def count_pixels(counts: str) -> int:
    """The pixels of a mask in COCO's run lengths."""
    return sum(decode_counts(counts)[1::2])


def as_annotations(entry: Entry) -> tuple[dict[str, Any], list[dict[str, Any]], list[dict[str, Any]]]:
    """A frame's part of scene_camera, scene_gt and scene_gt_info; of the labels alone."""
    camera = {"cam_K": entry["camera"], "depth_scale": 1.0}
    truths, infos = [], []
    for one in labels_of(entry):
        pose = find_pose(one)
        pixels = count_pixels(one["mask"])
        truths.append(
            {
                "cam_R_m2c": pose.rotation.ravel().tolist(),
                "cam_t_m2c": (pose.translation / MM).tolist(),
                "obj_id": one["number"],
            }
        )
        infos.append(
            {
                "bbox_visib": one["box"],
                "px_count_visib": pixels,
                "px_count_all": max(one["outline_pixels"], pixels),
                "visib_fract": pixels / max(one["outline_pixels"], pixels, 1),
            }
        )
    return camera, truths, infos


def by_scene(entries: Iterable[Entry]) -> dict[int, list[Entry]]:
    """Usable frames by their scene, in their order."""
    found: dict[int, list[Entry]] = {}
    for entry in entries:
        if not entry["error"]:
            found.setdefault(entry["scene"], []).append(entry)
    return found


def as_scene_documents(entries: Iterable[Entry]) -> dict[str, dict[str, Any]]:
    """scene_camera, scene_gt and scene_gt_info of the frames of one scene."""
    documents: dict[str, dict[str, Any]] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
    for entry in entries:
        for name, part in zip(documents, as_annotations(entry), strict=True):
            documents[name][str(entry["image"])] = part
    return documents
