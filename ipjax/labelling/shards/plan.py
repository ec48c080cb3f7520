"""Which frames are which shard, and the manifest: what is labelled, of what, by which code, weights and settings."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ipjax import __version__
from ipjax.bop.journal import list_differences
from ipjax.config import Config
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.provenance import hash_executed
from ipjax.files.settings import describe_config
from ipjax.files.storage.locks import locked
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.hashes import hash_file
from ipjax.labelling.records import LabelSettings
from ipjax.labelling.sources.records import FrameKey, Source, SourceError, hash_keys, hash_plain

FORMAT = "ipjax labels 1"
MANIFEST = "manifest.json"
SHARDS, WORK, LOGS = "shards", "work", "logs"  # folders: finished, begun, and what may differ from run to run
# Of the settings those on which no answer depends but by rounding.
_FREE = ("threads", "buckets")
# What makes labels of frames, and what reads the frames.
CODE = (
    "ipjax.labelling.batch",
    "ipjax.labelling.shards.working",
    "ipjax.labelling.sources.opening",
    "ipjax.labelling.sources.detections",
)
_NEEDED = ("objects", "frames", "shard_size", "shards")  # of a manifest, for merging


@dataclasses.dataclass(frozen=True)
class Shard:
    """Consecutive frames of a source."""

    index: int
    start: int
    stop: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.index:06d}"


@dataclasses.dataclass(frozen=True)
class LabelledObject:
    """An object that is labelled: its file and its number in what is written."""

    number: int
    path: Path
    info: ObjectInfo


def plan_shards(count: int, size: int) -> list[Shard]:
    """``count`` frames in shards of ``size``, the last one smaller."""
    if size < 1:
        raise ValueError(f"a shard has at least one frame, not {size}")
    return [Shard(index, start, min(start + size, count)) for index, start in enumerate(range(0, max(count, 0), size))]


def make_manifest(
    source: Source,
    keys: Sequence[FrameKey],
    objects: Sequence[LabelledObject],
    encoder: Any,
    config: Config,
    *,
    settings: LabelSettings,
    shard_size: int,
    batch: int,
    previews: int,
    detections: Path | None = None,
) -> dict[str, Any]:
    """What the labels depend on, as plain JSON; and where the source and the objects lie, on which they do not.

    Args:
        batch: frames that are labelled at a time.
        previews: every so many-th frame is drawn; 0 = none.
        detections: the file of masks that were used, or the folder of such.
    """
    plan = plan_shards(len(keys), shard_size)
    fields = {f.name: getattr(settings, f.name) for f in dataclasses.fields(settings) if f.name not in _FREE}
    made = {
        "format": FORMAT,
        "version": __version__,
        "code": hash_executed(*CODE),
        "source": {"kind": source.kind, "path": str(source.path), **source.identity()},
        "detections": None if detections is None else {"path": str(detections), **_hash_detections(detections)},
        "encoder": str(getattr(encoder, "identity", "unnamed")),
        "objects": [
            {"number": one.number, "name": one.info.name, "path": str(one.path), "sha256": hash_file(one.path)}
            for one in objects
        ],
        "config": describe_config(config),
        "settings": {name: describe_config(value) for name, value in fields.items()},
        "batch": batch,
        "previews": previews,
        "frames": len(keys),
        "shard_size": shard_size,
        "shards": [hash_keys(keys[shard.start : shard.stop]) for shard in plan],
    }
    return json.loads(json.dumps(made))


def keep_manifest(folder: Path, manifest: Mapping[str, Any], *, restart: bool = False) -> None:
    """Write the manifest into the folder of labels, or check that it is that of the labels that are there.

    Raises:
        ValueError: the labels there were made of something else, or otherwise; names what differs.
    """
    path = folder / MANIFEST
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / ".lock"):
        if path.is_file() and not restart:
            differs = list_differences(_essential(read_manifest(folder)), _essential(manifest))
            if differs:
                named = ", ".join(differs[:4]) + (" …" if len(differs) > 4 else "")
                raise ValueError(
                    f"{folder}: the labels in it were made with something else ({named}); choose another folder, or "
                    "--restart"
                )
            return
        write_text(path, json.dumps(manifest, indent=1) + "\n")


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a folder of labels.

    Raises:
        ValueError: there is none, or none of this format, or it is damaged.
    """
    manifest = read_json(folder / MANIFEST, "manifest of labels")
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{folder / MANIFEST}: no manifest of the format {FORMAT!r}")
    missing = [name for name in _NEEDED if name not in manifest]
    if missing:
        raise ValueError(f"{folder / MANIFEST}: damaged: it has no {missing[0]}")
    return manifest


def check_source(manifest: Mapping[str, Any], source: Source, keys: Sequence[FrameKey]) -> None:
    """Refuse a source that is not the one of the manifest. Raises SourceError."""
    plan = plan_shards(len(keys), manifest["shard_size"])
    hashes = [hash_keys(keys[shard.start : shard.stop]) for shard in plan]
    if hashes != manifest["shards"]:
        raise SourceError(f"{source.path}: its frames are not those that were labelled")


def _hash_detections(path: Path) -> dict[str, Any]:
    """The content of a file of masks, or of every file of a folder of such."""
    if not path.is_dir():
        return {"sha256": hash_file(path)}
    return {"files": hash_plain({file.name: hash_file(file) for file in path.glob("*.npz")})}


def _essential(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest without the places of files."""

    def stripped(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: stripped(one) for name, one in value.items() if name != "path"}
        return [stripped(one) for one in value] if isinstance(value, list) else value

    return stripped(dict(manifest))
