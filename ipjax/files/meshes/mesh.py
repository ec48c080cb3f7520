"""Meshes as plain arrays.

A mesh keeps the transform from its file's frame to its present one, so that results can be reported in the file's own
frame: ``present = scale * (file - centre)``. Axes are never turned: a Y-up file stays Y-up, and is reported so.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ipjax.files.meshes.farthest import largest_distance
from ipjax.files.meshes.formats.part import GREY
from ipjax.files.meshes.formats.source import check_faces
from ipjax.files.meshes.textures import sample_texture


@dataclasses.dataclass(frozen=True)
class Mesh:
    """A triangle mesh on the host, NumPy arrays throughout.

    Colour comes from `texture` (looked up at `uv`; row 0 of the image is v = 1, as in OBJ) where there is one, and
    from `colours` otherwise.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "n 3"]  # unit; zero where no face defines one
    colours: UInt8[np.ndarray, "n 3"]
    seen: Float[np.ndarray, " n"]  # 1 = measured or observed, 0 = guessed by the reconstruction
    uv: Float[np.ndarray, "n 2"] | None = None
    texture: UInt8[np.ndarray, "th tw 3"] | None = None
    scale: float = 1.0  # units of this mesh per unit of its file
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the file's frame
    notes: tuple[str, ...] = ()  # what the reader found, in words

    def from_file(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Points of the file's frame in this mesh's frame."""
        return self.scale * (points - np.asarray(self.centre))

    def to_file(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Points of this mesh's frame in the file's frame."""
        return points / self.scale + np.asarray(self.centre)


def make_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    colours: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    texture: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    seen: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
) -> Mesh:
    """A mesh from arrays, with the rest filled in: vertices [n 3], faces [m 3], colours [n 3] uint8 or in [0, 1].

    Raises ValueError in words for what is not a mesh: wrong shapes, no faces, indices out of range, NaN, no extent,
    more than MAX_FACES faces.
    """
    vertices = np.array(vertices, np.float64)
    faces = np.array(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices must have the shape [n 3], got {list(vertices.shape)}")
    if len(vertices) == 0 or faces.size == 0:
        raise ValueError("the mesh is empty: it has no faces (a point cloud must be meshed first)")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must be triangles, [m 3], got {list(faces.shape)}")
    check_faces(len(faces))
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"a face names vertex {int(max(faces.max(), -faces.min()))} of {len(vertices)}")
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices).all(1)).sum())
        raise ValueError(f"{bad} of {len(vertices)} vertices are not finite numbers")
    extent = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
    if not extent > 0:
        raise ValueError("the mesh has no extent: all vertices coincide")
    if extent > 1e12 or np.abs(vertices).max() > 1e15:
        raise ValueError(f"the mesh is {extent:.3g} units wide, which is no object")
    n = len(vertices)
    if texture is not None and uv is not None:
        uv = np.array(uv, np.float64)
        if uv.shape != (n, 2) or not np.isfinite(uv).all():
            raise ValueError(f"uv must be finite, [{n} 2], got {list(uv.shape)}")
        texture = np.ascontiguousarray(_as_bytes(texture)[..., :3])
    else:
        uv = texture = None
    if colours is None:
        if texture is not None and uv is not None:
            colours = sample_texture(texture, uv)
        else:
            colours = np.full((n, 3), GREY, np.uint8)
    colours = _as_bytes(colours)[:, :3]
    if colours.shape != (n, 3):
        raise ValueError(f"colours must be [{n} 3], got {list(colours.shape)}")
    seen = np.ones(n) if seen is None else np.clip(np.array(seen, np.float64), 0, 1)
    if seen.shape != (n,):
        raise ValueError(f"seen must be [{n}], got {list(seen.shape)}")
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    if normals is None or np.shape(normals) != (n, 3) or not np.isfinite(normals).all():
        normals = vertex_normals(vertices, faces)
    else:
        normals = unit(np.array(normals, np.float64))
    return Mesh(vertices, faces, normals, np.ascontiguousarray(colours), seen, uv, texture, notes=tuple(notes))


def _as_bytes(colours: np.ndarray) -> np.ndarray:
    colours = np.asarray(colours)
    if colours.dtype == np.uint8:
        return colours
    if colours.dtype == np.uint16:
        return (colours // 257).astype(np.uint8)
    return np.round(np.clip(np.nan_to_num(colours.astype(np.float64)), 0, 1) * 255).astype(np.uint8)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of unit length along the last axis; those of no length stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), 0.0)


def corner_products(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the area of every face times its unit normal, [m 3]."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "n 3"]:
    """Area-weighted mean of the normals of the faces at every vertex, unit length; zero where there is none.

    Vertices that share a place share a normal, so that seams of the texture do not show.
    """
    products = corner_products(vertices, faces)
    place = number_places(vertices)
    total = np.zeros((place.max() + 1, 3))
    for axis in range(3):
        for corner in range(3):
            total[:, axis] += np.bincount(place[faces[:, corner]], products[:, axis], len(total))
    return unit(total)[place]


def number_places(vertices: np.ndarray) -> np.ndarray:
    """The same number for vertices at the same place (to 1e-7 of the extent), counted from 0."""
    low = vertices.min(0)
    step = max(float(np.ptp(vertices, axis=0).max()) * 1e-7, 1e-300)
    return number_rows(np.round((vertices - low) / step).astype(np.int64))


def number_rows(rows: np.ndarray) -> np.ndarray:
    """The same number for equal rows, in lexical order of the rows."""
    order = np.lexsort(rows.T[::-1])
    fresh = np.ones(len(rows), bool)
    fresh[1:] = (rows[order][1:] != rows[order][:-1]).any(1)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(fresh) - 1
    return number


def diameter(mesh: Mesh) -> float:
    """The largest distance between two vertices that belong to faces, to 1e-9 of itself, in the mesh's units."""
    return largest_distance(mesh.vertices[_used(mesh)])


def _used(mesh: Mesh) -> Bool[np.ndarray, " n"]:
    """Which vertices belong to faces."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    return used


def radius(mesh: Mesh) -> float:
    """The largest distance of a vertex from the origin, in the mesh's units."""
    return float(np.linalg.norm(mesh.vertices[_used(mesh)], axis=-1).max())


def normalise(mesh: Mesh) -> Mesh:
    """The mesh with the centre of its bounding box at the origin and diameter 1; the transform is kept in it."""
    used = mesh.vertices[_used(mesh)]
    middle = (used.min(0) + used.max(0)) / 2
    factor = 1 / diameter(mesh)
    centre = np.asarray(mesh.centre) + middle / mesh.scale
    return dataclasses.replace(
        mesh,
        vertices=(mesh.vertices - middle) * factor,
        scale=mesh.scale * factor,
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
    )


def move(mesh: Mesh, rotation: np.ndarray, translation: np.ndarray | None = None, scale: float = 1.0) -> Mesh:
    """The mesh under ``scale * rotation @ x + translation``, as a mesh with a frame of its own (no file transform)."""
    rotation = np.asarray(rotation, np.float64)
    vertices = scale * mesh.vertices @ rotation.T + (np.zeros(3) if translation is None else np.asarray(translation))
    return dataclasses.replace(
        mesh, vertices=vertices, normals=mesh.normals @ rotation.T, scale=1.0, centre=(0.0, 0.0, 0.0)
    )
