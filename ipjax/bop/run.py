"""A study: the objects of a data set onboarded (or taken from where they are kept), and an estimator for its frames.

`evaluation.evaluate` runs what `Finder` is, over the targets of a data set, and scores it.
"""

import dataclasses
import hashlib
import json
import logging
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ipjax import __version__
from ipjax.bop.dataset import MM, Dataset, DatasetError, Estimate, Frame, Target
from ipjax.bop.evaluation import Alignment, read_alignment
from ipjax.config import Config, OnboardConfig
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.objects.layout import FORMAT
from ipjax.files.objects.loading import load
from ipjax.files.objects.saving import save
from ipjax.files.provenance import hash_executed
from ipjax.files.settings import describe_config
from ipjax.files.storage.cache import cache_folder
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.hashes import hash_file
from ipjax.inference.estimator import Estimator, Result
from ipjax.networks.dinov2 import Encoder
from ipjax.onboarding.mesh import onboard
from ipjax.records import Patches, Similarity, View
from ipjax.synthetic.degradation import alignment_as_json, degrade

log = logging.getLogger("ipjax")

SHARED = 512  # descriptions kept for a second configuration; about 1.5 MB each
OWN_MAP = "the degradation's own map"


@dataclasses.dataclass(frozen=True)
class Known:
    """An object file of a data set's object, and how its mesh lies in the annotated model's frame."""

    obj_id: int
    path: Path
    alignment: Alignment | None = None  # None: the mesh is the model itself, in millimetres


def prepare(
    dataset: Dataset,
    encoder: Encoder,
    *,
    folder: str | Path | None = None,
    objects: Iterable[int] | None = None,
    config: OnboardConfig = OnboardConfig(),
    quality: int = 0,
    seed: int = 0,
    meshes: Mapping[int, str | Path] | None = None,
    alignments: Mapping[int, str | Path] | None = None,
    progress: bool = True,
) -> dict[int, Known]:
    """Object files of all objects that are targets; what is missing is onboarded from ``models/`` and kept.

    Args:
        folder: object files named by number (``obj_000001.ipjax``); what is there is used as it is, what is missing is
            added. None: the user's cache, where a file is named after all that it was made of.
        objects: only these.
        quality: 0 = the models as they are; 1–4: degraded to this level (see `degradation`) and, with a ``folder``,
            kept in its subfolder ``quality_LEVEL``; those of ``meshes`` are kept in ``meshes``.
        seed: of the degradation.
        meshes: for some objects a mesh of one's own, a reconstruction perhaps; then ``alignments`` must have the file
            of its similarity to the model (for evaluation only).

    Raises DatasetError or ValueError, in a sentence, for what is missing or damaged, or made by another encoder.
    """
    meshes, alignments = dict(meshes or {}), dict(alignments or {})
    wanted = {row.obj_id for row in dataset.targets}
    if objects is not None:
        wanted &= set(objects)
    if not wanted:
        raise DatasetError(f"{dataset.targets_file}: there are no targets of the objects asked for")
    for obj_id in sorted({*meshes, *alignments}):
        if (obj_id in meshes) != (obj_id in alignments):
            raise DatasetError(f"object {obj_id}: a mesh of one's own and an alignment file come together")
    there: dict[int, Path] = {}
    if folder is not None:
        folder = Path(folder) / f"quality_{quality}" if quality else Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(folder.glob("*.ipjax")):
            if number := re.search(r"(\d+)$", path.stem):
                there[int(number[1])] = path
    known = {}
    for count, obj_id in enumerate(sorted(wanted)):
        source = Path(meshes[obj_id]) if obj_id in meshes else dataset.model_path(obj_id, "models")
        alignment = read_alignment(alignments[obj_id]) if obj_id in alignments else None
        key = _key(source, encoder, config, quality, seed)
        if folder is not None and obj_id in meshes:  # the file with its number is of the model
            path = folder / "meshes" / f"obj_{obj_id:06d}_{key}.ipjax"
        elif folder is None:
            path = cache_folder("objects") / f"{source.stem}_{key}.ipjax"
        else:
            path = there.get(obj_id, folder / f"obj_{obj_id:06d}.ipjax")
        if quality and alignment is None:
            alignment = _kept_alignment(path.with_suffix(".json"))
        if not path.is_file() or (quality and alignment is None):
            start = time.perf_counter()
            path.parent.mkdir(parents=True, exist_ok=True)
            alignment = _onboard(source, path, encoder, config, quality, seed, obj_id in meshes, alignment, progress)
            seconds = time.perf_counter() - start
            log.info("object %d of %d: %s onboarded in %.0f s", count + 1, len(wanted), source.name, seconds)
            if progress:
                print(f"{count + 1} of {len(wanted)}: {source.name} onboarded in {seconds:.0f} s", flush=True)
        known[obj_id] = Known(obj_id, path, alignment)
    return known


def _onboard(
    source: Path,
    path: Path,
    encoder: Encoder,
    config: OnboardConfig,
    quality: int,
    seed: int,
    foreign: bool,
    alignment: Alignment | None,
    progress: bool,
) -> Alignment | None:
    if not quality:
        unit = None if foreign else MM
        onboard(source, encoder, config, out=path, metres_per_unit=unit, progress=progress)
        return alignment
    if foreign:
        raise DatasetError(f"{source}: a mesh of one's own is not degraded further")
    mesh, back = degrade(load_mesh(source), quality, seed)
    templates, info = onboard(mesh, encoder, config, name=source.stem, progress=progress)
    # Its map back is written first: an object file without one would be of no use.
    write_text(path.with_suffix(".json"), json.dumps(alignment_as_json(back)))
    save(path, templates, dataclasses.replace(info, mesh_file=source.name))
    return _kept_alignment(path.with_suffix(".json"))


