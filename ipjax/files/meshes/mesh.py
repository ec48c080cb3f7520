"""Meshes as plain arrays: read from files, repaired, normalised, sampled.

A mesh keeps the transform from its file's frame to its present one, so that results can be told in the file's own
frame: ``present = scale * (file - centre)``. Axes are never turned: a Y-up file stays Y-up, and is reported so.
"""

import dataclasses
import struct
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import sparse
from scipy.sparse import csgraph

from ipjax.files.meshes.farthest import largest_distance
from ipjax.files.meshes.gltf import make_glb, read_gltf
from ipjax.files.meshes.obj import read_obj
from ipjax.files.meshes.parts import GREY, MAX_BYTES, Source, check_faces, join
from ipjax.files.meshes.ply import read_ply
from ipjax.files.meshes.stl import read_stl
from ipjax.files.meshes.textures import sample_texture
from ipjax.files.storage.writing import write_bytes, write_text

FORMATS = (".obj", ".ply", ".glb", ".gltf", ".stl")


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
        normals = _unit(np.array(normals, np.float64))
    return Mesh(vertices, faces, normals, np.ascontiguousarray(colours), seen, uv, texture, notes=tuple(notes))


def _as_bytes(colours: np.ndarray) -> np.ndarray:
    colours = np.asarray(colours)
    if colours.dtype == np.uint8:
        return colours
    if colours.dtype == np.uint16:
        return (colours // 257).astype(np.uint8)
    return np.round(np.clip(np.nan_to_num(colours.astype(np.float64)), 0, 1) * 255).astype(np.uint8)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), 0.0)


def _corner_products(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the area of every face times its unit normal, [m 3]."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "n 3"]:
    """Area-weighted mean of the normals of the faces at every vertex, unit length; zero where there is none.

    Vertices that share a place share a normal, so that seams of the texture do not show.
    """
    products = _corner_products(vertices, faces)
    place = _places(vertices)
    total = np.zeros((place.max() + 1, 3))
    for axis in range(3):
        for corner in range(3):
            total[:, axis] += np.bincount(place[faces[:, corner]], products[:, axis], len(total))
    return _unit(total)[place]


def _places(vertices: np.ndarray) -> np.ndarray:
    """The same number for vertices at the same place (to 1e-7 of the extent), counted from 0."""
    low = vertices.min(0)
    step = max(float(np.ptp(vertices, axis=0).max()) * 1e-7, 1e-300)
    return _number_rows(np.round((vertices - low) / step).astype(np.int64))


def _number_rows(rows: np.ndarray) -> np.ndarray:
    """The same number for equal rows, in lexical order of the rows."""
    order = np.lexsort(rows.T[::-1])
    fresh = np.ones(len(rows), bool)
    fresh[1:] = (rows[order][1:] != rows[order][:-1]).any(1)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(fresh) - 1
    return number


# --- reading -------------------------------------------------------------------------------------------------------


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
    readers = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".glb": read_gltf, ".gltf": read_gltf}
    try:
        parts = [part for part in readers[kind](source) if len(part.faces)]
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


