"""Estimates as JSON: every frame and unit named, and poses in the coordinates of the user's own mesh."""

import dataclasses
import json
from typing import Any

import numpy as np

from ipjax.files.objects.record import ObjectInfo
from ipjax.records import PoseEstimate, Similarity, Templates

CONVENTIONS = {
    "camera": "OpenCV axes of the colour camera: x right, y down, z ahead; metres; pixel centres are integers",
    "mesh": "coordinates as they stand in the mesh file, in the file's own unit",
    "mesh_of_a_photo": "of an object made from a photo: the reconstruction, as 'onboard --save-mesh' writes it",
    "reference_camera": "camera of the photo that the object was made from, OpenCV axes; metres where that photo had "
    "depth (reference_unit is 'm'), else the reconstruction's own unit (reference_unit is null)",
    "camera_from_reference_camera": "pose relative to the reference photo: maps coordinates of the reference camera to "
    "metres of this frame's camera; rigid_motion (where reference_unit is 'm') is the same at scale 1, exact at the "
    "object's centre",
    "object": "normalised object: bounding box centred at the origin, diameter 1 (model units)",
    "similarity": "x_camera = scale * rotation @ x + translation; rotation row by row",
    "matrix": "4 x 4, row by row, [scale * rotation, translation; 0 0 0 1]: x_camera = matrix @ (x, 1)",
    "rigid_matrix": "4 x 4, row by row, [rotation, translation; 0 0 0 1]: x_camera = rigid_matrix @ (scale * x, 1)",
    "present": "false: the object is not here, or not seen well enough, and the pose is a guess; by confidence",
    "confidence": "probability that the pose is right: surface points on average within a tenth of the diameter, "
    "or, for an object from a photo without depth, turned by less than 15 degrees; "
    "of method paper: the share of pairs that agree",
    "size_mm": "diameter, its standard deviation, and the sides of the box along the object's axes; of an "
    "object from a photo without depth with what this frame measured in place of the guess",
    "guessed_size_mm": "of such an object, diameter and box as they were guessed: of its mesh at camera_from_mesh",
    "box_of_object": "of such an object, lowest and highest corner of the box of size_mm, object coordinates",
    "covariance": "6 x 6, of rotation vector (rad, about the object's centre) and translation (m), camera axes",
    "ambiguity": "the object's axis about which it may be turned, and by how much (standard deviation)",
    "score": "of the pose, in [0, 1], to be compared with those of its alternatives; confidence says if it is right",
    "units": "a name ends in its unit: _m metres, _mm millimetres, _seconds seconds",
}

AMBIGUOUS_TURN = 25.0  # degrees of standard deviation above which reports name the axis


def pose_as_json(camera_from_b: Similarity[np.ndarray], unit: str) -> dict[str, Any]:
    """A similarity to camera metres for JSON; `unit` names what the scale is per."""
    rigid = Similarity(camera_from_b.rotation, camera_from_b.translation, np.ones(()))
    return {
        "matrix": camera_from_b.to_matrix().tolist(),
        "rigid_matrix": rigid.to_matrix().tolist(),
        "rotation": camera_from_b.rotation.tolist(),
        "translation_m": camera_from_b.translation.tolist(),
        f"scale_m_per_{unit}": float(camera_from_b.scale),
    }


def relative_pose(camera_from_object: Similarity, info: ObjectInfo) -> Similarity[np.ndarray]:
    """``camera_from_reference_camera`` of an estimate, in doubles: metres per unit of the reference camera.

    Raises ValueError for an object that was not made from a photo.
    """
    if info.reference is None:
        raise ValueError("the object was not made from a photo")
    camera_from_mesh = camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
    return camera_from_mesh @ info.reference.camera_from_mesh.to_numpy().inverse()


def relative_pose_as_json(camera_from_object: Similarity, info: ObjectInfo) -> dict[str, Any]:
    """The pose relative to the reference photo for JSON, with its scale and, where the photo had depth, without.

    Raises ValueError as `relative_pose`.
    """
    pose = relative_pose(camera_from_object, info)
    assert info.reference is not None
    entry = pose_as_json(pose, "reference_unit")
    entry["reference_unit"] = "m" if info.reference.metric else None
    entry["reference_photo"] = info.reference.file
    entry["rotation_degrees"] = float(np.degrees(np.arccos(np.clip((np.trace(pose.rotation) - 1) / 2, -1, 1))))
    if info.reference.metric:
        # A wrong scale about the camera would move the object: it is taken out about the object's centre.
        reference = info.reference
        camera_from_mesh = Similarity(
            *(np.asarray(x, np.float64) for x in (reference.rotation, reference.translation, reference.scale))
        )
        centre = camera_from_mesh @ np.asarray(info.mesh_centre, np.float64)[None]
        turn = Similarity(pose.rotation, np.zeros(3), np.ones(()))
        motion = Similarity(pose.rotation, (pose @ centre - turn @ centre)[0], np.ones(()))
        entry["rigid_motion"] = motion.to_matrix().tolist()
    return entry


