"""Estimates as ``ipjax estimate -o`` writes them, read back for planning: the pose and how sure it is."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.parsing import read_json
from ipjax.records import Agreement, Hypotheses, PoseEstimate, Templates
from ipjax.transforms import Similarity

_ALTERNATIVES = 4  # as many as the file has of each estimate; fewer are filled up, so that one program serves all


def read_estimate(
    path: str | Path,
    templates: Templates,
    info: ObjectInfo,
    *,
    frame: str | None = None,
    instance: int | None = None,
) -> PoseEstimate:
    """The estimate of one object from a file of poses. What planning does not need is zero: views and agreement.

    Args:
        path: JSON of ``ipjax estimate``.
        templates, info: of the object.
        frame: its name in the file, where there are several.
        instance: which of several estimates of the object in that frame, from 0.

    Raises:
        ValueError: unreadable, no such file, frame or object, or no pose was found; names the file.
    """
    document = read_json(path, "file of poses")
    try:
        entry = _find(document, info.name, frame, instance)
        try:
            return _build(entry, templates, info)
        except (KeyError, TypeError, IndexError, AttributeError):
            raise ValueError(f"the estimate of {info.name} lacks something: 'ipjax estimate' writes it whole") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _find(document: Any, name: str, frame: str | None, instance: int | None) -> dict[str, Any]:
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not all(isinstance(one, dict) for one in frames) or not frames:
        raise ValueError("not a file of poses: 'ipjax estimate -o' writes them")
    if frame is not None:
        frames = [one for one in frames if one.get("frame") == frame]
        if not frames:
            raise ValueError(f"there is no frame {frame!r}")
    if len(frames) > 1:
        named = f", for instance {frames[0]['frame']}" if "frame" in frames[0] else ""
        raise ValueError(f"there are {len(frames)} frames: say which with --frame{named}")
    objects = frames[0].get("objects")
    objects = [one for one in objects if isinstance(one, dict)] if isinstance(objects, list) else []
    found = [one for one in objects if one.get("object") == name]
    if not found:
        there = ", ".join(sorted({str(one.get("object")) for one in objects})) or "no object"
        raise ValueError(f"it has {there}, not {name}")
    if instance is None and len(found) > 1:
        raise ValueError(f"there are {len(found)} of {name}: say which with --instance, from 0")
    if instance is not None and not 0 <= instance < len(found):
        raise ValueError(f"there is no instance {instance} of {name}, but {len(found)} of them, from 0")
    entry = found[instance or 0]
    if not entry.get("success") or entry.get("camera_from_object") is None:
        raise ValueError(f"no pose of {name} was found, so there is nothing to grasp")
    return entry


def _build(entry: dict[str, Any], templates: Templates, info: ObjectInfo) -> PoseEstimate:
    pose = _read_pose(entry["camera_from_object"])
    mesh_from_object = info.object_from_mesh.to_numpy().inverse()
    others = [_read_pose(one["camera_from_mesh"]) @ mesh_from_object for one in entry.get("alternatives", [])]
    others = [pose, *others][: _ALTERNATIVES + 1]
    scores = [float(one["score"]) for one in entry.get("alternatives", [])][:_ALTERNATIVES]
    # Files of before have no score of the answer: then an alternative counts as if it were as good.
    scores = [float(entry.get("score", max([*scores, 1e-9]))), *scores]
    missing = _ALTERNATIVES + 1 - len(others)
    others, scores = others + [pose] * missing, scores + [-1.0] * missing
    size = entry["size_mm"]
    if "box_of_object" in entry:
        box = np.array([entry["box_of_object"]["low"], entry["box_of_object"]["high"]], np.float64)
    else:
        box = np.stack([-np.asarray(templates.extents) / 2, np.asarray(templates.extents) / 2])
    covariance = np.asarray(entry["covariance"], np.float64)
    turn = np.asarray(entry["ambiguity"]["axis_of_object"], np.float64)
    turn = turn * np.radians(float(entry["ambiguity"]["std_deg"]))
    if covariance.shape != (6, 6) or turn.shape != (3,) or box.shape != (2, 3):
        raise KeyError
    array = lambda x: jnp.asarray(np.asarray(x, np.float64), jnp.float32)
    diameter, deviation = float(size["diameter"]), float(size["diameter_std"])
    numbers = [pose.rotation, pose.translation, pose.scale, covariance, turn, box, scores, diameter, deviation]
    if not all(np.isfinite(x).all() for x in numbers):
        raise ValueError("the estimate is not finite")
    if pose.translation[2] <= 0:
        raise ValueError(f"{info.name} is behind the camera there, at z = {pose.translation[2]:.3g} m")
    if diameter <= 0 or deviation < 0:
        raise ValueError(f"a diameter of {diameter:g} mm ± {deviation:g} mm is none")
    zero = jnp.zeros((), jnp.float32)
    return PoseEstimate(
        camera_from_object=pose.to_jax(),
        confidence=array(entry["confidence"]),
        present=jnp.asarray(bool(entry["present"])),
        covariance=array(covariance),
        diameter=array(1e-3 * diameter),
        box=array(box),
        scale_std=array(1e-3 * deviation),
        ambiguity=array(turn),
        agreement=Agreement(zero, zero, zero, zero, zero, zero),
        hypotheses=Hypotheses(Similarity[np.ndarray].stack(others).to_jax(), array(scores)),
        view=jnp.zeros((), jnp.int32),
        view_score=jnp.zeros(1, jnp.float32),
        inliers=jnp.zeros((), jnp.int32),
        rmse=zero,
        success=jnp.asarray(True),
    )


def _read_pose(entry: dict[str, Any]) -> Similarity[np.ndarray]:
    """A pose that reports wrote, by its matrix. Raises ValueError where that is no similarity."""
    matrix = np.asarray(entry["matrix"], np.float64)
    return Similarity[np.ndarray].from_matrix(matrix).orthonormal()
