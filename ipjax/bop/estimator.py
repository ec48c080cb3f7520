"""An estimator for every frame of a data set: what `evaluation.evaluate` runs."""

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ipjax import __version__
from ipjax.bop.objects import OnboardedObject
from ipjax.bop.records import MM, Estimate, Frame, Target
from ipjax.config import Config
from ipjax.files.objects.loading import load
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.provenance import hash_executed
from ipjax.files.settings import describe_config
from ipjax.inference.estimator import Estimator, Result
from ipjax.networks.dinov2 import Encoder
from ipjax.records import Patches, View
from ipjax.transforms import Similarity

SHARED = 512  # described crops kept for other configurations; about 1.5 MB each
# The modules of this package that an estimate depends on: reading, and writing an estimate as a row.
READERS = ("alignments", "dataset", "detections", "estimator", "objects", "records", "results")


def hash_code() -> str:
    """Sixteen digits of the source that an estimate depends on, so that results of another state are not continued."""
    return hash_executed("ipjax.inference.estimator", also=tuple(f"ipjax.bop.{name}" for name in READERS))


class DatasetEstimator:
    """An estimator for `evaluation.evaluate`: every target with a mask, each object compiled for once.

    Args:
        objects: object files by number.
        encoder: made their features.
        config: of the estimate.
        crop: "square" or "look_at".
        seed: same seed, same answers.
        known_size: give the estimate the object's true diameter.
        keep: also keep the `Result` of every target in ``results``, for pictures.
        share: keep the description of each target's crop (of the first few hundred) for those made by `with_config`.
    """

    def __init__(
        self,
        objects: Mapping[int, OnboardedObject],
        encoder: Encoder,
        config: Config = Config(),
        *,
        crop: str = "square",
        seed: int = 0,
        known_size: bool = False,
        keep: bool = False,
        share: bool = False,
    ):
        self.objects = dict(objects)
        self.encoder = encoder
        self.crop, self.seed, self.known_size, self.keep = crop, seed, known_size, keep
        self.estimator = Estimator([], encoder, config, crop=crop)
        self.order: dict[int, int] = {}
        self.notes = ["the method was told each object's true size"] if known_size else []
        self.compile_seconds = 0.0  # not counted as time per image
        self.shared_seconds = 0.0  # counted as if it had been spent here
        self.described: dict[tuple[int, int, int, int], tuple[tuple[View, Similarity], Patches, float]] | None = (
            {} if share else None
        )
        self.refused: list[str] = []  # targets that could not be tried, and why
        self.results: dict[tuple[int, int, int], Result] = {}

    def with_config(self, config: Config) -> "DatasetEstimator":
        """The same objects with another configuration. They are loaded once; and crops, whose descriptions depend on no
        setting of the estimate, are described once where this one was made to ``share``."""
        other = DatasetEstimator(
            self.objects,
            self.encoder,
            config,
            crop=self.crop,
            seed=self.seed,
            known_size=self.known_size,
            keep=self.keep,
        )
        other.described, other.order, other.estimator.objects = self.described, self.order, self.estimator.objects
        return other

    @property
    def alignments(self) -> dict[int, Similarity[np.ndarray]]:
        """``model_from_mesh`` of the objects that have one, for `evaluation.evaluate`."""
        objects = self.objects.items()
        return {obj_id: one.model_from_mesh for obj_id, one in objects if one.model_from_mesh is not None}

    @property
    def aligned_by(self) -> dict[int, str]:
        """Where each alignment comes from, for `evaluation.evaluate`."""
        return {obj_id: self.objects[obj_id].aligned_by for obj_id in self.alignments}

    def settings(self) -> dict[str, Any]:
        """What the results depend on, as plain JSON; a resumed run must agree in it."""
        made = {}
        for obj_id in self.objects:
            info = self.info(obj_id)
            made[str(obj_id)] = {
                "content": info.content_sha256,
                "mesh": info.mesh_sha256,
                "notes": list(info.notes),
                **_onboarding_settings(info.config),
            }
        return {
            "version": __version__,
            "code": hash_code(),
            "config": describe_config(self.estimator.config),
            "crop": self.crop,
            "seed": self.seed,
            "known_size": self.known_size,
            "encoder": self.encoder.identity,
            "objects": made,
        }

    def __call__(self, frame: Frame, targets: Sequence[Target]) -> list[Estimate]:
        found = []
        for number, target in enumerate(targets):
            if target.obj_id not in self.objects:
                continue
            where = f"scene {frame.scene_id}, image {frame.im_id}, object {target.obj_id}"
            if frame.depth is None:
                self.refused.append(f"{where}: no depth image")
                continue
            index = self._index(target.obj_id)
            key = (frame.scene_id, frame.im_id, target.obj_id, number)
            kept = (self.described or {}).get(key)
            start = time.perf_counter()
            try:
                if kept is None:
                    crop, patches = self.estimator.frame(index, frame.rgb, frame.depth, target.mask, frame.camera), None
                else:
                    crop, patches, seconds = kept
                    self.shared_seconds += seconds
            except ValueError as error:  # the mask or the depth is empty: a miss
                self.refused.append(f"{where}: {error}")
                continue
            seconds = time.perf_counter() - start
            info = self.estimator.objects[index][1]
            diameter = self.unit(target.obj_id, info) / info.mesh_scale if self.known_size else None
            result = self.estimator.run(index, *crop, seed=self.seed, diameter=diameter, patches=patches)
            self.compile_seconds += result.seconds.get("compile", 0.0)
            if self.described is not None and patches is None and len(self.described) < SHARED:
                seconds += result.seconds["describe"]
                self.described[key] = crop, result.query.patches, seconds
            if self.keep:
                self.results[frame.scene_id, frame.im_id, target.obj_id] = result
            if not bool(result.estimate.success):
                self.refused.append(f"{where}: no pose found")
                continue
            score = target.score * float(result.estimate.confidence)
            found.append(self.as_estimate(target.obj_id, result, score))
        return found

    def as_estimate(self, obj_id: int, result: Result, score: float) -> Estimate:
        """A result for the coordinates of the object's model, or of a mesh of its own."""
        pose = result.estimate.camera_from_object.to_numpy() @ result.info.object_from_mesh.to_numpy()
        # Metres per metre of the model, or per unit of a mesh of its own.
        scale = float(pose.scale) / (self.unit(obj_id, result.info) if self._has_model(obj_id) else 1)
        return Estimate(obj_id, score, pose.rotation, pose.translation, scale)

    def unit(self, obj_id: int, info: ObjectInfo) -> float:
        """Metres in a unit of the mesh that an object was onboarded from."""
        model_from_mesh = self.objects[obj_id].model_from_mesh
        return info.metres_per_unit or MM if model_from_mesh is None else float(model_from_mesh.scale)

    def _has_model(self, obj_id: int) -> bool:
        return self.objects[obj_id].model_from_mesh is None

    def info(self, obj_id: int) -> ObjectInfo:
        """What is known of an object."""
        return self.estimator.objects[self._index(obj_id)][1]

    def _index(self, obj_id: int) -> int:
        if obj_id not in self.order:
            self.order[obj_id] = len(self.estimator.objects)
            self.estimator.objects.append(load(self.objects[obj_id].path, self.encoder))
        return self.order[obj_id]


def _onboarding_settings(config: Any) -> dict[str, Any]:
    """How an object was onboarded, as plain JSON; empty where that is not known."""
    return {"onboarding": json.loads(json.dumps(config, default=str))} if config else {}
