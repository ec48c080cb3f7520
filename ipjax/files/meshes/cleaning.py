"""Repairing the faults of reconstructed meshes."""

import dataclasses

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ipjax.files.meshes.mesh import Mesh, corner_products, number_places, number_rows, vertex_normals

TINY_AREA = 0.01  # a component with a smaller share of the area ...
TINY_EXTENT = 0.2  # ... and a smaller share of the bounding box's diagonal is removed
TINY_TOTAL = (
    0.05  # share of the area that such pieces may have together; where they have more they belong to the object
)


def clean(mesh: Mesh) -> tuple[Mesh, tuple[str, ...]]:
    """Repair the faults of reconstructed meshes. Returns the new mesh, and one sentence per repair.

    Duplicate vertices are merged (same place, same colour or texture coordinate), faces without area or drawn twice
    and small loose pieces are removed, windings are made consistent and turned outwards (by the signed volume of each
    connected piece), normals are computed anew. Frame and units stay. Raises ValueError where no face is left.
    """
    report = []
    faces = mesh.faces
    place = number_places(mesh.vertices)
    place_count = int(place.max()) + 1

    # Faces that have no area, or repeat another (in either winding).
    corners = place[faces]
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    area = np.linalg.norm(corner_products(mesh.vertices, faces), axis=-1) / 2
    flat = (area <= 1e-14 * longest**2) | (corners[:, [0, 1, 2]] == corners[:, [1, 2, 0]]).any(1)
    if flat.any():
        report.append(f"removed {_count(int(flat.sum()), 'face')} without area")
        faces, corners, area = faces[~flat], corners[~flat], area[~flat]
    if len(faces) == 0:
        raise ValueError("no face of the mesh has an area")
    first_copy = np.zeros(len(faces), bool)
    first_copy[np.unique(np.sort(corners, axis=1), axis=0, return_index=True)[1]] = True
    if not first_copy.all():
        report.append(f"removed {_count(int((~first_copy).sum()), 'repeated face')}")
        faces, corners, area = faces[first_copy], corners[first_copy], area[first_copy]

    # Small loose pieces.
    label = _pieces(corners, place_count)
    count = int(label.max()) + 1
    share = np.bincount(label, area, count) / area.sum()
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in range(3):
        np.minimum.at(low, label, mesh.vertices[faces[:, corner]])
        np.maximum.at(high, label, mesh.vertices[faces[:, corner]])
    whole = np.linalg.norm(high.max(0) - low.min(0))
    tiny = (share < TINY_AREA) & (np.linalg.norm(high - low, axis=-1) < TINY_EXTENT * whole)
    if tiny.any() and share[tiny].sum() <= TINY_TOTAL:
        report.append(f"removed {int(tiny.sum())} of {count} components, {share[tiny].sum():.1%} of the surface")
        keep = ~tiny[label]
        faces, corners, area = faces[keep], corners[keep], area[keep]
    elif count > 1:
        report.append(f"kept all {count} components")

    flipped, closed = _windings(mesh.vertices, faces, corners, area)
    if flipped.any():
        report.append(f"turned {int(flipped.sum())} of {len(faces)} faces outwards")
        faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    if not closed:
        report.append("the surface is not closed")

    # Vertices.
    if mesh.texture is not None and mesh.uv is not None:
        extra = np.round(mesh.uv * 2**20).astype(np.int64)
    else:
        extra = mesh.colours.astype(np.int64)
    trust = np.round(mesh.seen * 1000).astype(np.int64)
    number = number_rows(np.concatenate([place[:, None], extra, trust[:, None]], axis=1))
    used, new = np.unique(number[faces], return_inverse=True)
    first = np.full(int(number.max()) + 1, len(number))
    np.minimum.at(first, number, np.arange(len(number)))
    pick = first[used]
    faces = new.reshape(-1, 3).astype(np.int32)
    merged = len(np.unique(number)) - len(mesh.vertices)
    if merged:
        report.append(f"merged {_count(-merged, 'duplicate vertex', 'duplicate vertices')}")
    loose = len(np.unique(number)) - len(used)
    if loose:
        report.append(f"removed {_count(loose, 'unused vertex', 'unused vertices')}")
    vertices = mesh.vertices[pick]
    result = dataclasses.replace(
        mesh,
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces),
        colours=mesh.colours[pick],
        seen=mesh.seen[pick],
        uv=None if mesh.uv is None else mesh.uv[pick],
    )
    return result, tuple(report) or ("nothing to repair",)


def _count(number: int, noun: str, plural: str = "") -> str:
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def _pieces(corners: np.ndarray, count: int) -> np.ndarray:
    """Which connected piece every face belongs to, numbered from 0."""
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), (count, count))
    label = csgraph.connected_components(graph, directed=False)[1][corners[:, 0]]
    return np.unique(label, return_inverse=True)[1].reshape(-1)


def _windings(
    vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray, area: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Which faces to turn so that all look outwards, and whether the surface is closed.

    Every face is a node twice, as it is and turned; an edge joins the two states of its faces that agree. A connected
    component of that graph is one consistent winding; a piece whose two states meet has none (a Möbius strip).
    """
    m = len(faces)
    start, end = corners[:, [0, 1, 2]].ravel(), corners[:, [1, 2, 0]].ravel()
    owner = np.repeat(np.arange(m), 3)
    forward = start < end
    edge = number_rows(np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1))
    uses = np.bincount(edge)
    order = np.argsort(edge, kind="stable")
    paired = order[(uses == 2)[edge[order]]].reshape(-1, 2)
    a, b = owner[paired[:, 0]], owner[paired[:, 1]]
    clash = forward[paired[:, 0]] == forward[paired[:, 1]]  # neighbours that run the same way along their edge
    rows = np.concatenate([a, a + m])
    columns = np.concatenate([np.where(clash, b + m, b), np.where(clash, b, b + m)])
    graph = sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), (2 * m, 2 * m))
    count, label = csgraph.connected_components(graph, directed=False)
    as_is, turned = label[:m], label[m:]
    free = as_is != turned
    # Of the two states of each piece, the one that keeps more of the surface as it is.
    kept = np.bincount(as_is, area, count)
    flipped = free & ((kept[as_is] < kept[turned]) | ((kept[as_is] == kept[turned]) & (as_is > turned)))
    # Then outwards: by the volume under the piece, seen from its own middle.
    piece = np.minimum(as_is, turned)
    product = corner_products(vertices, faces) * np.where(flipped, -0.5, 0.5)[:, None]
    middle = vertices[faces].mean(1)
    weight = np.maximum(np.bincount(piece, area, count), 1e-300)
    centre = np.stack([np.bincount(piece, area * middle[:, i], count) / weight for i in range(3)], axis=-1)
    arm = middle - centre[piece]
    volume = np.bincount(piece, (product * arm).sum(1), count)
    bound = np.bincount(piece, area * np.linalg.norm(arm, axis=-1), count)
    # A nearly flat open piece has no inside: it stays.
    flipped ^= free & (volume < -0.05 * bound)[piece]
    return flipped, bool((uses == 2).all())
