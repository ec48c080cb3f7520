"""PLY: polygons, strips, colours and textures in the spellings in use."""

import numpy as np

from ipjax.files.meshes.formats.part import Part, drop_unused
from ipjax.files.meshes.formats.ply_rows import (
    Group,
    iterate_lines,
    order_rows,
    read_binary_rows,
    read_header,
    read_text_rows,
)
from ipjax.files.meshes.formats.source import BYTE_ORDER_MARK, Source
from ipjax.files.meshes.textures import Texture

COLOURS = [
    tuple(f"{before}{name}{after}" for name in ("red", "green", "blue"))
    for before, after in (("", ""), ("diffuse_", ""), ("", "_diffuse"), ("base_", ""))
] + [("r", "g", "b")]
COORDINATES = [
    ("texture_u", "texture_v"),
    ("texture_s", "texture_t"),
    ("u", "v"),
    ("s", "t"),
    ("tu", "tv"),
    ("tex_u", "tex_v"),
    ("texcoord_u", "texcoord_v"),
    ("texcoord_s", "texcoord_t"),
]


def read_ply(source: Source) -> list[Part]:
    """The parts of a PLY file, one per texture. Raises ValueError in a sentence."""
    data = source.read().removeprefix(BYTE_ORDER_MARK)
    order, elements, images, start = read_header(data, source.size)
    wanted = {"vertex", "face", "tristrips"}
    found: dict[str, list[Group]] = {}
    total = sum(element.count for element in elements if element.name in ("vertex", "face", "tristrips"))
    source.take(64 * total + len(data), f"{total:,} rows")
    if order is None:
        rows = iterate_lines(data, start)
        for element in elements:
            found[element.name] = list(read_text_rows(rows, element, element.name in wanted))
    else:
        for element in elements:
            groups, start = read_binary_rows(data, start, order, element, element.name in wanted)
            found[element.name] = groups
    if not found.get("vertex"):
        raise ValueError("the mesh is empty: it has no vertices")
    table = order_rows(found["vertex"])
    if not any(name in found and found[name] for name in ("face", "tristrips")):
        if "f_dc_0" in table or "rot_0" in table:
            raise ValueError("is a cloud of Gaussians (a splat), which has no surface: export a mesh")
        raise ValueError("the mesh is empty: it has no faces (a point cloud must be meshed first)")
    return assemble(source, table, found, images)


def read_colours(table: dict[str, np.ndarray]) -> np.ndarray | None:
    """Colours as bytes: whole numbers by the largest of their type, fractions as they are, others out of 255."""
    for names in COLOURS:
        if all(name in table for name in names):
            values = np.stack([table[name] for name in names], axis=-1)
            kind = table[names[0]].dtype
            values = np.nan_to_num(values.astype(np.float64))
            most = values.max(initial=0.0)
            # Fractions, bytes in floats, bytes in wider numbers, and sixteen bits are told apart by their range.
            top = 1.0 if kind.kind == "f" and most <= 1.5 else 255.0 if most <= 255 else 65535.0
            return np.round(np.clip(values / top, 0, 1) * 255).astype(np.uint8)
    return None


def fan(corners: np.ndarray) -> np.ndarray:
    """Polygons [m k] as triangles [m (k − 2) 3], from the first corner on."""
    step = np.arange(corners.shape[1] - 2)
    return np.stack(
        [np.broadcast_to(corners[:, :1], (len(corners), len(step))), corners[:, step + 1], corners[:, step + 2]],
        axis=-1,
    )


def unroll_strips(strip: np.ndarray) -> np.ndarray:
    """Triangles of strips that end at −1; every second one is turned."""
    last = np.arange(len(strip))
    ends = np.flatnonzero(strip < 0)
    begin = np.zeros(len(strip), np.int64)
    begin[ends] = ends + 1
    begin = np.maximum.accumulate(begin)
    full = (last - begin >= 2) & (strip >= 0)
    at = last[full]
    odd = (at - begin[full]) % 2
    return np.stack([strip[at - 2], strip[at - 1 + odd], strip[at - odd]], axis=-1)


