"""A piece of surface made a model: loose bits dropped, its foot brought down to the support, a frame of its own."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ipjax.capture.models.support import Support
from ipjax.capture.models.surfaces import cut, number_pieces
from ipjax.files.meshes.mesh import Mesh, corner_products, make_mesh, vertex_normals
from ipjax.transforms import Similarity

_LOOSE = 0.004  # of the surface: smaller pieces that hang nowhere are noise


def drop_loose(mesh: Mesh, share: float = _LOOSE) -> Mesh:
    """Without pieces that have less than this share of the surface; the largest stays always."""
    piece = number_pieces(len(mesh.vertices), mesh.faces)[mesh.faces[:, 0]]
    area = np.bincount(piece, np.linalg.norm(corner_products(mesh.vertices, mesh.faces), axis=-1))
    large = area >= min(share * area.sum(), area.max())
    return mesh if large[piece].all() else cut(mesh, large[piece])


def stand(mesh: Mesh, support: Support, near: float) -> Mesh:
    """The mesh with walls from its lower rim straight down to the support, where it was cut off or not measured.

    What is new is marked as not seen.

    Args:
      near: metres above the support within which a border of the mesh is its foot.
    """
    rim = find_rim(mesh.faces)
    height = support.heights(mesh.vertices)
    rim = rim[(height[rim] < near).all(1)]
    if not len(rim):
        return mesh
    used, inverse = np.unique(rim, return_inverse=True)
    rim_new = inverse.reshape(-1, 2) + len(mesh.vertices)
    down = support.axes[:, 2]
    feet = mesh.vertices[used] - np.maximum(height[used], 0)[:, None] * down
    a, b = rim.T
    low_a, low_b = rim_new.T
    walls = np.concatenate([np.stack([b, a, low_a], -1), np.stack([b, low_a, low_b], -1)])
    vertices, faces = np.concatenate([mesh.vertices, feet]), np.concatenate([mesh.faces, walls])
    return make_mesh(
        vertices,
        faces,
        colours=np.concatenate([mesh.colours, mesh.colours[used]]),
        normals=np.concatenate([mesh.normals, vertex_normals(vertices, faces)[len(mesh.vertices) :]]),
        seen=np.concatenate([mesh.seen, np.zeros(len(used))]),
    )


def close_bottom(mesh: Mesh, support: Support, near: float) -> Mesh:
    """The mesh with a floor on the support: every ring of its lower rim is filled by a fan; marked as not seen."""
    rim = find_rim(mesh.faces)
    rim = rim[(support.heights(mesh.vertices)[rim] < near).all(1)]
    if not len(rim):
        return mesh
    ring = number_pieces(len(mesh.vertices), np.concatenate([rim, rim[:, :1]], axis=1))
    vertices, faces, colours, seen = [mesh.vertices], [mesh.faces], [mesh.colours], [mesh.seen]
    count = len(mesh.vertices)
    for number in np.unique(ring[rim]):
        mine = rim[ring[rim[:, 0]] == number]
        if len(mine) < 3:
            continue
        corners = np.unique(mine)
        vertices.append(mesh.vertices[corners].mean(0, keepdims=True))
        colours.append(mesh.colours[corners].mean(0, keepdims=True).astype(np.uint8))
        faces.append(np.stack([mine[:, 1], mine[:, 0], np.full(len(mine), count)], -1))
        seen.append(np.zeros(1))
        count += 1
    return make_mesh(
        np.concatenate(vertices), np.concatenate(faces), colours=np.concatenate(colours), seen=np.concatenate(seen)
    )


def find_rim(faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "e 2"]:
    """Edges that one face has alone, in its direction."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    many = int(faces.max()) + 1
    forth, back = edges[:, 0] * many + edges[:, 1], edges[:, 1] * many + edges[:, 0]
    return edges[~np.isin(forth, back)]


def frame_model(mesh: Mesh, support: Support) -> tuple[Mesh, Similarity[np.ndarray]]:
    """The mesh in a frame of its own, and ``world_from_model``: the middle of its box, z up, x along its longer side
    on the support, as BOP's models have it.
    """
    flat = support.support_from_world @ mesh.vertices
    x = _long_side(flat[:, :2])
    turn = np.stack([x, [-x[1], x[0], 0], [0, 0, 1]])  # model axes in the support's
    world_from_axes = support.axes @ turn.T
    inside = mesh.vertices @ world_from_axes
    middle = (inside.min(0) + inside.max(0)) / 2
    world_from_model = Similarity(world_from_axes, world_from_axes @ middle, np.ones(()))
    moved = dataclasses.replace(mesh, vertices=inside - middle, normals=mesh.normals @ world_from_axes)
    return moved, world_from_model


def _long_side(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3"]:
    """Direction of the longer side of the smallest rectangle around points of a plane."""
    import cv2

    _, (width, height), angle = cv2.minAreaRect(points.astype(np.float32))
    angle = np.deg2rad(angle + (0 if width >= height else 90))
    return np.array([np.cos(angle), np.sin(angle), 0.0])
