"""What a mesh file is read into: parts with one look each, under one budget of bytes; and one mesh made of them."""

import dataclasses
import math
import posixpath
import unicodedata
from pathlib import Path
from urllib.parse import unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int, UInt8

from ipjax.files.meshes.textures import (
    GUTTER,
    MAX_PIXELS_IN_ALL,
    MAX_REPEATS,
    MAX_TEXTURE,
    Chart,
    Texture,
    TextureError,
    bake,
    fit_repeats,
    from_linear,
    lay_out,
    open_texture,
    paint,
    sample_texture,
    to_linear,
    wrap_coordinates,
)
from ipjax.files.storage.budget import budget

MAX_FACES = 3_000_000
MAX_BYTES = 2_000_000_000  # of a file
GROWTH = 24  # bytes that a large file may take in memory for each of its own, past the budget of any file
VERTEX_BYTES, FACE_BYTES = 240, 150  # of memory while a mesh is made
MAX_WARNINGS = 8  # of one file
GREY = 160
IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tga", ".tif", ".tiff")
LFS = b"version https://git-lfs"
MARK = b"\xef\xbb\xbf"  # of UTF-8, which some editors put before a text


@dataclasses.dataclass
class Part:
    """Triangles of a file that share a look: a texture, colours per vertex, or nothing."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colours: UInt8[np.ndarray, "n 3"] | None = None
    uv: Float[np.ndarray, "n 2"] | None = None  # v = 0 is the bottom row of the image
    texture: Texture | None = None
    shade: Float[np.ndarray, "n 3"] | None = None  # linear light that the texture is multiplied by


def check_faces(count: int) -> None:
    """Raises ValueError for more than MAX_FACES faces."""
    if count > MAX_FACES:
        raise ValueError(
            f"the mesh has {count:,} faces, more than {MAX_FACES:,}: simplify it first "
            "(quadric decimation to 200,000 faces loses nothing a camera sees)"
        )


class Source:
    """One mesh file: the files beside it, the bytes that it may still become, and what its reader has to say."""

    def __init__(self, path: Path):
        self.path = path
        self.size = path.stat().st_size
        self.spent = 0
        self.pixels = 0
        self.warnings: list[str] = []
        self.notes: list[str] = []

    # What is asked for is counted before it is allocated.

    def take(self, count: int, what: str) -> None:
        """Count bytes that are about to be allocated. Raises ValueError where the file has used up its budget."""
        self.spent += int(count)
        limit = max(budget(), GROWTH * self.size)
        if self.spent > limit:
            raise ValueError(
                f"{what} would take {self.spent / 2**20:,.0f} MB of memory, more than the {limit / 2**20:,.0f} MB "
                "allowed for one file; simplify the mesh, or set IPJAX_FILE_BUDGET (MB) if you trust it"
            )

    def take_mesh(self, vertices: int, faces: int) -> None:
        """Count vertices and faces that are about to be made, instances one by one."""
        check_faces(faces)
        self.take(vertices * VERTEX_BYTES + faces * FACE_BYTES, f"{vertices:,} vertices and {faces:,} faces")

    def warn(self, sentence: str) -> None:
        """Something of the file is not read; said once, and of a file where much is missing the first few."""
        if sentence in self.warnings or len(self.warnings) > MAX_WARNINGS:
            return
        more = "there is more that is not read"
        self.warnings.append(sentence if len(self.warnings) < MAX_WARNINGS else more)

    # Files beside it.

    def read(self) -> bytes:
        """The file itself."""
        data = self.path.read_bytes()
        if data.startswith(LFS):
            raise ValueError("is a Git LFS pointer, not the mesh: git lfs pull fetches it")
        return data

    def find(self, name: str | bytes, quoted: bool = False) -> Path | None:
        """The file that is meant by a name in the mesh file, which need not be in UTF-8 nor in the right case.

        None where there is none. Raises ValueError for a name that leads out of the mesh's folder.
        """
        raw = name if isinstance(name, bytes) else name.encode("utf-8", "surrogatepass")
        spellings = [unquote_to_bytes(raw), raw] if quoted else [raw]
        folder = self.path.parent.resolve()
        outside = None
        for spelling in spellings:
            for encoding in ("utf-8", "gb18030", "shift_jis", "cp1252", "latin-1"):
                try:
                    text = spelling.decode(encoding).strip().strip('"').replace("\\", "/")
                except UnicodeDecodeError:
                    continue
                if not text or "\0" in text or len(text) > 4096:
                    continue
                found = _look(folder, text)
                if found is not None:
                    return found
                if not (folder / text).resolve().is_relative_to(folder):
                    outside = text
        if outside is not None:
            raise ValueError(f"names a file outside its own folder: {outside[:200]}")
        return None

    def read_beside(self, path: Path) -> bytes:
        """The bytes of a file beside the mesh, counted."""
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"names a file of {size / 1e9:.1f} GB: {path.name}")
        self.size += size
        self.take(size, f"the file {path.name}")
        return path.read_bytes()

    def open_texture(self, name: str | bytes, data: bytes | None = None, quoted: bool = False) -> Texture | None:
        """The texture of this name or in these bytes; None, and a warning, where it cannot be read."""
        shown = name if isinstance(name, str) else name.decode("utf-8", "replace")
        try:
            if data is None:
                path = self.find(name, quoted)
                if path is None:
                    raise TextureError(f"{shown[:200]} is named but missing")
                shown, data = path.name, self.read_beside(path)
            texture = open_texture(shown[:200], data)
        except TextureError as error:
            self.warn(f"{error}: shown without that texture")
            return None
        self.pixels += texture.width * texture.height
        if self.pixels > MAX_PIXELS_IN_ALL:
            raise ValueError(f"its textures have more than {MAX_PIXELS_IN_ALL:,} pixels together: make them smaller")
        return texture

    def guess_texture(self) -> Texture | None:
        """The image beside a mesh that names none but has texture coordinates, where its name says whose it is."""
        folder, stem = self.path.parent, self.path.stem.lower()
        try:
            files = sorted(path for path in folder.iterdir() if path.is_file())
        except OSError:
            return None
        meshes = {
            path.stem.lower() for path in files if path.suffix.lower() in (".obj", ".ply", ".glb", ".gltf", ".stl")
        }
        words = ("texture", "albedo", "diffuse", "basecolor", "base_color", "color", "kd", "tex")
        names = [stem, *(f"{stem}{join}{word}" for join in ("_", "-", "") for word in words), f"{stem}0", f"{stem}_0"]
        if meshes == {stem}:  # the only mesh here: a general name is enough
            names += [*words, "texture_kd", "texture_0", "material_0", "textured", "textured_mesh", "baked_texture"]
        images = {path.stem.lower(): path for path in reversed(files) if path.suffix.lower() in IMAGES}
        for name in names:
            if name in images:
                texture = self.open_texture(images[name].name, self.read_beside(images[name]))
                if texture is not None:
                    self.notes.append(f"{images[name].name} beside it is taken for its texture")
                    return texture
        return None


def _look(folder: Path, name: str) -> Path | None:
    """A file in the folder or below, whatever the case and the Unicode form of its name; an absolute path of another
    machine is looked for by its last part."""
    for text in (posixpath.normpath(name), name.rsplit("/", 1)[-1]):
        here, parts = folder, [part for part in text.split("/") if part not in ("", ".")]
        if ":" in text or text.startswith("/") or ".." in parts or not parts:
            continue
        for part in parts:
            try:
                if (here / part).exists():
                    here = here / part
                    continue
                wanted = unicodedata.normalize("NFC", part).casefold()
                same = [x for x in here.iterdir() if unicodedata.normalize("NFC", x.name).casefold() == wanted]
            except OSError:
                break
            if not same:
                break
            here = min(same)
        else:
            if here.is_file() and here.resolve().is_relative_to(folder):
                return here
    return None


def drop_unused(part: Part) -> Part:
    """The part without vertices that no face names."""
    used, faces = np.unique(part.faces, return_inverse=True)
    if len(used) == len(part.vertices):
        return part
    return dataclasses.replace(
        part,
        vertices=part.vertices[used],
        faces=faces.reshape(-1, 3),
        **{name: None if (x := getattr(part, name)) is None else x[used] for name in ("colours", "uv", "shade")},
    )


def split_corners(part: Part) -> Part:
    """The part with three vertices of its own for every face."""
    index = part.faces.ravel()
    return dataclasses.replace(
        part,
        vertices=part.vertices[index],
        faces=np.arange(len(index)).reshape(-1, 3),
        **{name: None if (x := getattr(part, name)) is None else x[index] for name in ("colours", "uv", "shade")},
    )


# --- one mesh of all parts -----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Joined:
    """Arrays for `meshes.make_mesh`, and how the colours came about, in words."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None
    uv: np.ndarray | None
    texture: np.ndarray | None
    note: str