def _kept_alignment(path: Path) -> Alignment | None:
    return dataclasses.replace(read_alignment(path), source=OWN_MAP) if path.is_file() else None


ONBOARDING = ("ipjax.onboarding.mesh", "ipjax.rendering.child")  # the child runs in a process of its own
_BESIDE = (".mtl", ".bin", ".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ktx2")


def _key(
    source: Path,
    encoder: Encoder,
    config: OnboardConfig,
    quality: int,
    seed: int,
    *,
    hash_code: Callable[..., str] = hash_executed,
) -> str:
    """All that an object file hangs on, the code that makes it included, in sixteen digits."""
    parts = [
        __version__,
        FORMAT,
        hash_code(*ONBOARDING, *(["ipjax.synthetic.degradation"] if quality else [])),
        encoder.identity,
        describe_config(config),
        {path.name: hash_file(path) for path in _files_of(source)},
    ]
    if quality:
        parts += [quality, seed]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _files_of(source: Path) -> list[Path]:
    """A mesh file and the files beside it that it or its materials name, or that share its name."""
    around = [p for pattern in ("*", "*/*") for p in source.parent.glob(pattern) if p.suffix.lower() in _BESIDE]
    found, waiting = {source}, [source]
    while waiting:
        path = waiting.pop()
        text = path.read_bytes() if path.suffix.lower() in (".obj", ".gltf", ".mtl") else b""
        if path.suffix.lower() == ".ply":
            with open(path, "rb") as file:
                text = file.read(2**16)  # its header, where a texture is named
        for one in around:
            named = one.name.encode() in text or quote(one.name).encode() in text
            if one not in found and (named or (one.parent == source.parent and one.stem == source.stem)):
                found.add(one)
                waiting.append(one)
    return sorted(found)


def hash_code() -> str:
    """Sixteen digits of the source that an estimate hangs on, so that results of another state are not continued."""
    return hash_executed("ipjax.inference.estimator", also=("ipjax.bop.run", "ipjax.bop.dataset"))


class Finder:
    """An estimator for `evaluation.evaluate`: every target with a mask, each object compiled for once.

    Args:
        known: object files by number.
        encoder: made their features.
        config: of the estimate.
        crop: "square" or "look_at".
        seed: same seed, same answers.
        known_size: tell the estimate the object's true diameter.
        keep: also keep the `Result` of every target in ``results``, for pictures.
        share: keep the description of each target's crop (of the first few hundred) for those made by `beside`.
    """

    def __init__(
        self,
        known: Mapping[int, Known],
        encoder: Encoder,
        config: Config = Config(),
        *,
        crop: str = "square",
        seed: int = 0,
        known_size: bool = False,
        keep: bool = False,
        share: bool = False,
    ):
        self.known = dict(known)
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

    def beside(self, config: Config) -> "Finder":
        """The same with another configuration: objects are loaded once, and crops, whose descriptions hang on no
        setting of the estimate, are described once where this one was made to ``share``."""
        other = Finder(
            self.known,
            self.encoder,
            config,
            crop=self.crop,
            seed=self.seed,
            known_size=self.known_size,
            keep=self.keep,
        )
        other.described, other.order, other.estimator.objects = self.described, self.order, self.estimator.objects
        return other

    def settings(self) -> dict[str, Any]:
        """What the results depend on, as plain JSON; a resumed run must agree in it."""
        made = {}
        for obj_id in self.known:
            info = self.estimator.objects[self._index(obj_id)][1]
            made[str(obj_id)] = {
                "content": info.content_sha256,
                "mesh": info.mesh_sha256,
                "notes": list(info.notes),
                **_plain(info.config),
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
            if target.obj_id not in self.known:
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
            except ValueError as error:  # nothing to be seen there: a miss
                self.refused.append(f"{where}: {error}")
                continue
            seconds = time.perf_counter() - start
            info = self.estimator.objects[index][1]
            alignment = self.known[target.obj_id].alignment
            unit = info.metres_per_unit or MM if alignment is None else alignment.scale
            diameter = unit / info.mesh_scale if self.known_size else None
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
            pose = result.estimate.camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
            scale = float(pose.scale) if alignment is not None else float(pose.scale) / unit  # metres per metre of it
            score = target.score * float(result.estimate.confidence)
            found.append(Estimate(target.obj_id, score, pose.rotation, pose.translation, scale))
        return found

    def _index(self, obj_id: int) -> int:
        if obj_id not in self.order:
            self.order[obj_id] = len(self.estimator.objects)
            self.estimator.objects.append(load(self.known[obj_id].path, self.encoder))
        return self.order[obj_id]


def _plain(config: Any) -> dict[str, Any]:
    return {"onboarding": json.loads(json.dumps(config, default=str))} if config else {}


def parse_numbered(entries: Sequence[str] | None, what: str) -> dict[int, Path]:
    """``["5=mesh.obj"]`` as {5: Path("mesh.obj")}; ValueError names what is wrong."""
    found = {}
    for entry in entries or ():
        number, equals, name = entry.partition("=")
        if not equals or not number.strip().isdigit():
            raise ValueError(f"{what} {entry}: give OBJECT=FILE, for instance 5=mustard.obj")
        if not Path(name).is_file():
            raise ValueError(f"{what} {entry}: no such file")
        found[int(number)] = Path(name)
    return found


def alignments_of(known: Mapping[int, Known]) -> dict[int, Alignment]:
    """Those of the objects that have one, for `evaluation.evaluate`."""
    return {obj_id: one.alignment for obj_id, one in known.items() if one.alignment is not None}
