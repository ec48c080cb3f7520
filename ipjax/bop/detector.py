"""A detector for every frame of a data set: what `evaluation.evaluate` runs where no masks are given."""

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipjax.bop.detections import Detection, as_detection, read_detections, write_detections
from ipjax.bop.estimator import DatasetEstimator
from ipjax.bop.objects import OnboardedObject
from ipjax.bop.records import Estimate, Frame, Target
from ipjax.config import Config, DetectConfig
from ipjax.detection.detector import Detector
from ipjax.files.objects.loading import load
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.provenance import hash_executed
from ipjax.files.settings import describe_config
from ipjax.networks.dinov2 import Encoder


class DatasetDetector(DatasetEstimator):
    """As `DatasetEstimator`, but masks are not looked at: of each target's object, as many as there are targets are
    sought in the whole frame, all objects of a frame together.

    Args:
        objects, encoder, config, crop, seed, known_size: as `DatasetEstimator` has them; poses are those that verify
            the proposals.
        detection: how objects are sought.
        everything: seek all objects in every frame, as many as there are, whatever the targets name.
        folder: gets a file of detections in two dimensions for each image; see `join_detections`.
    """

    seeks = True  # `evaluation.evaluate` reads no masks for it

    def __init__(
        self,
        objects: Mapping[int, OnboardedObject],
        encoder: Encoder,
        config: Config = Config(),
        *,
        crop: str = "square",
        seed: int = 0,
        known_size: bool = False,
        detection: DetectConfig = DetectConfig(),
        everything: bool = False,
        folder: Path | None = None,
    ):
        super().__init__(objects, encoder, config, crop=crop, seed=seed, known_size=known_size)
        self.detection, self.everything, self.folder = detection, everything, folder
        self.numbers = list(self.objects)  # by the detector's index
        loaded = (load(self.objects[obj_id].path, encoder) for obj_id in self.numbers)
        self.detector = Detector(loaded, encoder, config, detection=detection, crop=crop)
        self.notes = [*self.notes, "masks were not given but found"]

    def with_config(self, config: Config) -> "DatasetDetector":
        """The same objects, loaded anew, with another configuration."""
        return DatasetDetector(
            self.objects,
            self.encoder,
            config,
            crop=self.crop,
            seed=self.seed,
            known_size=self.known_size,
            detection=self.detection,
            everything=self.everything,
            folder=self.folder,
        )

    def info(self, obj_id: int) -> ObjectInfo:
        """What is known of an object."""
        return self.detector.estimator.objects[self.numbers.index(obj_id)][1]

    def settings(self) -> dict[str, Any]:
        """What the results depend on, as plain JSON; a resumed run must agree in it."""
        return super().settings() | {
            "detection": describe_config(self.detection),
            "everything": self.everything,
            "code": hash_executed("ipjax.bop.detector"),
        }

    def __call__(self, frame: Frame, targets: Sequence[Target]) -> list[Estimate]:
        if frame.depth is None:
            self.refused.append(f"scene {frame.scene_id}, image {frame.im_id}: no depth image")
            return []
        start = time.perf_counter()
        counts = Counter(target.obj_id for target in targets)
        wanted = [
            (index, self.detection.instances if self.everything else counts[obj_id])
            for index, obj_id in enumerate(self.numbers)
        ]
        sight = self.detector.look(frame.rgb, frame.depth, frame.camera)
        claims = []
        for index, count in wanted:
            if count:
                info = self.info(self.numbers[index])
                diameter = self.unit(self.numbers[index], info) / info.mesh_scale if self.known_size else None
                claims += self.detector.seek(sight, index, instances=count, diameter=diameter, seed=self.seed)[0]
        found = self.detector.choose(sight, claims, instances=[count for _, count in wanted])
        compiled = found.seconds.get("compile", 0.0)
        self.compile_seconds += compiled
        seconds = time.perf_counter() - start - compiled
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            masks = [
                as_detection(frame.scene_id, frame.im_id, self.numbers[one.index], one.score, one.mask, seconds)
                for one in found
            ]
            write_detections(_file_of(self.folder, frame.scene_id, frame.im_id), masks)
        missed = {self.numbers[index] for index, count in wanted if count} - {self.numbers[one.index] for one in found}
        for obj_id in sorted(missed) if not self.everything else ():
            self.refused.append(f"scene {frame.scene_id}, image {frame.im_id}, object {obj_id}: not found")
        return [self.as_estimate(self.numbers[one.index], one.result, one.score) for one in found]


def join_detections(folder: Path, path: Path, images: Iterable[tuple[int, int]]) -> Path:
    """One file of the detections in two dimensions that a `DatasetDetector` wrote into a folder, image by image.

    ``images``: (scene, image) of this run; a folder that was begun anew may have others of before.
    """
    found: list[Detection] = []
    for image in sorted(images):
        file = _file_of(folder, *image)
        found += read_detections(file) if file.is_file() else []
    return write_detections(path, found)


def _file_of(folder: Path, scene_id: int, im_id: int) -> Path:
    return folder / f"{scene_id:06d}_{im_id:06d}.json"
