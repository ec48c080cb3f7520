"""ipjax: from one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose, in JAX.

``import ipjax`` loads nothing but this file: every name is imported from its module when it is first used.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipjax.bop.dataset import Dataset
    from ipjax.bop.evaluation import evaluate
    from ipjax.bop.results import read_results, write_results
    from ipjax.bop.scoring.scores import score
    from ipjax.config import (
        AlignConfig,
        ConfidenceConfig,
        Config,
        DecisionConfig,
        DescribeConfig,
        DetectConfig,
        GraspConfig,
        MatchConfig,
        OnboardConfig,
        RefineConfig,
        ResectConfig,
        ScoreConfig,
    )
    from ipjax.detection.detector import Detector
    from ipjax.detection.explanation.page import explain
    from ipjax.detection.records import Detection, Detections, Reason, Rejected
    from ipjax.estimation.features import describe, observe
    from ipjax.estimation.pipeline import estimate
    from ipjax.files.cameras.intrinsics import Intrinsics
    from ipjax.files.cameras.reading import read_camera
    from ipjax.files.images.candidates import read_candidates
    from ipjax.files.images.depth import read_depth
    from ipjax.files.images.masks import read_mask
    from ipjax.files.images.opening import read_rgb
    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.mesh import Mesh
    from ipjax.files.meshes.saving import save_mesh
    from ipjax.files.objects.loading import load
    from ipjax.files.objects.saving import save
    from ipjax.files.weights.encoder import load_encoder
    from ipjax.inference.batching import compact, pad_templates
    from ipjax.inference.drawing import draw
    from ipjax.inference.estimator import Estimator
    from ipjax.inference.frames import frame, frame_turned
    from ipjax.labelling.batch import Labeller, label_batch
    from ipjax.labelling.records import LabelSettings
    from ipjax.onboarding.mesh import onboard
    from ipjax.onboarding.photo import onboard_photo
    from ipjax.onboarding.photographed import onboard_with_photo
    from ipjax.records import Camera, Patches, PoseEstimate, Query, ReferenceView, Surface, Templates, View
    from ipjax.robot.grasps.decision import Decision, decide
    from ipjax.robot.grasps.planning import box_grasps, plan_grasps
    from ipjax.robot.grippers import read_gripper, write_gripper
    from ipjax.robot.records import Grasps, Gripper, Workspace, place_grasps
    from ipjax.synthetic.degradation import degrade
    from ipjax.synthetic.objects import make_object
    from ipjax.synthetic.scenes import make_scene
    from ipjax.transforms import Similarity

__version__ = "0.1.0"
__all__ = [
    "AlignConfig",
    "Camera",
    "ConfidenceConfig",
    "Config",
    "Dataset",
    "Decision",
    "DecisionConfig",
    "DescribeConfig",
    "DetectConfig",
    "Detection",
    "Detections",
    "Detector",
    "Estimator",
    "GraspConfig",
    "Grasps",
    "Gripper",
    "Intrinsics",
    "LabelSettings",
    "Labeller",
    "MatchConfig",
    "Mesh",
    "OnboardConfig",
    "Patches",
    "PoseEstimate",
    "Query",
    "Reason",
    "ReferenceView",
    "RefineConfig",
    "Rejected",
    "ResectConfig",
    "ScoreConfig",
    "Similarity",
    "Surface",
    "Templates",
    "View",
    "Workspace",
    "box_grasps",
    "compact",
    "decide",
    "degrade",
    "describe",
    "draw",
    "estimate",
    "evaluate",
    "explain",
    "frame",
    "frame_turned",
    "label_batch",
    "load",
    "load_encoder",
    "load_mesh",
    "make_object",
    "make_scene",
    "observe",
    "onboard",
    "onboard_photo",
    "onboard_with_photo",
    "pad_templates",
    "place_grasps",
    "plan_grasps",
    "read_camera",
    "read_candidates",
    "read_depth",
    "read_gripper",
    "read_mask",
    "read_results",
    "read_rgb",
    "save",
    "save_mesh",
    "score",
    "write_gripper",
    "write_results",
]

# Where each of them is.
_HOMES = {
    "bop.dataset": ("Dataset",),
    "bop.evaluation": ("evaluate",),
    "bop.results": (
        "read_results",
        "write_results",
    ),
    "bop.scoring.scores": ("score",),
    "config": (
        "AlignConfig",
        "ConfidenceConfig",
        "Config",
        "DecisionConfig",
        "DescribeConfig",
        "DetectConfig",
        "GraspConfig",
        "MatchConfig",
        "OnboardConfig",
        "RefineConfig",
        "ResectConfig",
        "ScoreConfig",
    ),
    "detection.detector": ("Detector",),
    "detection.explanation.page": ("explain",),
    "detection.records": (
        "Detection",
        "Detections",
        "Reason",
        "Rejected",
    ),
    "estimation.features": (
        "describe",
        "observe",
    ),
    "estimation.pipeline": ("estimate",),
    "files.cameras.intrinsics": ("Intrinsics",),
    "files.cameras.reading": ("read_camera",),
    "files.images.candidates": ("read_candidates",),
    "files.images.depth": ("read_depth",),
    "files.images.masks": ("read_mask",),
    "files.images.opening": ("read_rgb",),
    "files.meshes.loading": ("load_mesh",),
    "files.meshes.mesh": ("Mesh",),
    "files.meshes.saving": ("save_mesh",),
    "files.objects.loading": ("load",),
    "files.objects.saving": ("save",),
    "files.weights.encoder": ("load_encoder",),
    "inference.batching": (
        "compact",
        "pad_templates",
    ),
    "inference.drawing": ("draw",),
    "inference.estimator": ("Estimator",),
    "inference.frames": (
        "frame",
        "frame_turned",
    ),
    "labelling.batch": (
        "Labeller",
        "label_batch",
    ),
    "labelling.records": ("LabelSettings",),
    "onboarding.mesh": ("onboard",),
    "onboarding.photo": ("onboard_photo",),
    "onboarding.photographed": ("onboard_with_photo",),
    "records": (
        "Camera",
        "Patches",
        "PoseEstimate",
        "Query",
        "ReferenceView",
        "Surface",
        "Templates",
        "View",
    ),
    "robot.grasps.decision": ("Decision", "decide"),
    "robot.grasps.planning": (
        "box_grasps",
        "plan_grasps",
    ),
    "robot.grippers": (
        "read_gripper",
        "write_gripper",
    ),
    "robot.records": (
        "Grasps",
        "Gripper",
        "Workspace",
        "place_grasps",
    ),
    "synthetic.degradation": ("degrade",),
    "synthetic.objects": ("make_object",),
    "synthetic.scenes": ("make_scene",),
    "transforms": ("Similarity",),
}
_HOME = {name: f"ipjax.{module}" for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name.isidentifier() and not name.startswith("_") and importlib.util.find_spec(f"ipjax.{name}") is not None:
        return importlib.import_module(f"ipjax.{name}")
    raise AttributeError(f"module 'ipjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
