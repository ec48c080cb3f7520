"""Two participants on two data sets, with errors that were put there."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from builders.bop_roots import true_rows, write_images

from ipjax.bop.dataset import Dataset
from ipjax.bop.results import write_results
from ipjax.bop.scoring.benchmark.participants import Benchmark, compare


@dataclass
class Compared:
    """What was scored, and what came of it."""

    groups: list[tuple[Dataset, list[Path]]]
    found: Benchmark


def turned(row, degrees, axis, shift):
    """The row, with the object turned about an axis of its own and moved by millimetres."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = np.radians(degrees)
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    rotation = np.reshape(row.rotation, (3, 3)) @ turn
    moved = np.add(row.translation, shift)
    return replace(row, rotation=tuple(rotation.ravel().tolist()), translation=tuple(moved.tolist()))


@pytest.fixture(scope="session")
def compared(tmp_path_factory) -> Compared:
    folder, groups = tmp_path_factory.mktemp("benchmark"), []
    for number, name in enumerate(("real", "made")):
        dataset = Dataset(write_images(folder / name, images=3))
        rows, random, files = true_rows(dataset), np.random.default_rng(number), []
        for method, size in (("sure", 4.0), ("rough", 20.0)):
            mine = [turned(r, size / 2, random.normal(size=3), size * random.normal(size=3)) for r in rows]
            mine = [replace(r, time=0.1 * (1 + r.im_id) * size) for r in mine]
            if method == "rough":
                mine = [turned(mine[0], 170, (0, 0, 1), (0, 0, 90)), *mine[1:-1]]  # one lost, one far off
            files.append(write_results(folder / name / f"{method}_{name}-test.csv", mine))
        groups.append((dataset, files))
    return Compared(groups, compare(groups, ("mssd",), titles=["real", "synthetic"], samples=0))
