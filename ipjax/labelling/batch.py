"""A batch of frames labelled: a pure function on NumPy's dictionaries, for anybody's engine."""

import dataclasses
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from ipjax.config import Config
from ipjax.detection.crops import Scene, read_scene
from ipjax.detection.detector import Detector
from ipjax.detection.masks import mask_from_pose
from ipjax.files.images.masks import as_mask, box_of
from ipjax.files.images.run_lengths import encode_rle
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.estimator import Estimator, Result
from ipjax.labelling.records import Batch, LabelSettings, empty_labels, seed_of, split_into_buckets
from ipjax.records import Similarity, Templates, View

_MOST_THREADS = 4
_ACCELERATOR_BUCKETS = (1, 2, 4, 8)
_KEPT = 2  # labellers that `label_batch` keeps


@dataclasses.dataclass
class _Instance:
    """A mask or a box of one object in one frame, and what becomes of it."""

    frame: int
    slot: int
    obj: int
    seed: int
    mask: np.ndarray | None = None
    box: Any = None  # x, y, width, height
    crop: tuple[View, Similarity] | None = None
    result: Result | None = None
    seconds: float = 0.0


class Labeller:
    """An encoder and objects, with all that was compiled for them: `label_batch` for many batches.

    Args:
        encoder: made the templates' features.
        objects: templates and what is known of them, as `ipjax.load` returns them. They are padded to one size, so that
            what is compiled for one serves all.
        config: of the estimates.
        settings: how frames are labelled.
    """

    def __init__(
        self,
        encoder: Any,
        objects: Sequence[tuple[Templates, ObjectInfo]],
        config: Config = Config(),
        settings: LabelSettings = LabelSettings(),
    ):
        if not objects:
            raise ValueError("labelling needs at least one object")
        self.encoder, self.config, self.settings = encoder, config, settings
        self._given = list(objects)
        self.infos = [info for _, info in objects]
        self.diameters = [None if settings.free_size else info.measured_diameter for info in self.infos]
        on_cpu = jax.default_backend() == "cpu"
        each = (1,) if on_cpu else _ACCELERATOR_BUCKETS
        self.buckets = settings.buckets or tuple(jax.local_device_count() * size for size in each)
        self.threads = settings.threads or min(_count_cores(), _MOST_THREADS)
        self._made: dict[bool, Estimator] = {}
        self._detector: Detector | None = None
        self._making = threading.RLock()

    def __call__(self, batch: Batch) -> Batch:
        """See `label_batch`."""
        ids = [str(name) for name in batch["id"]]
        count = len(ids)
        for name in ("rgb", "depth", "camera"):
            if name not in batch or len(batch[name]) != count:
                raise ValueError(f"a batch of {count} ids needs as many of {name}")
        if len(set(ids)) != count:
            raise ValueError("frames of a batch have ids of their own; some of these are the same")
        sought = batch.get("mask") is None and batch.get("box") is None
        slots, rows = self._list_slots(batch, count, sought)
        made = {"id": np.array(ids, object), **empty_labels(count, slots)}
        with ThreadPoolExecutor(self.threads) as pool:
            scenes = _timed(pool, made, range(count), lambda frame: self._open(batch, frame, made))
            if sought:
                self._sought()
                usable = [frame for frame in range(count) if scenes[frame] is not None]
                found = _timed(pool, made, usable, lambda frame: self._seek(ids[frame], frame, scenes[frame]))
                instances = [one for many in found for one in many]
            else:
                instances = [
                    _Instance(frame, slot, obj, seed_of(self.settings.seed, ids[frame], obj, instance), *given)
                    for frame, slot, obj, instance, given in rows
                    if scenes[frame] is not None
                ]
            self._cut(pool, instances, scenes, made, sought)
            self._estimate(pool, [one for one in instances if one.crop is not None], sought)
            list(pool.map(lambda one: self._tell(one, scenes[one.frame], made, sought), instances))
        for one in instances:
            made["seconds"][one.frame] += one.seconds
        return made

    def _list_slots(self, batch: Batch, count: int, sought: bool) -> tuple[int, list[tuple[int, int, int, int, Any]]]:
        """How many instances a frame may have; and of each that is given, frame, slot, object, the how many-th of this
        object in the frame, and its mask and box."""
        if sought:
            return len(self._given) * self.settings.most, []
        kinds = [name for name in ("mask", "box") if batch.get(name) is not None]
        for name in (*kinds, *(["object"] if batch.get("object") is not None else [])):
            if len(batch[name]) != count:
                raise ValueError(f"a batch of {count} ids needs as many of {name}")
        rows, most = [], 0
        for frame in range(count):
            places = max(len(batch[name][frame]) for name in kinds)
            if batch.get("object") is not None:
                which = [int(obj) for obj in batch["object"][frame]]
            elif places == len(self._given):
                which = list(range(places))
            else:
                raise ValueError(
                    f"{places} masks or boxes and {len(self._given)} objects: a column 'object' must say whose each is"
                )
            if any(obj >= len(self._given) for obj in which):
                raise ValueError(f"there are {len(self._given)} objects, and object {max(which)} is not among them")
            if any(len(batch[name][frame]) < len(which) for name in kinds):
                raise ValueError(f"{len(which)} objects of a frame need as many masks or boxes")
            most = max(most, len(which))
            seen: dict[int, int] = {}
            for slot, obj in enumerate(which):
                if obj < 0:
                    continue
                seen[obj] = seen.get(obj, -1) + 1
                given = tuple(None if batch.get(n) is None else batch[n][frame][slot] for n in ("mask", "box"))
                rows.append((frame, slot, obj, seen[obj], given))
        return most, rows

    def _estimator(self, sought: bool) -> Estimator:
        """Estimates in masks that were given or, with another confidence, found."""
        with self._making:
            if sought not in self._made:
                config = self.settings.detection.with_confidence(self.config) if sought else self.config
                self._made[sought] = Estimator(self._given, self.encoder, config, alike=True, crop=self.settings.crop)
            return self._made[sought]

    def _sought(self) -> Detector:
        with self._making:
            if self._detector is None:
                settings = self.settings
                about = self._given, self.encoder, settings.seeking
                self._detector = Detector(*about, detection=settings.detection, crop=settings.crop)
            return self._detector

    def _open(self, batch: Batch, frame: int, made: Batch) -> Scene | None:
        """A frame, checked; None where it cannot be used, and the reason is told."""
        try:
            scene = read_scene(batch["rgb"][frame], batch["depth"][frame], np.asarray(batch["camera"][frame]))
        except ValueError as error:
            made["error"][frame] = " ".join(str(error).split())
            return None
        made["size"][frame] = scene.depth.shape
        return scene

    def _seek(self, name: str, frame: int, scene: Any) -> list[_Instance]:
        """The instances of all objects in a frame, by their masks."""
        settings, most = self.settings, self.settings.most
        known = {"instances": settings.instances, "diameters": self.diameters}
        seed = seed_of(settings.seed, name, -1)
        told, _ = self._sought().detect(scene.rgb, scene.depth, scene.matrix, seed=seed, **known).told()
        found = []
        for obj in range(len(self._given)):
            for instance, one in enumerate([one for one in told if one.index == obj][:most]):
                seed = seed_of(settings.seed, name, obj, instance)
                found.append(_Instance(frame, obj * most + instance, obj, seed, one.mask))
        return found

    def _cut(self, pool: Any, instances: list[_Instance], scenes: list[Any], made: Batch, sought: bool) -> None:
        """Cut every instance out; where that cannot be done, the reason is told."""
        estimator = self._estimator(sought)

        def cut(one: _Instance) -> None:
            start = time.perf_counter()
            scene = scenes[one.frame]
            made["object"][one.frame, one.slot] = one.obj
            try:
                one.mask = None if one.mask is None else as_mask(one.mask)
                one.crop = estimator.frame(one.obj, scene.rgb, scene.depth, one.mask, scene.matrix, one.box)
            except ValueError as error:
                made["note"][one.frame, one.slot] = " ".join(str(error).split())
            one.seconds += time.perf_counter() - start

        list(pool.map(cut, instances))

    def _estimate(self, pool: Any, instances: list[_Instance], sought: bool) -> None:
        """Estimate crops, those of one object together in buckets."""
        estimator, parts = self._estimator(sought), []
        for obj in range(len(self._given)):
            mine = [one for one in instances if one.obj == obj]
            at = 0
            for count, size in split_into_buckets(len(mine), self.buckets):
                parts.append((obj, mine[at : at + count], size))
                at += count

        def run(part: tuple[int, list[_Instance], int]) -> None:
            obj, some, size = part
            crops = [one.crop for one in some if one.crop is not None]
            seeds = [one.seed for one in some]
            results = estimator.run_batch(obj, crops, seeds=seeds, diameter=self.diameters[obj], size=size)
            for one, result in zip(some, results, strict=True):
                one.result = result
                one.seconds += sum(seconds for name, seconds in result.seconds.items() if name != "compile")

        list(pool.map(run, parts))

    def _tell(self, one: _Instance, scene: Any, made: Batch, sought: bool) -> None:
        """Write what was found of an instance into the columns."""
        result, at = one.result, (one.frame, one.slot)
        if result is None:
            return
        start = time.perf_counter()
        found = jax.device_get(result.estimate)
        pose = found.camera_from_object.to_numpy()
        if not (bool(found.success) and np.isfinite(pose.to_matrix()).all()):
            made["note"][at] = "no pose was found in the mask"
            return
        made["success"][at], made["present"][at] = True, bool(found.present)
        made["camera_from_mesh"][at] = (pose @ result.info.object_from_mesh.to_numpy()).to_matrix()
        made["diameter"][at], made["diameter_std"][at] = float(found.diameter), float(found.scale_std)
        made["confidence"][at], made["margin"][at] = float(found.confidence), 1 - float(found.agreement.rival)
        made["covariance"][at] = np.asarray(found.covariance, np.float64)
        made["note"][at] = " ".join(result.warnings)
        templates = self._estimator(sought).objects[one.obj][0]
        about = result.estimate.camera_from_object, scene.matrix, scene.depth
        visible, whole = mask_from_pose(templates, *about, self.settings.detection)
        made["outline_pixels"][at] = int(whole.sum())
        if one.mask is not None:
            made["overlap"][at] = float((visible & one.mask).sum() / max((visible | one.mask).sum(), 1))
        box = box_of(visible)
        if box is not None:
            made["mask"][at], made["box"][at] = encode_rle(visible)["counts"], box
        one.seconds += time.perf_counter() - start


