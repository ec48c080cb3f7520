"""Wavefront OBJ: faces with their textures, colours of vertices and materials."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from ipjax.files.meshes.formats.mtl import Material, find_materials
from ipjax.files.meshes.formats.part import GREY, Part, drop_unused
from ipjax.files.meshes.formats.source import BYTE_ORDER_MARK, Source, check_faces
from ipjax.files.meshes.textures import Texture

BLOCK = 1 << 23  # bytes of text that are split at a time
NONE = np.int64(-1)  # no texture coordinate


@dataclasses.dataclass
class Table:
    """Numbers that come in blocks, and how many there are."""

    width: int
    blocks: list[np.ndarray] = dataclasses.field(default_factory=list)
    count: int = 0

    def add(self, rows: np.ndarray) -> None:
        """Append a block of rows."""
        self.blocks.append(rows)
        self.count += len(rows)

    def whole(self) -> np.ndarray:
        """All rows in one array."""
        return np.concatenate(self.blocks) if self.blocks else np.empty((0, self.width))


def read_obj(source: Source) -> list[Part]:
    """The parts of an OBJ file, one per texture and one for what has none. Raises ValueError in a sentence."""
    data = source.read().removeprefix(BYTE_ORDER_MARK)
    source.take(len(data), "its text")
    vertices, uvs = Table(7), Table(2)
    faces: list[np.ndarray] = []  # [m 3 2]: vertex and texture coordinate of every corner, from 0
    owner: list[np.ndarray] = []
    materials: dict[bytes, int] = {}
    libraries: list[bytes] = []
    current, count = -1, 0
    for lines in split_blocks(data):
        for kind, group in gather(lines):
            if kind == b"v":
                rows = read_rows(group, 3, 8)
                source.take(56 * len(rows), f"{vertices.count + len(rows):,} vertices")
                vertices.add(rows)
            elif kind == b"vt":
                rows = read_rows(group, 1, 3)[:, :2]
                source.take(16 * len(rows), f"{uvs.count + len(rows):,} texture coordinates")
                uvs.add(rows)
            elif kind == b"f":
                rows = read_faces(group, vertices.count, uvs.count)
                count += len(rows)
                check_faces(count)
                source.take(80 * len(rows), f"{count:,} faces")
                faces.append(rows)
                owner.append(np.full(len(rows), current))
            elif kind == b"usemtl":
                name = group[-1].strip()
                current = materials.setdefault(name, len(materials))
            elif kind == b"mtllib":
                libraries += [line.strip() for line in group]
    if not count:
        raise ValueError("the mesh is empty: it has no faces (a point cloud must be meshed first)")
    corners = np.concatenate(faces)
    if corners[:, :, 0].max() >= vertices.count:
        raise ValueError(f"a face names vertex {corners[:, :, 0].max() + 1} of {vertices.count}")
    # A texture coordinate that does not exist costs a corner its texture; the mesh is still read.
    corners[:, :, 1][corners[:, :, 1] >= uvs.count] = NONE
    found = find_materials(source, libraries, materials)
    return assemble(source, vertices.whole(), uvs.whole(), corners, np.concatenate(owner), found)


# --- text ------------------------------------------------------------------------------------------------------------


def split_blocks(data: bytes) -> Iterator[list[bytes]]:
    """Lines, a block of the file at a time; a line that ends in a backslash goes on in the next."""
    start = 0
    while start < len(data):
        stop = min(start + BLOCK, len(data))
        while stop < len(data):
            cut = data.rfind(b"\n", start, stop) + 1
            if cut == 0:
                cut = data.rfind(b"\r", start, stop) + 1
            if cut <= start:
                raise ValueError("has a line of more than eight million characters")
            stop = cut
            if not data[start:stop].rstrip(b"\r\n").endswith(b"\\"):
                break
            stop = data.rfind(b"\n", start, stop - 1) + 1 or stop - 1
        block = data[start:stop]
        if b"\\" in block:
            block = block.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
        yield [line for line in block.splitlines() if line]
        start = stop


def gather(lines: list[bytes]) -> Iterator[tuple[bytes, list[bytes]]]:
    """Lines in runs that can be read together, without their first word: in the order of the file where it matters.

    Vertices and texture coordinates come before the faces of their run, which name none that come later.
    """
    runs: dict[bytes, list[bytes]] = {b"v": [], b"vt": [], b"f": []}
    backward = False
    for line in lines:
        kind, _, rest = line.partition(b" ") if line[:1] in b"vfum#" and b"\t" not in line else split_word(line)
        if kind in runs:
            if backward and kind != b"f":
                # Faces that count backwards from here must be read before there are more vertices.
                for name in runs:
                    if runs[name]:
                        yield name, runs[name]
                runs, backward = {b"v": [], b"vt": [], b"f": []}, False
            runs[kind].append(rest)
            if kind == b"f" and b"-" in rest:
                backward = True
        elif kind in (b"usemtl", b"mtllib"):
            for name in runs:
                if runs[name]:
                    yield name, runs[name]
            runs, backward = {b"v": [], b"vt": [], b"f": []}, False
            yield kind, [rest]
    for name in runs:
        if runs[name]:
            yield name, runs[name]


def split_word(line: bytes) -> tuple[bytes, bytes, bytes]:
    """The first word of a line and the rest."""
    words = line.split(None, 1)
    return (words[0] if words else b"", b" ", words[1] if len(words) > 1 else b"")


def read_rows(lines: list[bytes], least: int, most: int) -> np.ndarray:
    """Numbers, at least so many a line; those that a line lacks are NaN, as far as the seventh."""
    width = 7 if most > 3 else most
    result = np.full((len(lines), width), np.nan)
    groups: dict[int, tuple[list[int], list[list[bytes]]]] = {}
    for i, line in enumerate(lines):
        if len(line) > 10_000:
            raise ValueError(f"has a line of {len(line):,} characters where a few numbers belong")
        words = line.partition(b"#")[0].split() if b"#" in line else line.split()
        numbers, rows = groups.setdefault(len(words), ([], []))
        numbers.append(i)
        rows.append(words)
    for count, (numbers, rows) in groups.items():
        if count < least:
            raise ValueError(f"has a line of {count} numbers where {least} belong: {b' '.join(rows[0])[:60]!r}")
        if count > 64:
            raise ValueError(f"has a vertex of {count} numbers")
        try:
            table = np.array(rows).astype(np.float64)
        except ValueError:
            raise ValueError("has lines of vertices that are not numbers") from None
        if width == 7 and count == 4:
            table = table[:, :3]  # the fourth is a weight
        result[np.array(numbers)[:, None], np.arange(min(table.shape[1], width))] = table[:, :width]
    return result


def read_faces(lines: list[bytes], vertices: int, uvs: int) -> np.ndarray:
    """Corners [m 3 2] of triangles: vertex and texture coordinate, from 0, −1 where there is none. Polygons become fans
    about their first corner."""
    result = []
    groups: dict[int, list[list[bytes]]] = {}
    for line in lines:
        if len(line) > 1_000_000:
            raise ValueError(f"has a face of {len(line):,} characters")
        words = line.partition(b"#")[0].split() if b"#" in line else line.split()
        groups.setdefault(len(words), []).append(words)
    for count, rows in groups.items():
        if count < 3:
            continue
        text = b" ".join(b" ".join(row) for row in rows)
        words = text.split()
        try:
            slashes = {word.count(b"/") for word in words} if b"/" in text else {0}
            if len(slashes) == 1 and b"//" not in text and b"/ " not in text and not text.endswith(b"/"):
                (k,) = slashes
                table = np.array(text.replace(b"/", b" ").split()).astype(np.int64).reshape(len(words), k + 1)
                corners = np.full((len(words), 2), NONE)
                corners[:, : min(k + 1, 2)] = table[:, :2]
                given = np.full(len(words), k > 0)
            else:
                pairs = [[*word.split(b"/"), b""][:2] for word in words]
                given = np.array([pair[1] != b"" for pair in pairs])
                corners = np.array([[int(a), int(b) if b else 1] for a, b in pairs], np.int64)
        except (ValueError, OverflowError):
            raise ValueError(f"has faces that are not whole numbers: {words[0][:40]!r}") from None
        for column, total in ((0, vertices), (1, uvs)):
            mine = corners[:, column]
            mine[:] = np.where(mine < 0, mine + total, mine - 1)
            if column:
                mine[~given | (mine < 0)] = NONE
            elif len(mine) and mine.min() < 0:
                raise ValueError(f"a face names a vertex before the first of {total}")
        shape = corners.reshape(len(rows), count, 2)
        step = np.arange(count - 2)
        first = np.broadcast_to(shape[:, :1], (len(rows), count - 2, 2))
        result.append(np.stack([first, shape[:, step + 1], shape[:, step + 2]], axis=2).reshape(-1, 3, 2))
    return np.concatenate(result) if result else np.empty((0, 3, 2), np.int64)


def assemble(
    source: Source,
    table: np.ndarray,
    uvs: np.ndarray,
    corners: np.ndarray,
    owner: np.ndarray,
    materials: dict[int, Material],
) -> list[Part]:
    """Parts of faces with the same texture, and one of those without."""
    vertices = table[:, :3]
    colours = read_colours(table)
    textures: dict[int, Texture] = {}
    images: dict[bytes, Texture | None] = {}
    for number, material in materials.items():
        if material.image:
            if material.image not in images:
                images[material.image] = source.open_texture(material.image)
            texture = images[material.image]
            if texture is not None:
                wrap = "clamp" if material.clamp else "repeat"
                textures[number] = dataclasses.replace(texture, wrap=(wrap, wrap))
    placed = (corners[:, :, 1] >= 0).all(axis=1)
    if placed.any() and not textures:
        named = any(material.image for material in materials.values())
        # Several colours are meant to be shown; a single one is what exporters write where they have none.
        painted = len({material.colour for material in materials.values()} - {None}) > 1 and not named
        guess = None if painted else source.guess_texture()
        if guess is not None:
            textures = dict.fromkeys((int(number) for number in np.unique(owner)), guess)
        elif not painted and not named:
            how = "its own colours are shown" if colours is not None else "shown without"
            source.warn(f"it has texture coordinates and no texture that can be read: {how}")
    parts = []
    rest = np.ones(len(corners), bool)
    for number, texture in textures.items():
        mine = np.asarray(owner == number) & placed
        if not mine.any():
            continue
        rest &= ~mine
        pairs = corners[mine].reshape(-1, 2)
        base = len(uvs) + 1
        keys, inverse = np.unique(pairs[:, 0] * base + pairs[:, 1], return_inverse=True)
        source.take_mesh(len(keys), len(pairs) // 3)
        material = materials.get(number, Material())
        uv = np.clip(np.nan_to_num(uvs[keys % base]), -1e6, 1e6) * material.scale + material.offset
        parts.append(Part(vertices[keys // base], inverse.reshape(-1, 3), uv=uv, texture=texture))
    if rest.any():
        part = paint(source, vertices, corners[rest][:, :, 0], owner[rest], colours, materials)
        parts.append(drop_unused(part) if parts else part)
    return parts


def read_colours(table: np.ndarray) -> np.ndarray | None:
    """The colours behind the vertices' coordinates: in [0, 1], or out of 255 where one is larger."""
    values = table[:, 3:6]
    known = np.asarray(np.isfinite(values).all(axis=1))
    if not known.any():
        return None
    top = 255.0 if values[known].max() > 1.5 else 1.0
    values = np.where(known[:, None], values / top, GREY / 255)
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def paint(
    source: Source,
    vertices: np.ndarray,
    faces: np.ndarray,
    owner: np.ndarray,
    colours: np.ndarray | None,
    materials: dict[int, Material],
) -> Part:
    """Faces without texture: in their vertices' colours, else in their materials', else in none."""
    source.take_mesh(len(vertices), len(faces))
    tones = {number: material.colour for number, material in materials.items() if material.colour is not None}
    white = colours is not None and (colours == 255).all()
    if not tones or (colours is not None and not white):
        return Part(vertices, faces, colours=colours)
    tone = np.full((max(int(owner.max()), *tones) + 2, 3), GREY, np.uint8)
    for number, colour in tones.items():
        tone[number] = np.round(np.clip(colour, 0, 1) * 255)
    # A vertex that faces of two materials share is there once for each.
    base = len(tone)
    keys, inverse = np.unique(faces.ravel() * base + np.repeat(owner % base, 3), return_inverse=True)
    source.take_mesh(len(keys), 0)
    return Part(vertices[keys // base], inverse.reshape(-1, 3), colours=tone[keys % base])
