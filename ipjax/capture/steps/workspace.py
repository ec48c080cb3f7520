"""The folder of work: what steps left there, what they were made of, and whether it is still whole.

::

    DATASET.work/steps/NAME.json   of each finished step: made_of, outputs (sha256 of every file), what it says
    DATASET.work/steps/log.jsonl   when which step was made, why, and how long it took; the only file that differs
                                   between two runs over the same capture
"""

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipjax.capture.records import Capture
from ipjax.capture.steps.records import Figure, Job, Outcome, Step
from ipjax.files.provenance import hash_executed
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text

FORMAT, VERSION = "ipjax step", 1
STEPS = "steps"  # the folder of records
LOG = "log.jsonl"
# Of a capture: images, cameras and poses. A page or a film beside them is no input.
_KINDS = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".exr", ".npy", ".npz"}
_KINDS |= {".json", ".txt", ".yaml", ".yml", ".csv", ".gz"}


@dataclasses.dataclass(frozen=True)
class Record:
    """A finished step."""

    made_of: dict[str, Any]  # code, settings, capture, inputs
    outputs: dict[str, str]  # file, relative to the folder of work: sha256
    outcome: Outcome
    found: bool = False  # it was there already and taken as it was


def hash_file(path: Path) -> str:
    """The sha256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_json(value: Any) -> str:
    """Sixteen digits that are others whenever the value is."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def hash_capture(capture: Capture, without: Sequence[Path] = ()) -> str:
    """Sixteen digits that are others whenever the capture's files are, or how they are read.

    Args:
      without: folders in it that are not part of it.
    """
    left_out = {str(path.resolve()) for path in without}
    files = []
    for folder, names, found in os.walk(capture.folder):
        names[:] = sorted(
            name for name in names if name[0] != "." and str(Path(folder, name).resolve()) not in left_out
        )
        for name in found:
            path = Path(folder, name)
            if name[0] != "." and path.suffix.lower() in _KINDS and path.is_file():
                files.append([path.relative_to(capture.folder).as_posix(), hash_file(path)])
    read = [capture.form, capture.names, capture.size, capture.camera.to_matrix().tolist(), capture.depth_size]
    if capture.depth_camera is not None:
        read.append(capture.depth_camera.to_matrix().tolist())
    for pose in (capture.colour_from_depth, capture.world_from_camera):
        read.append(None if pose is None else pose.to_matrix().tolist())
    return hash_json([sorted(files), read])


def list_files(work: Path, names: Iterable[str]) -> list[str]:
    """The files that these names mean, a folder's at any depth, relative to the folder of work."""
    found = []
    for name in names:
        path = work / name
        if path.is_dir():
            found += [f"{name}/{one.relative_to(path).as_posix()}" for one in path.rglob("*") if one.is_file()]
        elif path.is_file():
            found.append(name)
    return sorted(found)


def describe_inputs(step: Step, job: Job, capture: str, records: Mapping[str, Record], steps: Sequence[Step]) -> dict:
    """What a step is made of, as its record keeps it.

    Args:
      capture: its hash.
      records: of the steps before.
    """
    results = {one.name: (*one.results, *one.sometimes) for one in steps}
    inputs = {}
    for name in step.needs:
        if name in records:
            told = records[name].outputs.items()
            mine = [[file, digest] for file, digest in told if _is_of(file, results[name])]
            inputs[name] = hash_json(mine)
    settings = json.loads(json.dumps(dict(step.choose(job.settings))))
    return {"code": hash_executed(*step.modules), "settings": settings, "capture": capture, "inputs": inputs}


def _is_of(file: str, names: Sequence[str]) -> bool:
    return any(file == name or file.startswith(f"{name}/") for name in names)


def find_reason(step: Step, record: Record | None, made_of: Mapping[str, Any], work: Path) -> str | None:
    """Why a step is to be made again, in words; None = it is not."""
    if record is None:
        return "it was not made yet"
    old = record.made_of
    if old.get("capture") != made_of["capture"]:
        return "the capture changed"
    if old.get("settings") != made_of["settings"]:
        before, now = old.get("settings") or {}, made_of["settings"]
        names = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
        return f"its settings changed ({', '.join(names)})"
    for name, digest in made_of["inputs"].items():
        if old.get("inputs", {}).get(name) != digest:
            return f"what the step {name} made changed"
    if old.get("inputs") != made_of["inputs"]:
        return "the steps before it changed"
    if old.get("code") != made_of["code"]:
        return "its code changed"
    for name, digest in record.outputs.items():
        path = work / name
        if not path.is_file():
            return f"{name} is missing"
        if hash_file(path) != digest:
            return f"{name} was changed"
    return None


def record_path(work: Path, name: str) -> Path:
    """The file of a step's record."""
    return work / STEPS / f"{name}.json"


def read_record(work: Path, name: str) -> Record | None:
    """The record of a finished step; None where there is none that can be used."""
    try:
        document = read_json(record_path(work, name))
        if document["format"] != FORMAT or document["version"] != VERSION:
            return None
        told = document["outcome"]
        outcome = Outcome(
            outputs=tuple(told["outputs"]),
            figures=tuple(Figure(**one) for one in told["figures"]),
            notes=tuple(told["notes"]),
            warnings=tuple(told["warnings"]),
            stop=told["stop"],
        )
        return Record(dict(document["made_of"]), dict(document["outputs"]), outcome, bool(document["found"]))
    except (KeyError, TypeError, ValueError):
        return None


def write_record(work: Path, name: str, record: Record) -> None:
    """Write a step's record, whole or not at all; with it the step is finished. Raises OSError."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "step": name,
        "found": record.found,
        "made_of": record.made_of,
        "outcome": dataclasses.asdict(record.outcome),
        "outputs": record.outputs,
    }
    write_text(record_path(work, name), json.dumps(document, indent=1, allow_nan=False) + "\n", parents=True)


def begin(work: Path, step: Step, made_of: Mapping[str, Any]) -> None:
    """Mark a step as begun. Where it would go on with files of other inputs, or of a finished run that is not whole any
    more, these are removed; those of a run that was killed stay. Raises OSError.
    """
    forget(work, [step.name])  # from now on its files may be mixed
    if not step.continues:
        return
    mark, text = work / STEPS / f"{step.name}.begun", hash_json(made_of)
    if not mark.is_file() or mark.read_text() != text:
        for name in step.files:
            remove(work / name)
        write_text(mark, text, parents=True)


def finish(work: Path, step: Step, record: Record) -> None:
    """Mark a step as finished: write its record, and remove what it did not write this time. Raises OSError."""
    for name in {*step.files} - {*record.outcome.outputs}:
        remove(work / name)
    # First the mark: with the record the step is kept, and a mark that a kill left would stay.
    (work / STEPS / f"{step.name}.begun").unlink(missing_ok=True)
    write_record(work, step.name, record)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def forget(work: Path, names: Iterable[str]) -> None:
    """Remove records, so that these steps are made again."""
    for name in names:
        record_path(work, name).unlink(missing_ok=True)


def remove_unfinished(work: Path, dataset: Path) -> None:
    """Remove what a killed run was writing; for whoever holds the folder's lock."""
    left = list(work.rglob(".*.part*"))  # a step that continues writes file by file, also into folders
    left += list(dataset.parent.glob(f".{dataset.name}.*.part"))
    for path in left:
        remove(path)
