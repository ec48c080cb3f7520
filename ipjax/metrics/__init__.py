"""Pose errors as the BOP benchmark and the YCB-V papers define them. Pure: written for one pose, the caller vmaps.

Lengths may be in any unit, as long as all of them (points, translations, depths, tolerances, diameters) share it.
Every pose is a ``camera_from_object``; ``truth`` comes before ``estimate``, what is fixed before what is new.
Distances, averages and the parts of a pose are written once for JAX's arrays and for NumPy's, in whose precision they
are then measured; the search among symmetries (`closest_symmetry`, `mssd`, `mspd`) and VSD are JAX alone. To measure
MSSD in doubles, take `surface_distance` of the truth after the symmetry that `closest_symmetry` found.
Definitions: https://github.com/thodan/bop_toolkit (pose_error.py, misc.py) and Hodan et al., "BOP Challenge 2020 on 6D
Object Localization", section 2.2. Comparisons are strict (error < threshold), except VSD's pixel cost (>=).

Each name is imported from its module when it is first used: the graph needs one of them, and is not to depend on all.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipjax.metrics.poses import rotation_error as rotation_error
    from ipjax.metrics.poses import scale_error as scale_error
    from ipjax.metrics.poses import symmetric_errors as symmetric_errors
    from ipjax.metrics.poses import translation_error as translation_error
    from ipjax.metrics.poses import turn_angle as turn_angle
    from ipjax.metrics.precision import OVERLAPS as OVERLAPS
    from ipjax.metrics.precision import average_precision as average_precision
    from ipjax.metrics.precision import box_overlaps as box_overlaps
    from ipjax.metrics.precision import detection_precision as detection_precision
    from ipjax.metrics.precision import mask_overlaps as mask_overlaps
    from ipjax.metrics.precision import match_overlaps as match_overlaps
    from ipjax.metrics.precision import match_poses as match_poses
    from ipjax.metrics.precision import overlap_precision as overlap_precision
    from ipjax.metrics.recalls import ADD_LIMIT as ADD_LIMIT
    from ipjax.metrics.recalls import GRASP_LIMIT as GRASP_LIMIT
    from ipjax.metrics.recalls import PIXEL_THRESHOLDS as PIXEL_THRESHOLDS
    from ipjax.metrics.recalls import SHIFT_LIMIT as SHIFT_LIMIT
    from ipjax.metrics.recalls import SIZE_TOLERANCES as SIZE_TOLERANCES
    from ipjax.metrics.recalls import THRESHOLDS as THRESHOLDS
    from ipjax.metrics.recalls import TURN_LIMIT as TURN_LIMIT
    from ipjax.metrics.recalls import area_under_accuracy as area_under_accuracy
    from ipjax.metrics.recalls import auc as auc
    from ipjax.metrics.recalls import average_recall as average_recall
    from ipjax.metrics.recalls import pose_recall as pose_recall
    from ipjax.metrics.recalls import recall as recall
    from ipjax.metrics.surface import SizedErrors as SizedErrors
    from ipjax.metrics.surface import add as add
    from ipjax.metrics.surface import add_s as add_s
    from ipjax.metrics.surface import closest_symmetry as closest_symmetry
    from ipjax.metrics.surface import mspd as mspd
    from ipjax.metrics.surface import mssd as mssd
    from ipjax.metrics.surface import projection_distance as projection_distance
    from ipjax.metrics.surface import projections_overlap as projections_overlap
    from ipjax.metrics.surface import reprojection_error as reprojection_error
    from ipjax.metrics.surface import sized_errors as sized_errors
    from ipjax.metrics.surface import spheres_overlap as spheres_overlap
    from ipjax.metrics.surface import surface_distance as surface_distance
    from ipjax.metrics.symmetries import SYMMETRY_STEP as SYMMETRY_STEP
    from ipjax.metrics.symmetries import discretise_symmetries as discretise_symmetries
    from ipjax.metrics.visible import distances_from_camera as distances_from_camera
    from ipjax.metrics.visible import visibility as visibility
    from ipjax.metrics.visible import vsd as vsd

__all__ = [
    "ADD_LIMIT",
    "GRASP_LIMIT",
    "OVERLAPS",
    "PIXEL_THRESHOLDS",
    "SHIFT_LIMIT",
    "SIZE_TOLERANCES",
    "SYMMETRY_STEP",
    "THRESHOLDS",
    "TURN_LIMIT",
    "SizedErrors",
    "add",
    "add_s",
    "area_under_accuracy",
    "auc",
    "average_precision",
    "average_recall",
    "box_overlaps",
    "closest_symmetry",
    "detection_precision",
    "discretise_symmetries",
    "distances_from_camera",
    "mask_overlaps",
    "match_overlaps",
    "match_poses",
    "mspd",
    "mssd",
    "overlap_precision",
    "pose_recall",
    "projection_distance",
    "projections_overlap",
    "recall",
    "reprojection_error",
    "rotation_error",
    "scale_error",
    "sized_errors",
    "spheres_overlap",
    "surface_distance",
    "symmetric_errors",
    "translation_error",
    "turn_angle",
    "visibility",
    "vsd",
]

# Where each of them is.
_HOMES = {
    "poses": (
        "rotation_error",
        "scale_error",
        "symmetric_errors",
        "translation_error",
        "turn_angle",
    ),
    "precision": (
        "OVERLAPS",
        "average_precision",
        "box_overlaps",
        "detection_precision",
        "mask_overlaps",
        "match_overlaps",
        "match_poses",
        "overlap_precision",
    ),
    "recalls": (
        "ADD_LIMIT",
        "GRASP_LIMIT",
        "PIXEL_THRESHOLDS",
        "SHIFT_LIMIT",
        "SIZE_TOLERANCES",
        "THRESHOLDS",
        "TURN_LIMIT",
        "area_under_accuracy",
        "auc",
        "average_recall",
        "pose_recall",
        "recall",
    ),
    "surface": (
        "SizedErrors",
        "add",
        "add_s",
        "closest_symmetry",
        "mspd",
        "mssd",
        "projection_distance",
        "projections_overlap",
        "reprojection_error",
        "sized_errors",
        "spheres_overlap",
        "surface_distance",
    ),
    "symmetries": (
        "SYMMETRY_STEP",
        "discretise_symmetries",
    ),
    "visible": (
        "distances_from_camera",
        "visibility",
        "vsd",
    ),
}
_HOME = {name: f"ipjax.metrics.{module}" for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'ipjax.metrics' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
