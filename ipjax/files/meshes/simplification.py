"""Meshes of fewer faces, for outlines and pictures."""

import numpy as np


def simplify(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None, most: int = 60_000):
    """A coarser mesh, for outlines: vertices in one cell of a grid are merged, until few enough faces remain."""
    vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError("faces of the mesh refer to vertices that do not exist")
    if colours is not None and len(colours) != len(vertices):
        raise ValueError(f"the mesh has {len(vertices)} vertices but {len(colours)} colours")
    cells = 192.0
    original = (vertices, faces, colours)
    while len(faces) > most and cells >= 24:
        vertices, faces, colours = original
        key = np.floor(vertices * cells).astype(np.int64)
        _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
        index = index.reshape(-1)
        count = np.bincount(index).astype(np.float32)
        vertices = np.stack([np.bincount(index, weights=vertices[:, k]) / count for k in range(3)], axis=-1)
        colours = None if colours is None else np.asarray(colours)[first]
        faces = index[faces]
        real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = np.unique(faces[real], axis=0)
        cells *= 0.75
    return vertices.astype(np.float32), faces.astype(np.int32), colours