def estimate_as_json(estimate: PoseEstimate, templates: Templates, info: ObjectInfo, alternatives: int = 4) -> dict:
    """One object's estimate for JSON; `pose` is null where none was found.

    ``camera_from_mesh`` maps the coordinates of the user's mesh file to camera metres; ``camera_from_object`` maps the
    normalised object.
    """
    found = bool(estimate.success) and all(
        np.isfinite(np.asarray(x)).all()
        for x in (
            estimate.camera_from_object.rotation,
            estimate.camera_from_object.translation,
            estimate.camera_from_object.scale,
        )
    )
    entry: dict[str, Any] = {
        "object": info.name,
        "mesh_file": info.mesh_file,
        "mesh_sha256": info.mesh_sha256,
        "success": found,
        "present": found and bool(estimate.present),
        "confidence": float(estimate.confidence) if found else 0.0,
        "camera_from_mesh": None,
        "camera_from_object": None,
    }
    if not found:
        return entry
    pose, object_from_mesh = estimate.camera_from_object.to_numpy(), info.object_from_mesh.to_numpy()
    entry["camera_from_mesh"] = pose_as_json(pose @ object_from_mesh, "mesh_unit")
    entry["camera_from_object"] = pose_as_json(pose, "model_unit")
    if info.reference is not None:
        entry["camera_from_reference_camera"] = relative_pose_as_json(estimate.camera_from_object, info)
    low, high = np.asarray(estimate.box)
    entry["size_mm"] = {
        "diameter": 1e3 * float(estimate.diameter),
        "box": [1e3 * float(pose.scale) * float(side) for side in high - low],
        "diameter_std": 1e3 * float(estimate.scale_std),
    }
    if templates.reference is not None and not templates.reference.measured:
        entry["guessed_size_mm"] = {
            "diameter": 1e3 * float(pose.scale),
            "box": [1e3 * float(pose.scale) * float(side) for side in np.asarray(templates.extents)],
        }
        entry["box_of_object"] = {"low": low.tolist(), "high": high.tolist()}
    entry["covariance"] = np.asarray(estimate.covariance, np.float64).tolist()
    turn = np.asarray(estimate.ambiguity, np.float64)
    length = float(np.linalg.norm(turn))
    entry["ambiguity"] = {
        "axis_of_object": (turn / max(length, 1e-12)).tolist(),
        "std_deg": float(np.degrees(length)),
    }
    entry["agreement"] = {
        part.name: float(getattr(estimate.agreement, part.name)) for part in dataclasses.fields(estimate.agreement)
    }
    if info.metres_per_unit is not None:
        entry["size_from_mesh_mm"] = {"diameter": 1e3 * info.metres_per_unit / info.mesh_scale}
    entry["inliers"] = int(estimate.inliers)
    entry["residual_rms_mm"] = 1e3 * float(estimate.rmse)
    entry["template"] = int(estimate.view)
    scores = np.asarray(estimate.hypotheses.score)
    entry["score"] = float(scores[0])
    entry["alternatives"] = []
    many = estimate.hypotheses.camera_from_object.to_numpy()
    for i in range(1, min(alternatives + 1, len(scores))):
        other = Similarity(many.rotation[i], many.translation[i], np.asarray(many.scale[i]))
        finite = all(np.isfinite(x).all() for x in (other.rotation, other.translation, other.scale))
        if scores[i] <= 0 or not finite:
            continue
        entry["alternatives"].append(
            {
                "score": float(scores[i]),
                "camera_from_mesh": pose_as_json(other @ object_from_mesh, "mesh_unit"),
            }
        )
    return entry


def nothing_as_json(name: str) -> dict[str, Any]:
    """As `estimate_as_json`, of an object that was sought in vain."""
    return {
        "object": name,
        "success": False,
        "present": False,
        "confidence": 0.0,
        "camera_from_mesh": None,
        "camera_from_object": None,
    }


def to_json(value: Any) -> str:
    """JSON with short lists of numbers on one line each, so that matrices can be read.

    Raises:
        ValueError: a number is not finite.
    """

    def is_flat(item: Any) -> bool:
        return isinstance(item, list) and all(isinstance(x, int | float | str) for x in item)

    def text(item: Any, indent: int) -> str:
        pad = "  " * (indent + 1)
        if isinstance(item, dict) and item:
            inner = ",\n".join(f"{pad}{json.dumps(str(k))}: {text(v, indent + 1)}" for k, v in item.items())
            return "{\n" + inner + "\n" + "  " * indent + "}"
        if isinstance(item, list) and item and not is_flat(item):
            return "[\n" + ",\n".join(pad + text(v, indent + 1) for v in item) + "\n" + "  " * indent + "]"
        return json.dumps(item, allow_nan=False, ensure_ascii=False)

    return text(value, 0) + "\n"
