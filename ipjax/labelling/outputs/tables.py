"""Labels as a table with a row for each pose: Parquet where pyarrow is installed, else NumPy's npz.

Columns: frame, scene, image, number, object, slot, present, confidence, margin, diameter_m, diameter_std_m, overlap,
pose (16 numbers, ``camera_from_mesh`` row by row, metres), covariance (36 numbers, rotation vector in rad and
translation in m, camera axes), box (x, y, width, height), size (height, width). Masks are in coco.json.
"""

import importlib.util
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.storage.writing import writing
from ipjax.labelling.entries import Entry

_WIDE = {"pose": 16, "covariance": 36, "box": 4, "size": 2}


def has_parquet() -> bool:
    """Whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def as_columns(entries: Iterable[Entry], names: Mapping[int, str]) -> dict[str, np.ndarray]:
    """The poses of frames, in their order, as columns."""
    rows = [(entry, one) for entry in entries for one in entry["instances"] if one["success"]]
    pick = lambda make, dtype: np.array([make(entry, one) for entry, one in rows], dtype)
    nan = float("nan")
    columns = {
        "frame": pick(lambda entry, one: entry["name"], str),
        "scene": pick(lambda entry, one: entry["scene"], np.int64),
        "image": pick(lambda entry, one: entry["image"], np.int64),
        "number": pick(lambda entry, one: one["number"], np.int64),
        "object": pick(lambda entry, one: names[one["number"]], str),
        "slot": pick(lambda entry, one: one["slot"], np.int64),
        "present": pick(lambda entry, one: one["present"], bool),
        "confidence": pick(lambda entry, one: one["confidence"], np.float64),
        "margin": pick(lambda entry, one: one["margin"], np.float64),
        "diameter_m": pick(lambda entry, one: one["diameter"], np.float64),
        "diameter_std_m": pick(lambda entry, one: one["diameter_std"], np.float64),
        "overlap": pick(lambda entry, one: nan if one["overlap"] is None else one["overlap"], np.float64),
        "pose": pick(lambda entry, one: one["camera_from_mesh"], np.float64),
        "covariance": pick(lambda entry, one: one["covariance"], np.float64),
        "box": pick(lambda entry, one: one["box"], np.int64),
        "size": pick(lambda entry, one: entry["size"], np.int64),
    }
    return {name: column.reshape(-1, _WIDE[name]) if name in _WIDE else column for name, column in columns.items()}


def write_table(stem: Path, parts: Iterable[Mapping[str, np.ndarray]], *, parquet: bool) -> Path:
    """Write columns as ``STEM.parquet``, a row group for each part, or as ``STEM.npz``; whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    return (
        _write_parquet(stem.with_suffix(".parquet"), parts) if parquet else _write_npz(stem.with_suffix(".npz"), parts)
    )


def _write_npz(path: Path, parts: Iterable[Mapping[str, np.ndarray]]) -> Path:
    found: Sequence[Mapping[str, np.ndarray]] = list(parts)
    columns = {name: np.concatenate([part[name] for part in found]) for name in found[0]} if found else {}
    with writing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **columns)
    return path


def _write_parquet(path: Path, parts: Iterable[Mapping[str, np.ndarray]]) -> Path:
    import pyarrow
    from pyarrow import parquet

    def as_table(columns: Mapping[str, np.ndarray]) -> Any:
        arrays = {}
        for name, column in columns.items():
            flat = pyarrow.array(column.reshape(-1))
            flat = flat.cast(pyarrow.string()) if column.dtype.kind == "U" else flat
            wide = _WIDE.get(name)
            arrays[name] = flat if wide is None else pyarrow.FixedSizeListArray.from_arrays(flat, wide)
        return pyarrow.table(arrays)

    with writing(path) as temporary:
        writer = None
        try:
            for part in parts:
                table = as_table(part)
                writer = writer or parquet.ParquetWriter(temporary, table.schema, compression="zstd")
                writer.write_table(table)
        finally:
            if writer is not None:
                writer.close()
    return path
