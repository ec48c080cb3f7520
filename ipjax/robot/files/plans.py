"""Grasps as ipjax writes them: JSON in which every frame and unit is named."""

from typing import Any

import numpy as np

from ipjax.robot.grippers import describe_gripper
from ipjax.robot.records import Grasps, Gripper, place_grasps
from ipjax.transforms import Similarity

CONVENTIONS = {
    "gripper": "origin at the hand's base, z = approach, fingers close along the axis in gripper.closing; metres",
    "object": "the metric object: axes and origin of the estimate's object (the centre of its box), in metres; the "
    "scale of camera_from_object, metres per model unit, is divided out",
    "mesh": "axes and origin of your mesh file, in metres: coordinates of the file times mesh_scale_m_per_unit",
    "camera": "OpenCV axes of the colour camera: x right, y down, z ahead; metres",
    "base": "the robot's, as in the file of base_from_camera; metres; null where none was given",
    "a_from_b": "4 x 4, row by row, rigid: x_a = a_from_b @ (x_b, 1); "
    "base_from_gripper = base_from_camera @ camera_from_object @ object_from_gripper",
    "width_m": "between the pads once they touch: the opening that the object needs",
    "spare_m": "between each opened finger and the object",
    "safe": "share of the poses within the estimate's uncertainty at which the grasp still holds",
    "score": "from 0 to 1, higher is better; grasps are listed best first",
    "contacts_object_m": "where the pads touch, first the one at the negative end of the closing axis",
}


def grasps_as_json(
    grasps: Grasps,
    gripper: Gripper,
    camera_from_object: Similarity,
    base_from_camera: Similarity | None,
    *,
    mesh_scale: float = 1.0,
    mesh_centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict[str, Any]:
    """The valid grasps of one object for JSON.

    Args:
        grasps: metric object frame.
        gripper: that they are for.
        camera_from_object: of the estimate, with its scale.
        base_from_camera: rigid; or None.
        mesh_scale, mesh_centre: of the object's `ObjectInfo`.
    """
    pose = camera_from_object.to_numpy()
    valid = np.asarray(grasps.valid)
    object_from_gripper = grasps.object_from_gripper.to_numpy().take(valid)
    scale = float(pose.scale) * mesh_scale  # metres per unit of the mesh
    one = np.ones(())
    mesh_from_object = Similarity(np.eye(3), scale * np.asarray(mesh_centre, np.float64), one)
    camera_from_gripper = place_grasps(object_from_gripper, pose).to_matrix()
    mesh_from_gripper = place_grasps(object_from_gripper, mesh_from_object).to_matrix()
    base_from_gripper = None
    if base_from_camera is not None:
        base_from_gripper = place_grasps(object_from_gripper, pose, base_from_camera.to_numpy()).to_matrix()
    numbers = {
        name: np.asarray(getattr(grasps, field), np.float64)[valid]
        for name, field in (("score", "score"), ("safe", "safe"), ("width_m", "width"), ("spare_m", "spare"))
    }
    contacts = np.asarray(grasps.contacts, np.float64)[valid]
    object_poses = object_from_gripper.to_matrix()
    entries = [
        {name: round(float(values[i]), 6) for name, values in numbers.items()}
        | {
            "object_from_gripper": object_poses[i].tolist(),
            "camera_from_gripper": camera_from_gripper[i].tolist(),
            "base_from_gripper": None if base_from_gripper is None else base_from_gripper[i].tolist(),
            "mesh_from_gripper": mesh_from_gripper[i].tolist(),
            "contacts_object_m": contacts[i].tolist(),
        }
        for i in range(int(valid.sum()))
    ]
    return {
        "format": "ipjax grasps 1",
        "conventions": CONVENTIONS,
        "gripper": describe_gripper(gripper),
        "camera_from_object": Similarity(pose.rotation, pose.translation, one).to_matrix().tolist(),
        "scale_m_per_model_unit": float(pose.scale),
        "mesh_scale_m_per_unit": scale,
        "base_from_camera": None if base_from_camera is None else base_from_camera.to_numpy().to_matrix().tolist(),
        "grasps": entries,
    }
