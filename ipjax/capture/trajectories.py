"""Trajectories as files: ``poses.json``, which every step that knows or betters the camera's poses writes.

::

    {"format": "ipjax trajectory", "version": 1, "source": "structure from motion",
     "scale": 0.213, "agreement": 0.98,           metres per unit, share of the depth's votes that agree; or null
     "names": ["000000", …], "registered": [true, …],
     "world_from_camera": [4 × 4, …],             metres, OpenCV's camera axes; null where not registered
     "covariance": null}                          or 6 × 6 of each: rotation (rad), translation (m), the camera's axes
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.records import CaptureError, Trajectory
from ipjax.files.rigid import to_rigid
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text

FORMAT, VERSION = "ipjax trajectory", 1


def write_trajectory(path: str | Path, trajectory: Trajectory) -> Path:
    """Write a trajectory, whole or not at all; returns its path.

    Raises:
      ValueError: a number is not finite.
      OSError: the file cannot be written.
    """
    matrices = trajectory.world_from_camera.to_matrix().tolist()
    registered = [bool(known) for known in trajectory.registered]
    covariance = None if trajectory.covariance is None else trajectory.covariance.tolist()
    document = {
        "format": FORMAT,
        "version": VERSION,
        "source": trajectory.source,
        "scale": trajectory.scale,
        "agreement": trajectory.agreement,
        "names": list(trajectory.names),
        "registered": registered,
        "world_from_camera": [m if known else None for m, known in zip(matrices, registered, strict=True)],
        "covariance": covariance,
    }
    return write_text(path, json.dumps(document, allow_nan=False) + "\n")


def read_trajectory(path: str | Path) -> Trajectory:
    """The trajectory that `write_trajectory` wrote.

    Raises:
      CaptureError: it is missing, damaged, or another file; one sentence that names it.
    """
    try:
        document = read_json(path, "file of poses")
    except ValueError as error:
        raise CaptureError(str(error)) from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise CaptureError(f"{path}: it is no trajectory of ipjax; make one with ipjax capture pose")
    if document.get("version") != VERSION:
        raise CaptureError(f"{path}: version {document.get('version')} of the format is not known here, only {VERSION}")
    try:
        return _parse(document)
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(f"{path}: it is damaged ({error}); make it again with ipjax capture pose") from None


def _parse(document: dict[str, Any]) -> Trajectory:
    names = tuple(map(str, document["names"]))
    registered = np.asarray(document["registered"], bool)
    given = document["world_from_camera"]
    if not len(names) == len(registered) == len(given):
        raise ValueError(f"{len(names)} names, {len(registered)} flags and {len(given)} poses do not belong together")
    if any(known and matrix is None for matrix, known in zip(given, registered, strict=True)):
        raise ValueError("a frame that is registered has no pose")
    # The matrix of a pose that is not known is the identity: Trajectory says so.
    matrices = np.asarray([np.eye(4) if m is None else m for m in given], np.float64).reshape(-1, 4, 4)
    covariance = document.get("covariance")
    if covariance is not None:
        covariance = np.asarray(covariance, np.float64).reshape(len(names), 6, 6)
    numbers = {name: None if document.get(name) is None else float(document[name]) for name in ("scale", "agreement")}
    return Trajectory(names, to_rigid(matrices), registered, str(document["source"]), covariance, **numbers)
