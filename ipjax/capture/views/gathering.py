"""The models that are to be arranged, in metres, from whatever form they come in."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.models.making import ObjectModel
from ipjax.capture.models.storing import LIST, read_models
from ipjax.capture.models.symmetries import Symmetries, find_symmetries
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.loading import FORMATS, load_mesh
from ipjax.files.meshes.mesh import Mesh, make_mesh, move
from ipjax.files.objects.loading import load
from ipjax.files.storage.parsing import read_json
from ipjax.transforms import Similarity

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}


def gather_models(paths: Sequence[str | Path], unit: str = "m") -> list[ObjectModel]:
    """The models of folders and files, each in metres and a frame of its own.

    Args:
      paths: a folder that `ipjax capture model` made; a folder of models of a BOP data set (millimetres); mesh files;
        object files of `ipjax onboard` whose size is known.
      unit: of mesh files that are given by name.

    Raises:
      CaptureError: one of them is nothing of that kind, or of no known size; names it.
    """
    found: list[ObjectModel] = []
    for path in map(Path, paths):
        try:
            if path.is_dir():
                found += _read_folder(path)
            elif path.suffix.lower() == ".ipjax":
                found.append(_read_object(path))
            elif path.suffix.lower() in FORMATS:
                found.append(_describe(path.stem, move(load_mesh(path), np.eye(3), scale=UNITS[unit])))
            else:
                raise CaptureError(
                    f"{path}: it is no folder of models, no mesh ({', '.join(FORMATS)}) and no object file (.ipjax)"
                )
        except CaptureError:
            raise
        except (ValueError, OSError) as error:
            text = str(error)
            raise CaptureError(text if str(path) in text else f"{path}: {text}") from None
    return found


def _read_folder(folder: Path) -> list[ObjectModel]:
    if (folder / LIST).is_file():
        return list(read_models(folder))
    infos = folder / "models_info.json"
    if not infos.is_file():
        raise CaptureError(f"{folder}: it has neither {LIST}, of ipjax capture model, nor models_info.json, of BOP")
    try:
        return _read_bop(folder, read_json(infos))
    except (AttributeError, KeyError, TypeError) as error:
        raise CaptureError(f"{infos}: it is not as BOP has it ({error}): a dictionary of each object's") from None


def _read_bop(folder: Path, infos: Any) -> list[ObjectModel]:
    found = []
    for key, info in sorted(infos.items(), key=lambda item: int(item[0])):
        mesh = move(load_mesh(folder / f"obj_{int(key):06d}.ply"), np.eye(3), scale=0.001)
        discrete = [np.asarray(m, np.float64).reshape(4, 4).copy() for m in info.get("symmetries_discrete", ())]
        for matrix in discrete:
            matrix[:3, 3] /= 1000
        continuous = [
            (np.asarray(item["axis"], np.float64), np.asarray(item["offset"], np.float64) / 1000)
            for item in info.get("symmetries_continuous", ())
        ]
        found.append(_place(f"obj_{int(key):06d}", mesh, Symmetries(tuple(discrete), tuple(continuous))))
    return found


def _read_object(path: Path) -> ObjectModel:
    info = load(path)[1]
    if info.vertices is None or info.faces is None:
        raise CaptureError(f"{path}: it keeps no mesh; give the mesh that it was made of")
    if info.metres_per_unit is None:
        raise CaptureError(f"{path}: its size is not known; onboard it with --unit, or give its mesh and the --unit")
    scale = info.metres_per_unit / info.mesh_scale
    return _describe(info.name, make_mesh(scale * np.asarray(info.vertices), info.faces, colours=info.colours))


def _describe(name: str, mesh: Mesh) -> ObjectModel:
    return _place(name, mesh, find_symmetries(mesh))


def _place(name: str, mesh: Mesh, symmetries: Symmetries) -> ObjectModel:
    return ObjectModel(name, mesh, Similarity(np.eye(3), np.zeros(3), np.ones(())), symmetries)
