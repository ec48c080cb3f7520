"""The poses of all shards as columns, small enough to be in memory together."""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.files.storage.parsing import parse_json
from ipjax.labelling.entries import Entry
from ipjax.labelling.outputs.bop_files import find_pose
from ipjax.labelling.shards.plan import SHARDS, Shard
from ipjax.labelling.shards.working import LEDGER
from ipjax.transforms import Similarity


@dataclasses.dataclass(frozen=True)
class Poses:
    """Every pose that was found, in the order of the frames."""

    place: Int[np.ndarray, " n"]  # of the frame among all frames
    scene: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    number: Int[np.ndarray, " n"]  # of the object
    slot: Int[np.ndarray, " n"]  # of the instance in its frame
    present: Bool[np.ndarray, " n"]
    confidence: Float[np.ndarray, " n"]
    margin: Float[np.ndarray, " n"]
    overlap: Float[np.ndarray, " n"]  # with the given mask; NaN = there was none
    camera_from_object: Similarity[np.ndarray]  # leading axis n; metres from the normalised object

    def __len__(self) -> int:
        return len(self.place)


def read_entries(folder: Path, shard: Shard) -> Iterator[Entry]:
    """The entries of a finished shard, in their order. Raises ValueError or OSError."""
    with open(folder / SHARDS / shard.name / LEDGER, encoding="utf-8") as file:
        for line in file:
            yield parse_json(line)


def gather_poses(entries: Iterable[tuple[int, Entry]], mesh_from_object: dict[int, Similarity[np.ndarray]]) -> Poses:
    """The poses of frames that come with their places.

    Args:
        mesh_from_object: of each object, by its number.
    """
    rows: list[tuple] = []
    poses: list[Any] = []
    for place, entry in entries:
        for one in entry["instances"]:
            if one["success"]:
                overlap = np.nan if one["overlap"] is None else one["overlap"]
                what = entry["scene"], entry["image"], one["number"], one["slot"]
                rows.append((place, *what, one["present"], one["confidence"], one["margin"], overlap))
                poses.append(find_pose(one) @ mesh_from_object[one["number"]])
    columns = list(zip(*rows, strict=True)) if rows else [()] * 9
    kinds = (int, int, int, int, int, bool, float, float, float)
    arrays: list[Any] = [np.array(column, kind) for column, kind in zip(columns, kinds, strict=True)]
    stacked: Any = Similarity(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
    if poses:
        stacked = Similarity.stack(poses)
    return Poses(*arrays, camera_from_object=stacked)
