"""The objects of a data set, onboarded or taken from where they are kept."""

import dataclasses
import hashlib
import json
import logging
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ipjax import __version__
from ipjax.bop.alignments import read_alignment
from ipjax.bop.dataset import Dataset
from ipjax.bop.records import MM, DatasetError
from ipjax.config import OnboardConfig
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.objects.layout import FORMAT
from ipjax.files.objects.saving import save
from ipjax.files.provenance import hash_executed
from ipjax.files.settings import describe_config
from ipjax.files.storage.cache import cache_folder
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.hashes import hash_file
from ipjax.networks.dinov2 import Encoder
from ipjax.onboarding.mesh import onboard
from ipjax.synthetic.degradation import alignment_as_json, degrade
from ipjax.transforms import Similarity

log = logging.getLogger("ipjax")

OWN_MAP = "the degradation's own map"
ONBOARDING = ("ipjax.onboarding.mesh", "ipjax.rendering.child")  # the child runs in a process of its own
MESH_FILES = (".mtl", ".bin", ".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ktx2")  # named by a mesh


@dataclasses.dataclass(frozen=True)
class OnboardedObject:
    """The object file of a data set's object, and how its mesh lies in the annotated model's frame."""

    obj_id: int
    path: Path
    model_from_mesh: Similarity[np.ndarray] | None = None  # None: the mesh is the model itself, in millimetres
    aligned_by: str = ""  # where that comes from


def prepare_objects(
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
) -> dict[int, OnboardedObject]:
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
    existing: dict[int, Path] = {}
    if folder is not None:
        folder = Path(folder) / f"quality_{quality}" if quality else Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(folder.glob("*.ipjax")):
            if number := re.search(r"(\d+)$", path.stem):
                existing[int(number[1])] = path
    found = {}
    for count, obj_id in enumerate(sorted(wanted)):
        source = Path(meshes[obj_id]) if obj_id in meshes else dataset.model_path(obj_id, "models")
        alignment = read_alignment(alignments[obj_id]) if obj_id in alignments else None
        key = hash_origin(source, encoder, config, quality=quality, seed=seed)
        if folder is not None and obj_id in meshes:  # the file with its number is of the model
            path = folder / "meshes" / f"obj_{obj_id:06d}_{key}.ipjax"
        elif folder is None:
            path = cache_folder("objects") / f"{source.stem}_{key}.ipjax"
        else:
            path = existing.get(obj_id, folder / f"obj_{obj_id:06d}.ipjax")
        if quality and alignment is None:
            alignment = _read_kept(path.with_suffix(".json"))
        if not path.is_file() or (quality and alignment is None):
            start = time.perf_counter()
            path.parent.mkdir(parents=True, exist_ok=True)
            alignment = _onboard(source, path, encoder, config, quality, seed, obj_id in meshes, alignment, progress)
            seconds = time.perf_counter() - start
            log.info("object %d of %d: %s onboarded in %.0f s", count + 1, len(wanted), source.name, seconds)
            if progress:
                print(f"{count + 1} of {len(wanted)}: {source.name} onboarded in {seconds:.0f} s", flush=True)
        aligned_by = Path(alignments[obj_id]).name if obj_id in alignments else OWN_MAP
        found[obj_id] = OnboardedObject(obj_id, path, alignment, "" if alignment is None else aligned_by)
    return found


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


def hash_origin(
    source: Path,
    encoder: Encoder,
    config: OnboardConfig,
    *,
    quality: int,
    seed: int,
    hash_code: Callable[..., str] = hash_executed,
) -> str:
    """A hash (16 digits) of everything that an object file depends on: mesh, encoder, settings and code."""
    parts = [
        __version__,
        FORMAT,
        hash_code(*ONBOARDING, *(["ipjax.synthetic.degradation"] if quality else [])),
        encoder.identity,
        describe_config(config),
        {path.name: hash_file(path) for path in _list_files(source)},
    ]
    if quality:
        parts += [quality, seed]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _onboard(
    source: Path,
    path: Path,
    encoder: Encoder,
    config: OnboardConfig,
    quality: int,
    seed: int,
    foreign: bool,
    alignment: Similarity[np.ndarray] | None,
    progress: bool,
) -> Similarity[np.ndarray] | None:
    if not quality:
        unit = None if foreign else MM
        onboard(source, encoder, config, out=path, metres_per_unit=unit, progress=progress)
        return alignment
    if foreign:
        raise DatasetError(f"{source}: a mesh of one's own is not degraded further")
    mesh, back = degrade(load_mesh(source), quality, seed)
    templates, info = onboard(mesh, encoder, config, name=source.stem, progress=progress)
    # The alignment is written first: an object file without one could not be scored.
    write_text(path.with_suffix(".json"), json.dumps(alignment_as_json(back)))
    save(path, templates, dataclasses.replace(info, mesh_file=source.name))
    return _read_kept(path.with_suffix(".json"))


def _read_kept(path: Path) -> Similarity[np.ndarray] | None:
    return read_alignment(path) if path.is_file() else None


def _list_files(source: Path) -> list[Path]:
    """A mesh file and the files in its folder that it or its materials name, or that share its name."""
    around = [p for pattern in ("*", "*/*") for p in source.parent.glob(pattern) if p.suffix.lower() in MESH_FILES]
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
