"""What is kept of a labelled frame: plain JSON, from which everything that is written is made."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ipjax.labelling.records import Batch
from ipjax.labelling.sources.records import FrameKey, SourceFrame

Entry = dict[str, Any]


def describe_frame(frame: FrameKey) -> Entry:
    """What is known of a frame before it is read."""
    return {"name": frame.name, "scene": frame.scene, "image": frame.image}


def failed_entry(frame: FrameKey, reason: str) -> Entry:
    """Of a frame that cannot be used."""
    return describe_frame(frame) | {"error": reason, "instances": []}


def as_batch(keys: Sequence[FrameKey], frames: Sequence[SourceFrame]) -> Batch:
    """Frames as columns; either all have masks, or none has."""
    batch: Batch = {
        "id": [key.name for key in keys],
        "rgb": [frame.rgb for frame in frames],
        "depth": [frame.depth for frame in frames],
        "camera": [frame.camera for frame in frames],
    }
    if frames and frames[0].masks is not None:
        batch["mask"] = [[mask for _, mask in frame.masks or ()] for frame in frames]
        batch["object"] = [[obj for obj, _ in frame.masks or ()] for frame in frames]
    return batch


def as_entries(
    keys: Sequence[FrameKey], frames: Sequence[SourceFrame], made: Batch, numbers: Sequence[int]
) -> list[Entry]:
    """The entries of a labelled batch; ``numbers`` are those of the objects in what is written."""
    entries = []
    for row, (key, frame) in enumerate(zip(keys, frames, strict=True)):
        if made["error"][row]:
            entries.append(failed_entry(key, made["error"][row]))
            continue
        slots = np.flatnonzero(made["object"][row] >= 0).tolist()
        entries.append(
            describe_frame(key)
            | {
                "error": "",
                "file": frame.file,
                "size": made["size"][row].tolist(),
                "camera": np.asarray(frame.camera, np.float64).ravel().tolist(),
                "instances": [_describe(made, row, slot, numbers) for slot in slots],
            }
        )
    return entries


def _describe(made: Batch, row: int, slot: int, numbers: Sequence[int]) -> Entry:
    at = row, slot
    overlap = float(made["overlap"][at])
    entry: Entry = {
        "number": numbers[int(made["object"][at])],
        "slot": slot,
        "success": bool(made["success"][at]),
        "present": bool(made["present"][at]),
        "confidence": float(made["confidence"][at]),
        "note": str(made["note"][at]),
    }
    if not entry["success"]:
        return entry
    return entry | {
        "camera_from_mesh": made["camera_from_mesh"][at].ravel().tolist(),
        "diameter": float(made["diameter"][at]),
        "diameter_std": float(made["diameter_std"][at]),
        "margin": float(made["margin"][at]),
        "covariance": made["covariance"][at].ravel().tolist(),
        "mask": str(made["mask"][at]),
        "outline_pixels": int(made["outline_pixels"][at]),
        "box": made["box"][at].tolist(),
        "overlap": overlap if np.isfinite(overlap) else None,
    }