def assemble(
    source: Source, table: dict[str, np.ndarray], found: dict[str, list[Group]], images: list[str]
) -> list[Part]:
    """Parts of the rows: one per texture that faces name."""
    if not all(name in table for name in "xyz"):
        raise ValueError("has vertices without x, y and z")
    vertices = np.stack([table[name] for name in "xyz"], axis=-1).astype(np.float64)
    count = len(vertices)
    colours = read_colours(table)
    uv = next(
        (
            np.stack([table[a], table[b]], axis=-1).astype(np.float64)
            for a, b in COORDINATES
            if a in table and b in table
        ),
        None,
    )
    faces, corner_uv, number, face_colours = [], [], [], []
    total = sum(
        columns[key].shape[0] * max(columns[key].shape[1] - 2, 0)
        for name in ("face", "tristrips")
        for _, columns in found.get(name, [])
        for key in ("vertex_indices", "vertex_index")
        if key in columns and columns[key].ndim == 2
    )
    source.take_mesh(count, total)
    for name in ("face", "tristrips"):
        for _, columns in found.get(name, []):
            corners = next((columns[key] for key in ("vertex_indices", "vertex_index") if key in columns), None)
            if corners is None or corners.ndim != 2:
                raise ValueError(f"has rows of {name} without vertex_indices")
            corners = corners.astype(np.int64)
            if name == "tristrips":
                triangles = unroll_strips(np.concatenate([corners, np.full((len(corners), 1), -1)], axis=1).ravel())
                pieces = triangles[None].swapaxes(0, 1)
            elif corners.shape[1] < 3:
                continue
            else:
                pieces = fan(corners)
            each = pieces.shape[1]
            faces.append(pieces.reshape(-1, 3))
            places = np.full((*pieces.shape, 2), np.nan)
            wedge = columns.get("texcoord") if name == "face" else None
            if wedge is not None and wedge.ndim == 2 and wedge.shape[1] == 2 * corners.shape[1]:
                places = np.nan_to_num(fan_values(wedge.reshape(len(wedge), -1, 2).astype(np.float64)))
            corner_uv.append(places.reshape(-1, 3, 2))
            which = (
                columns.get("texnumber", np.zeros(len(pieces), np.int64)) if name == "face" else np.zeros(len(pieces))
            )
            number.append(np.repeat(np.asarray(which).astype(np.int64), each))
            paint = read_colours(columns) if name == "face" else None
            paint = np.full((len(pieces), 3), -1) if paint is None else paint.astype(np.int64)
            face_colours.append(np.repeat(paint, each, axis=0))
    if not sum(len(piece) for piece in faces):
        raise ValueError("the mesh is empty: it has no faces (a point cloud must be meshed first)")
    triangles = np.concatenate(faces)
    wedges, numbers, paints = np.concatenate(corner_uv), np.concatenate(number), np.concatenate(face_colours)
    if triangles.min() < 0 or triangles.max() >= count:
        raise ValueError(
            f"a face names vertex {triangles.max() if triangles.max() >= count else triangles.min()} of {count}"
        )
    has_wedges = np.isfinite(wedges[:, 0, 0])
    if uv is None and not has_wedges.any():
        return [paint_faces(vertices, triangles, colours, paints)]
    textures: dict[int, Texture] = {}
    for index, name in enumerate(images[:1024]):
        texture = source.open_texture(name)
        if texture is not None:
            textures[index] = texture
    if not images:
        guess = source.guess_texture()
        if guess is not None:
            textures[0] = guess
    if not textures:
        if not images:
            how = "shown without" if colours is None and (paints < 0).all() else "its own colours are shown"
            source.warn(f"it has texture coordinates and no texture that can be read: {how}")
        return [paint_faces(vertices, triangles, colours, paints)]
    parts = []
    for index in np.unique(numbers):
        mine = numbers == index
        texture = textures.get(int(index))
        if texture is None:
            parts.append(paint_faces(vertices, triangles[mine], colours, paints[mine]))
        elif has_wedges[mine].any():
            flat = np.round(np.clip(np.nan_to_num(wedges[mine].reshape(-1, 2)), -1e6, 1e6), 7)
            key = np.concatenate([triangles[mine].reshape(-1, 1), flat], axis=1)
            rows, inverse = np.unique(key, axis=0, return_inverse=True)
            source.take_mesh(len(rows), 0)
            parts.append(
                Part(vertices[rows[:, 0].astype(np.int64)], inverse.reshape(-1, 3), uv=rows[:, 1:], texture=texture)
            )
        elif uv is not None:
            values = np.clip(np.nan_to_num(uv), -1e6, 1e6)
            part = Part(vertices, triangles[mine], uv=values, texture=texture)
            parts.append(part if mine.all() else drop_unused(part))
        else:
            parts.append(paint_faces(vertices, triangles[mine], colours, paints[mine]))
    return parts


def fan_values(values: np.ndarray) -> np.ndarray:
    """Values at the corners of polygons, [m k c], at those of their triangles, [m (k − 2) 3 c]."""
    step = np.arange(values.shape[1] - 2)
    first = np.broadcast_to(values[:, :1], (len(values), len(step), values.shape[2]))
    return np.stack([first, values[:, step + 1], values[:, step + 2]], axis=2)


def paint_faces(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None, paints: np.ndarray) -> Part:
    """A part with colours per vertex; where faces have colours and vertices none, faces get vertices of their own."""
    if colours is None and (paints >= 0).any():
        table = np.concatenate([np.repeat(np.maximum(paints, 0), 3, axis=0)])
        return Part(vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3), colours=table.astype(np.uint8))
    return Part(vertices, faces, colours=colours)