def label_batch(
    encoder: Any,
    objects: Sequence[tuple[Templates, ObjectInfo]],
    batch: Batch,
    *,
    config: Config = Config(),
    settings: LabelSettings = LabelSettings(),
) -> Batch:
    """Poses, sizes, certainty and visible masks of objects in several frames.

    The answers of a frame depend on it, its id, the objects and the settings alone, up to rounding: not on which frames
    are in the batch with it. What was compiled is kept, for the same ``encoder`` and ``objects``, from call to call.

    Args:
        encoder: made the templates' features.
        objects: templates and what is known of them, as `ipjax.load` returns them.
        batch: id, rgb, depth, camera, and mask or box, as `ipjax.labelling.records.Batch` says.
        config: of the estimates.
        settings: how frames are labelled.

    Returns:
        Columns as `ipjax.labelling.records.Batch` says; frames that cannot be used have an ``error``.

    Raises:
        ValueError: there are no objects, or the columns do not fit together.
    """
    with _keeping:
        for kept in _labellers:
            same = kept.encoder is encoder and [*map(id, _flat(kept._given))] == [*map(id, _flat(objects))]
            if same and kept.settings == settings and bool(kept.config == config):
                break
        else:
            kept = Labeller(encoder, objects, config, settings)
            _labellers.insert(0, kept)
            del _labellers[_KEPT:]
    return kept(batch)


_labellers: list[Labeller] = []
_keeping = threading.Lock()


def _flat(objects: Sequence[tuple[Templates, ObjectInfo]]) -> list[Any]:
    return [part for pair in objects for part in pair]


def _timed(pool: Any, made: Batch, frames: Iterable[int], work: Callable[[int], Any]) -> list[Any]:
    """What ``work`` gives for each frame; the seconds that it took are added to the frame's."""

    def run(frame: int) -> Any:
        start = time.perf_counter()
        found = work(frame)
        made["seconds"][frame] += time.perf_counter() - start
        return found

    return list(pool.map(run, frames))


def _count_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
