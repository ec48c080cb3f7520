"""Models on disc: what the step that makes models hands to the one that labels.

::

    models.json                  format, version, made_of; objects: name, file, world_from_model (4 × 4), symmetries;
                                 support_from_world; notes
    NAME.ply, NAME_points.ply    coloured mesh, and its measured vertices with normals; metres, the model's own frame
    scene.ply, scene_points.ply  the whole scene, in world
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.models.making import ObjectModel, SceneModels
from ipjax.capture.models.symmetries import Symmetries
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.saving import save_mesh, save_points
from ipjax.files.storage.folders import writing_folder
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text
from ipjax.transforms import Similarity

FORMAT, VERSION = "ipjax models", 1
LIST = "models.json"


def write_models(folder: str | Path, models: SceneModels, made_of: str = "") -> Path:
    """Write models as a folder, whole or not at all; models that are there give way.

    Args:
      made_of: a word for all that they were made of, by which another run knows that they need not be made again.

    Raises:
      CaptureError: `check_place` says that the folder holds something else.
      OSError: it cannot be written.
    """
    check_place(folder)
    with writing_folder(folder, replace=True) as inside:
        entries = []
        for item, stem in zip(models.objects, _choose_stems([item.name for item in models.objects]), strict=True):
            save_mesh(item.mesh, inside / f"{stem}.ply")
            seen = item.mesh.seen > 0
            save_points(
                inside / f"{stem}_points.ply",
                item.mesh.vertices[seen],
                item.mesh.normals[seen],
                item.mesh.colours[seen],
            )
            entries.append(
                {
                    "name": item.name,
                    "file": f"{stem}.ply",
                    "world_from_model": item.world_from_model.to_matrix().tolist(),
                    "symmetries_discrete": [matrix.tolist() for matrix in item.symmetries.discrete],
                    "symmetries_continuous": [
                        {"axis": axis.tolist(), "offset": offset.tolist()}
                        for axis, offset in item.symmetries.continuous
                    ],
                }
            )
        scene = models.scene
        save_mesh(scene, inside / "scene.ply")
        save_points(inside / "scene_points.ply", scene.vertices, scene.normals, scene.colours)
        document = {
            "format": FORMAT,
            "version": VERSION,
            "made_of": made_of,
            "objects": entries,
            "support_from_world": models.support.support_from_world.to_matrix().tolist(),
            "notes": list(models.notes),
        }
        write_text(inside / LIST, json.dumps(document, indent=1))
    return Path(folder)


def check_place(folder: str | Path) -> None:
    """Refuse to write models in place of anything but models. Raises CaptureError."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise CaptureError(f"{folder}: a file of this name is in the way")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / LIST).is_file():
        raise CaptureError(
            f"{folder}: it is there, and has no models of ipjax capture; it is not replaced: give another folder"
        )


def read_models(folder: str | Path) -> tuple[ObjectModel, ...]:
    """The objects that `write_models` wrote.

    Raises:
      CaptureError: they are not there, or damaged.
    """
    folder = Path(folder)
    document = _read(folder)
    try:
        return tuple(_parse(folder, entry) for entry in document["objects"])
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(
            f"{folder}: its models are damaged ({error}); make them again with ipjax capture model"
        ) from None


def read_made_of(folder: str | Path) -> str | None:
    """What `write_models` was told that the models are made of; None where there are none that can be used."""
    try:
        return str(_read(Path(folder)).get("made_of"))
    except CaptureError:
        return None


def _read(folder: Path) -> dict[str, Any]:
    try:
        document = read_json(folder / LIST, "list of models")
    except ValueError as error:
        raise CaptureError(f"{error}; make the models with ipjax capture model") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise CaptureError(
            f"{folder / LIST}: it is no list of models of this version; make it with ipjax capture model"
        )
    return document


def _parse(folder: Path, entry: dict[str, Any]) -> ObjectModel:
    pose = Similarity[np.ndarray].from_matrix(np.asarray(entry["world_from_model"], np.float64))
    symmetries = Symmetries(
        tuple(np.asarray(matrix, np.float64).reshape(4, 4) for matrix in entry["symmetries_discrete"]),
        tuple(
            (np.asarray(item["axis"], np.float64), np.asarray(item["offset"], np.float64))
            for item in entry["symmetries_continuous"]
        ),
    )
    name = Path(str(entry["file"])).name
    return ObjectModel(str(entry["name"]), load_mesh(folder / name), pose, symmetries)


def _choose_stems(names: Sequence[str]) -> list[str]:
    """Names of files for objects of these names: no two alike, and none that of the scene."""
    taken, chosen = {"scene", "scene_points"}, []
    for name in names:
        stem = file_name(name)
        while {stem, f"{stem}_points"} & taken:
            stem += "_"
        taken |= {stem, f"{stem}_points"}
        chosen.append(stem)
    return chosen


def file_name(name: str) -> str:
    """A name as a file may have it."""
    return re.sub(r"[^\w.-]+", "_", name).strip(".") or "object"
