"""Reading mesh files: OBJ, PLY, GLB, glTF, STL."""

import dataclasses
import struct
import warnings
from pathlib import Path

import numpy as np

from ipjax.files.meshes.formats.gltf import read_gltf
from ipjax.files.meshes.formats.obj import read_obj
from ipjax.files.meshes.formats.ply import read_ply
from ipjax.files.meshes.formats.source import MAX_BYTES, Source
from ipjax.files.meshes.formats.stl import read_stl
from ipjax.files.meshes.joining import join
from ipjax.files.meshes.mesh import Mesh, make_mesh

READERS = {".obj": read_obj, ".ply": read_ply, ".glb": read_gltf, ".gltf": read_gltf, ".stl": read_stl}
FORMATS = tuple(READERS)


def load_mesh(path: str | Path) -> Mesh:
    """Read an OBJ, PLY, GLB, glTF or STL file: scene graphs are baked, colours kept in whatever form they come.

    The mesh stays in its file's frame and units. Files that it names (textures, buffers) must lie in its own folder
    or below. Raises ValueError in one sentence for anything that is not a usable mesh; FileNotFoundError for none.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no mesh file at {path}")
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise ValueError(f"{path.name}: {kind or 'no extension'} is not a mesh format read here ({', '.join(FORMATS)})")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path.name} is {size / 1e9:.1f} GB; simplify the mesh first")
    source = Source(path)
    try:
        parts = [part for part in READERS[kind](source) if len(part.faces)]
        if not parts:
            raise ValueError("the mesh is empty: it has no faces (a point cloud must be meshed first)")
        joined = join(parts, source)
        count = len(parts)
        del parts
        mesh = make_mesh(joined.vertices, joined.faces, colours=joined.colours, uv=joined.uv, texture=joined.texture)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
    except (KeyError, IndexError, TypeError, OverflowError, AttributeError, RecursionError, struct.error) as error:
        raise ValueError(f"{path.name} cannot be read as {kind[1:].upper()}: {type(error).__name__}: {error}") from None
    notes = [f"{path.name}: {count} part{'s' if count > 1 else ''}", *source.notes, *source.warnings, joined.note]
    for sentence in source.warnings:
        warnings.warn(f"{path.name}: {sentence}", stacklevel=2)
    up = "Y up by the format's convention" if kind in (".glb", ".gltf") else "no up axis is defined by the format"
    extent = ", ".join(f"{x:.4g}" for x in np.ptp(mesh.vertices, axis=0))
    notes.append(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces, extents {extent}; {up}")
    return dataclasses.replace(mesh, notes=tuple(notes))