def join(parts: list[Part], source: Source) -> Joined:
    """One mesh of all parts; textures are packed into one image where there are several.

    An image that cannot be decoded is left out with a warning. Raises ValueError where the mesh is too large.
    """
    parts = [_settle_shade(part) for part in parts]
    images: dict[Texture, np.ndarray | None] = {}
    while True:
        try:
            if any(part.texture is not None for part in parts):
                uv, pixels, note, parts = _pack(parts, images)
                break
        except TextureError as error:
            source.warn(f"{error}: shown without that texture")
            broken = {texture for texture, image in images.items() if image is None}
            parts = [
                dataclasses.replace(part, texture=None, uv=None, colours=_plain(part))
                if part.texture in broken
                else part
                for part in parts
            ]
            images = {}
            continue
        uv = pixels = None
        coloured = any(part.colours is not None for part in parts)
        note = "vertex colours" if coloured else "no colour: shown in plain grey"
        break
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
    colours = None if pixels is not None else np.concatenate([_colours(part) for part in parts])
    return Joined(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
        colours,
        uv,
        pixels,
        note,
    )


def _plain(part: Part) -> np.ndarray | None:
    return part.colours if part.shade is None else from_linear(part.shade)


def _colours(part: Part) -> np.ndarray:
    return np.full((len(part.vertices), 3), GREY, np.uint8) if part.colours is None else part.colours


