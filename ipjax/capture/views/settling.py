"""Things that fall onto a table and come to rest there."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import Mesh
from ipjax.synthetic.tables import TABLE
from ipjax.transforms import Similarity

_CHILD = Path(__file__).with_name("settling_child.py")
_CORNERS = 120  # of a hull at most: contacts of more would take long and say the same
_TIMEOUT = 120  # seconds


@dataclasses.dataclass(frozen=True)
class SettlingConfig:
    """Settings of `settle`."""

    spread: float = 0.16  # metres from the middle of the table, within which things are dropped
    deepest: float = 0.0008  # metres that things at rest may be in each other or in the table
    friction: float = 0.7
    density: float = 400.0  # kg / m³, of the hulls
    step: float = 0.002  # seconds
    longest: float = 3.0  # seconds until each thing must rest
    tries: int = 8  # times that everything is dropped anew, if it must be


@dataclasses.dataclass(frozen=True)
class Settled:
    """Where things came to rest."""

    world_from_thing: tuple[Similarity[np.ndarray], ...]  # rigid; the table's top is z = 0, its middle the origin
    deep: float  # metres that the deepest contact is in the other
    tries: int


def settle(meshes: Sequence[Mesh], seed: int = 0, config: SettlingConfig | None = None) -> Settled:
    """Drop things onto the table one after another, turned at random, and wait until all rest.

    Each collides as its convex hull, in which the mesh lies: what does not interpenetrate as hulls does not as meshes.
    What rolls off the table, or does not come to rest, is dropped anew from elsewhere. The same seed gives the same.

    Args:
      meshes: metres.

    Raises:
      CaptureError: the things do not come to rest on the table, or are too large for it.
      ValueError: there is nothing to drop.
    """
    config = config or SettlingConfig()
    if not meshes:
        raise ValueError("there is nothing to drop")
    rng = np.random.default_rng([seed, 53])
    middles = [(mesh.vertices.min(0) + mesh.vertices.max(0)) / 2 for mesh in meshes]
    hulls = [_hull(mesh.vertices - middle) for mesh, middle in zip(meshes, middles, strict=True)]
    largest = max(float(np.linalg.norm(points, axis=1).max()) for points in hulls)
    if not 0.005 < largest < min(TABLE) / 2:
        raise CaptureError(
            f"the largest model reaches {1000 * largest:.3g} mm from its middle, which does not stand on a table of "
            f"{TABLE[0]:g} × {TABLE[1]:g} m; is its unit right?"
        )
    reasons = []
    for attempt in range(config.tries):
        places = rng.uniform(-config.spread, config.spread, (len(meshes), 2))
        turns = rng.normal(size=(len(meshes), 4))
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        order = rng.permutation(len(meshes))
        found = _simulate([hulls[i] for i in order], np.concatenate([places, turns], 1), largest, config)
        poses: list = [None] * len(meshes)
        for index, place, turn in zip(order, found["places"], found["turns"], strict=True):
            rotation = Rotation.from_quat(turn, scalar_first=True).as_matrix()
            poses[index] = Similarity(rotation, place - rotation @ middles[index], np.ones(()))
        reason = _find_fault(found, config)
        if reason is None:
            return Settled(tuple(poses), max(float(found["deep"]), 0.0), attempt + 1)
        reasons.append(reason)
    raise CaptureError(
        f"{len(meshes)} things do not come to rest on the table, in {config.tries} tries ({reasons[-1]}); "
        "take fewer of them"
    )


def _find_fault(found: dict[str, np.ndarray], config: SettlingConfig) -> str | None:
    fallen = (found["places"][:, 2] < 0) | (np.abs(found["places"][:, :2]) > np.array(TABLE) / 2).any(1)
    if fallen.any():
        return f"{int(fallen.sum())} fell off"
    if not found["quiet"]:
        return f"one still moves with {1000 * found['speed'].max():.0f} mm/s"
    if found["deep"] > config.deepest:
        return f"one is {1000 * float(found['deep']):.1f} mm deep in another"
    return None


def _simulate(
    hulls: Sequence[np.ndarray], drop: Float[np.ndarray, "n 6"], largest: float, config: SettlingConfig
) -> dict[str, np.ndarray]:
    parked = [[3 + 3 * largest * i, 0.0, 1.0] for i in range(len(hulls))]
    job = {
        "count": len(hulls),
        "table": list(TABLE),
        "drop": drop.tolist(),
        "parked": parked,
        "step": config.step,
        "longest": config.longest,
        "friction": config.friction,
        "density": config.density,
    }
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    with tempfile.TemporaryDirectory(prefix="ipjax-settle-") as name:
        folder = Path(name)
        for number, points in enumerate(hulls):
            np.save(folder / f"points{number}.npy", points)
        (folder / "job.json").write_text(json.dumps(job))
        command = [sys.executable, "-P", str(_CHILD), str(folder)]
        try:
            ended = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=_TIMEOUT * len(hulls), check=False
            )
        except subprocess.TimeoutExpired:
            raise CaptureError("MuJoCo did not let the things come to rest in time") from None
        if not ended.stdout.startswith("done"):
            lines = (ended.stdout + ended.stderr).strip().splitlines()
            raise CaptureError(f"MuJoCo could not drop the things ({lines[-1][:300] if lines else ended.returncode})")
        with np.load(folder / "settled.npz") as arrays:
            return {key: arrays[key] for key in arrays.files}


def _hull(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Corners of the convex hull, or of one a little larger where it has too many; CaptureError where it is flat."""
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:
        raise CaptureError("a model is flat: it has no inside, and cannot be dropped") from None
    if len(corners) <= _CORNERS:
        return corners
    # Support points in evenly spread directions, pushed out so that all of the hull is inside.
    count = _CORNERS
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.cos(angle), around * np.sin(angle), height], -1)
    chosen = corners[np.unique((corners @ directions.T).argmax(0))]
    hull = ConvexHull(chosen)
    outside = (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max()
    inside = -hull.equations[:, 3].max()  # the nearest face's distance from the middle
    return chosen * (1 + max(outside, 0) / max(inside, 1e-6)) if inside > 0 else corners