# --- writing -------------------------------------------------------------------------------------------------------


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write the mesh in its present frame: .ply and .stl without texture (colours per vertex), .glb and .obj with it.

    Raises ValueError for another extension. Positions are float32 in .glb and .ply.
    """
    import trimesh
    from PIL import Image
    from trimesh.exchange.obj import export_obj
    from trimesh.visual import ColorVisuals, TextureVisuals
    from trimesh.visual.material import SimpleMaterial

    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".ply", ".glb", ".obj", ".stl"):
        raise ValueError(f"{path.name}: meshes are written as .ply, .glb, .obj or .stl")
    out = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
    if mesh.texture is not None and mesh.uv is not None and kind == ".obj":
        material = SimpleMaterial(name=path.stem, image=Image.fromarray(mesh.texture), diffuse=[255, 255, 255, 255])
        out.visual = TextureVisuals(uv=mesh.uv, material=material)
    else:
        out.visual = ColorVisuals(out, vertex_colors=mesh.colours)
    if kind == ".obj":
        text, files = export_obj(out, include_normals=True, return_texture=True, mtl_name=path.stem + ".mtl")
        for name, data in files.items():
            write_bytes(path.parent / name, data)
        write_text(path, text)
        return
    if kind == ".glb":
        write_bytes(path, make_glb(mesh.vertices, mesh.faces, mesh.normals, mesh.colours, mesh.uv, mesh.texture))
        return
    data = out.export(file_type=kind[1:])
    write_bytes(path, data if isinstance(data, bytes) else str(data).encode())


# --- repairing -----------------------------------------------------------------------------------------------------

TINY_AREA = 0.01  # a component with a smaller share of the area ...
TINY_EXTENT = 0.2  # ... and a smaller share of the bounding box's diagonal is a fleck
FLECKS = 0.05  # share of the area that flecks may have together, or they are the object's nature and stay


def clean(mesh: Mesh) -> tuple[Mesh, tuple[str, ...]]:
    """Repair what reconstruction leaves, and say what was done: the new mesh, and one sentence per repair.

    Duplicate vertices are merged (same place, same colour or texture coordinate), faces without area or drawn twice
    and loose flecks are removed, windings are made consistent and turned outwards (by the signed volume of each
    connected piece), normals are computed anew. Frame and units stay. Raises ValueError where no face is left.
    """
    report = []
    faces = mesh.faces
    place = _places(mesh.vertices)
    place_count = int(place.max()) + 1

    # Faces that have no area, or repeat another (in either winding).
    corners = place[faces]
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    area = np.linalg.norm(_corner_products(mesh.vertices, faces), axis=-1) / 2
    flat = (area <= 1e-14 * longest**2) | (corners[:, [0, 1, 2]] == corners[:, [1, 2, 0]]).any(1)
    if flat.any():
        report.append(f"removed {_count(int(flat.sum()), 'face')} without area")
        faces, corners, area = faces[~flat], corners[~flat], area[~flat]
    if len(faces) == 0:
        raise ValueError("no face of the mesh has an area")
    fresh = np.zeros(len(faces), bool)
    fresh[np.unique(np.sort(corners, axis=1), axis=0, return_index=True)[1]] = True
    if not fresh.all():
        report.append(f"removed {_count(int((~fresh).sum()), 'repeated face')}")
        faces, corners, area = faces[fresh], corners[fresh], area[fresh]

    # Flecks.
    label = _pieces(corners, place_count)
    count = int(label.max()) + 1
    share = np.bincount(label, area, count) / area.sum()
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in range(3):
        np.minimum.at(low, label, mesh.vertices[faces[:, corner]])
        np.maximum.at(high, label, mesh.vertices[faces[:, corner]])
    whole = np.linalg.norm(high.max(0) - low.min(0))
    tiny = (share < TINY_AREA) & (np.linalg.norm(high - low, axis=-1) < TINY_EXTENT * whole)
    if tiny.any() and share[tiny].sum() <= FLECKS:
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
    number = _number_rows(np.concatenate([place[:, None], extra, trust[:, None]], axis=1))
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
    edge = _number_rows(np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1))
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
    product = _corner_products(vertices, faces) * np.where(flipped, -0.5, 0.5)[:, None]
    middle = vertices[faces].mean(1)
    weight = np.maximum(np.bincount(piece, area, count), 1e-300)
    centre = np.stack([np.bincount(piece, area * middle[:, i], count) / weight for i in range(3)], axis=-1)
    arm = middle - centre[piece]
    volume = np.bincount(piece, (product * arm).sum(1), count)
    bound = np.bincount(piece, area * np.linalg.norm(arm, axis=-1), count)
    # A nearly flat open piece has no inside: it stays.
    flipped ^= free & (volume < -0.05 * bound)[piece]
    return flipped, bool((uses == 2).all())


# --- normalising ---------------------------------------------------------------------------------------------------


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


# --- sampling ------------------------------------------------------------------------------------------------------


def sample_surface(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Points spread evenly over the surface, their unit normals and their `seen`; the same seed gives the same points.

    Uniform samples by area, thinned by farthest-point selection, so that the gaps are even too. Normals are those of
    the faces' winding. Raises ValueError where count is not positive or the mesh has no area.
    """
    if count < 1:
        raise ValueError(f"sample_surface needs a positive count, got {count}")
    points, normals, face, weights = _scatter(mesh, 5 * count, np.random.Generator(np.random.PCG64(seed)))
    chosen = farthest_points(points, count)
    seen = np.einsum("kc,kc->k", weights[chosen], mesh.seen[mesh.faces[face[chosen]]])
    return points[chosen], normals[chosen], np.clip(np.round(seen, 6), 0, 1)  # weights sum to 1 within rounding


def sample_appearance(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], UInt8[np.ndarray, "k 3"]]:
    """Points spread over the surface by area, their unit normals and their colours; for drawing, so many and cheap.

    Raises ValueError where count is not positive or the mesh has no area.
    """
    if count < 1:
        raise ValueError(f"sample_appearance needs a positive count, got {count}")
    points, normals, face, weights = _scatter(mesh, count, np.random.Generator(np.random.PCG64(seed)))
    corners = mesh.faces[face]
    if mesh.texture is not None and mesh.uv is not None:
        colours = sample_texture(mesh.texture, np.einsum("kc,kci->ki", weights, mesh.uv[corners]))
    else:
        mixed = np.einsum("kc,kci->ki", weights, mesh.colours[corners].astype(np.float64))
        colours = np.clip(np.round(mixed), 0, 255).astype(np.uint8)
    return points, normals, colours


def _scatter(mesh: Mesh, count: int, random: np.random.Generator):
    """Points stratified by area, their normals, faces and barycentric weights."""
    products = _corner_products(mesh.vertices, mesh.faces)
    area = np.linalg.norm(products, axis=-1)
    if not area.sum() > 0:
        raise ValueError("the mesh has no area")
    ladder = np.cumsum(area)
    face = np.searchsorted(ladder, (np.arange(count) + random.random(count)) / count * ladder[-1], side="right")
    face = np.minimum(face, len(area) - 1)
    a, b = random.random((2, count))
    root = np.sqrt(a)
    weights = np.stack([1 - root, root * (1 - b), root * b], axis=-1)
    points = np.einsum("kc,kci->ki", weights, mesh.vertices[mesh.faces[face]])
    return points, _unit(products[face]), face, weights


def farthest_points(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " k"]:
    """Indices of `count` points, each the farthest from all before it; the first is the farthest from the mean."""
    squared = np.full(len(points), np.inf)
    chosen = np.empty(min(count, len(points)), np.int64)
    columns = np.ascontiguousarray(points.T)
    current = int(((points - points.mean(0)) ** 2).sum(1).argmax())
    for i in range(len(chosen)):
        chosen[i] = current
        x, y, z = columns - columns[:, current : current + 1]
        np.minimum(squared, x * x + y * y + z * z, out=squared)
        current = int(squared.argmax())
    return chosen