def _settle_shade(part: Part) -> Part:
    """A shade that is the same everywhere is a tint of the image."""
    if part.shade is None or part.texture is None or np.ptp(part.shade, axis=0).max() > 2e-3:
        return part
    tint = np.asarray(part.texture.tint) * part.shade.mean(0)
    if np.abs(part.shade - 1).max() < 2e-3:
        return dataclasses.replace(part, shade=None)
    texture = dataclasses.replace(part.texture, tint=(float(tint[0]), float(tint[1]), float(tint[2])))
    return dataclasses.replace(part, texture=texture, shade=None)


def _decode(texture: Texture, width: int, height: int, images: dict[Texture, np.ndarray | None]) -> np.ndarray:
    """The image at about this size, decoded once; None is left in `images` for one that fails."""
    images[texture] = None
    found = texture.decode(max(width, 1), max(height, 1))
    images[texture] = found
    return found


def _pack(
    parts: list[Part], images: dict[Texture, np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray, str, list[Part]]:
    """Coordinates and one image for parts with textures, colours or neither; the parts as they are then."""
    textures = list(dict.fromkeys(part.texture for part in parts if part.texture is not None))
    first = textures[0]
    inside = all(
        part.uv is not None and part.uv.min() >= -1e-3 and part.uv.max() <= 1 + 1e-3
        for part in parts
        if part.texture is not None
    )
    if (
        len(textures) == 1
        and all(part.texture is not None and part.shade is None for part in parts)
        and (first.wrap == ("repeat", "repeat") or inside)
    ):
        ratio = min(1.0, MAX_TEXTURE / max(first.width, first.height))
        pixels = _decode(first, round(first.width * ratio), round(first.height * ratio), images)
        uv = np.concatenate([part.uv for part in parts if part.uv is not None])
        return uv, pixels, f"texture {pixels.shape[1]} × {pixels.shape[0]}", parts
    # Every part becomes parts with one chart each: its image, its palette, or the blocks of its faces.
    placed: list[tuple[Part, Chart, np.ndarray]] = []  # with places in texels of the chart, y down
    tiles: dict[Texture, Chart] = {}
    waiting: list[tuple[Part, Texture]] = []
    shaded: list[Part] = []
    for part in parts:
        if part.texture is None:
            placed += _chart_colours(part)
        elif part.shade is not None:
            shaded.append(part)
        else:
            uv = np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv
            repeated = tuple("repeat" if how == "repeat" else "clamp" for how in part.texture.wrap)
            if "mirror" in part.texture.wrap:  # folded: exact where no face crosses a border
                uv = wrap_coordinates(uv, part.texture.wrap)
            uv = wrap_coordinates(uv, (repeated[0], repeated[1]))
            uv, faces, index = fit_repeats(uv, part.faces)
            waiting.append((Part(part.vertices[index], faces, uv=uv, texture=part.texture), part.texture))
    room = MAX_TEXTURE**2 * 0.9
    for part in shaded:
        side = int(np.clip(math.sqrt(room / 2 / sum(len(x.faces) for x in shaded)), 2, 64))
        placed.append(_chart_shaded(part, side, images))
    room = max(room - sum(chart.width * chart.height for _, chart, _ in placed), room / 4)
    for part, texture in waiting:
        chart = tiles.setdefault(texture, Chart(texture.width, texture.height))
        span = np.ceil(np.maximum(part.uv.max(0) - 1e-3, 1e-9)) if part.uv is not None and len(part.uv) else (1, 1)
        across, down = (int(np.clip(max(a, b), 1, MAX_REPEATS)) for a, b in zip(chart.repeats, span, strict=True))
        chart.repeats = (across, down)
    charts = [*tiles.values(), *(chart for _, chart, _ in placed)]
    area = sum(chart.span[0] * chart.span[1] for chart in tiles.values())
    share = min(1.0, math.sqrt(room / max(area, 1)))
    while True:
        for texture, chart in tiles.items():
            reach = (MAX_TEXTURE - 2 * GUTTER) / np.array(chart.repeats)
            factor = min(share, reach[0] / texture.width, reach[1] / texture.height)
            chart.width, chart.height = (max(1, int(side * factor)) for side in (texture.width, texture.height))
        width, height = lay_out(charts)
        if max(width, height) <= 1.05 * MAX_TEXTURE or share < 1e-3 or not tiles:
            break
        share *= 0.9
    for texture, chart in tiles.items():
        chart.pixels = _decode(texture, chart.width, chart.height, images)
        chart.height, chart.width = chart.pixels.shape[:2]
    width, height = lay_out(charts)
    for part, texture in waiting:
        chart, uv = tiles[texture], part.uv
        if uv is None:
            continue
        # Where an image repeats more often than is laid out, its coordinates shrink: too fine to be seen either way.
        across = np.maximum(uv.max(0) / np.array(chart.repeats), 1.0) if len(uv) else 1.0
        across = np.where(across > 1 + 1e-2, across, 1.0)
        place = uv / across * [chart.width, chart.height]
        down = chart.span[1] - place[:, 1]
        placed.append((part, chart, np.stack([place[:, 0], down], axis=-1)))
    canvas = paint(charts, width, height)
    uvs = []
    for _, chart, place in placed:
        place = np.clip(place, 0, chart.span) + np.array([chart.left, chart.top])
        uvs.append(np.stack([place[:, 0] / width, 1 - place[:, 1] / height], axis=-1))
    note = f"{len(parts)} parts, {len(textures)} textures packed into one of {width} × {height}"
    return np.concatenate(uvs), canvas, note, [part for part, _, _ in placed]


def _chart_colours(part: Part) -> list[tuple[Part, Chart, np.ndarray]]:
    """A part without texture: a palette for faces of one colour, blocks for those whose colours vary."""
    colours = _colours(part)
    corners = colours[part.faces]
    flat = (corners == corners[:, :1]).all((1, 2))
    result = []
    if flat.any():
        one = drop_unused(dataclasses.replace(part, faces=part.faces[flat], colours=colours))
        values = _colours(one)
        palette, index = np.unique(values, axis=0, return_inverse=True)
        if len(palette) > 1 << 16:
            palette, index = np.unique(values & 0xFC | 2, axis=0, return_inverse=True)
        index = index.reshape(-1)
        side = math.ceil(math.sqrt(len(palette)))
        blocks = np.zeros((side * side, 3), np.uint8)
        blocks[: len(palette)] = palette
        pixels = blocks.reshape(side, side, 3).repeat(4, 0).repeat(4, 1)
        place = np.stack([(index % side) * 4 + 2.0, (index // side) * 4 + 2.0], axis=-1)
        result.append((one, Chart(4 * side, 4 * side, pixels=pixels), place))
    if not flat.all():
        one = split_corners(dataclasses.replace(part, faces=part.faces[~flat], colours=colours))
        corners = corners[~flat]

        def shine(faces: slice, weights: np.ndarray) -> np.ndarray:
            mixed = np.einsum("kc,fci->fki", weights, corners[faces].astype(np.float64))
            return np.round(np.clip(mixed, 0, 255)).astype(np.uint8)

        pixels, place = bake(len(corners), 4 if len(corners) < 300_000 else 2, shine)
        result.append((one, Chart(pixels.shape[1], pixels.shape[0], pixels=pixels), place))
    return result


def _chart_shaded(part: Part, side: int, images: dict[Texture, np.ndarray | None]) -> tuple[Part, Chart, np.ndarray]:
    """A part whose texture is multiplied by colours that vary: a block of the product for each of its faces."""
    texture = part.texture
    assert texture is not None and part.shade is not None and part.uv is not None
    ratio = min(1.0, 2048 / max(texture.width, texture.height))
    image = images.get(texture)
    if image is None:
        image = _decode(texture, round(texture.width * ratio), round(texture.height * ratio), images)
    light = to_linear(np.arange(256) / 255)
    uv, shade = part.uv[part.faces], part.shade[part.faces]

    def shine(faces: slice, weights: np.ndarray) -> np.ndarray:
        place = wrap_coordinates(np.einsum("kc,fci->fki", weights, uv[faces]), texture.wrap)
        colour = sample_texture(image, place.reshape(-1, 2)).reshape(*place.shape[:2], 3)
        return from_linear(light[colour] * np.maximum(np.einsum("kc,fci->fki", weights, shade[faces]), 0))

    pixels, place = bake(len(part.faces), side, shine)
    return split_corners(part), Chart(pixels.shape[1], pixels.shape[0], pixels=pixels), place
