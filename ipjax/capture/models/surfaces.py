"""Surfaces of volumes: marching cubes, colours, and what is left out."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from ipjax.cameras import project
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.volume import Volume
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import Mesh, make_mesh


def extract(volume: Volume, *, least_weight: float = 0.5) -> Mesh:
    """The surface in world, where both sides of it were seen; holes stay where nothing was.

    Marching cubes (Lorensen and Cline 1987; Lewiner's tables, scikit-image).

    Args:
      least_weight: of a voxel: a frame that looks straight at it counts 1, another less.

    Raises:
      CaptureError: the volume has no surface, or its box is too large.
    """
    found, start = [], 0
    for chosen in volume.pieces():
        first, distance, weight, colour = volume.dense(chosen)
        piece = _march(distance, weight >= least_weight)
        if piece is None:
            continue
        vertices, faces = piece
        seen = [ndimage.map_coordinates(colour[..., k], vertices.T, order=1) for k in range(3)]
        points = (vertices + first) * volume.voxel @ volume.axes.T
        found.append((points, faces + start, np.clip(np.stack(seen, -1), 0, 255).round().astype(np.uint8)))
        start += len(points)
    if not found:
        raise CaptureError("no surface was found: the frames do not agree on any")
    points, faces, colours = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return make_mesh(points, faces, colours=colours)


def _march(distance: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices in voxels and faces, outwards; None where there is no surface."""
    from skimage.measure import marching_cubes

    if not (known & (distance < 0)).any() or not (known & (distance > 0)).any():
        return None
    vertices, faces, _, _ = marching_cubes(np.where(known, distance, 1.0), 0.0, allow_degenerate=False)
    # Every vertex lies on an edge of the grid; both of its ends must be known.
    ends = [tuple(f(vertices.round(4)).astype(int).T) for f in (np.floor, np.ceil)]
    good = known[ends[0]] & known[ends[1]]
    faces = faces[good[faces].all(1)]
    if not len(faces):
        return None
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)  # they turn to where the distance grows


def count_views(mesh: Mesh, frames: Sequence[PosedFrame], *, near: float, facing: float = 0.2) -> Int[np.ndarray, " n"]:
    """How many frames measured a surface at each vertex of a mesh in world, and looked at it from its front.

    Args:
      near: metres between the vertex and what was measured.
      facing: least cosine between normal and ray.
    """
    count = np.zeros(len(mesh.vertices), int)
    for frame in frames:
        pose = frame.camera_from_world
        points = pose @ mesh.vertices
        column, row = np.rint(project(frame.camera, points)).astype(int).T
        width, height = frame.size
        inside = (points[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = np.where(inside, column, 0), np.where(inside, row, 0)
        towards = -((mesh.normals @ pose.rotation.T) * points).sum(-1) / np.linalg.norm(points, axis=-1)
        known = inside & frame.usable[row, column] & (frame.depth[row, column] > 0) & (towards > facing)
        count += known & (np.abs(frame.depth[row, column] - points[:, 2]) < near)
    return count


def cut(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The mesh of chosen faces.

    Raises:
      ValueError: no face is chosen.
    """
    faces = mesh.faces[keep]
    used, inverse = np.unique(faces, return_inverse=True)
    return make_mesh(
        mesh.vertices[used],
        inverse.reshape(-1, 3),
        colours=mesh.colours[used],
        normals=mesh.normals[used],
        seen=mesh.seen[used],
    )


def number_pieces(count: int, faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, " n"]:
    """The connected piece of every vertex."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    graph = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    return csgraph.connected_components(graph, directed=False)[1]
