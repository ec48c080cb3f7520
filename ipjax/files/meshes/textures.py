"""Images on meshes: opened by their header, decoded at the size that is needed, packed into one image.

Nothing is decoded before all sizes are known: what a file asks for is counted first, and a texture that would be
reduced afterwards is reduced while it is read.
"""

import dataclasses
import hashlib
import io
import math
import warnings
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, UInt8

MAX_TEXTURE = 4096  # texels per side of the texture that a mesh keeps
MAX_PIXELS = 8192 * 8192  # of one image in a file
MAX_PIXELS_IN_ALL = 8 * MAX_PIXELS  # of all images of one file: each is decoded once
MAX_REPEATS = 64  # of an image along one side of a packed texture
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF", "DDS", "PPM")  # none that runs a program
GUTTER = 2  # texels around every image of a packed texture, so that neighbours do not show at its border


def to_linear(colours: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    colours = np.asarray(colours, np.float64)
    return np.where(colours <= 0.04045, colours / 12.92, ((np.maximum(colours, 0) + 0.055) / 1.055) ** 2.4)


def from_linear(light: np.ndarray) -> UInt8[np.ndarray, "..."]:
    """Linear light to sRGB bytes; what is not in [0, 1] is clipped, NaN is 0."""
    light = np.clip(np.nan_to_num(np.asarray(light, np.float64)), 0, 1)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(curve * 255).astype(np.uint8)


def sample_texture(texture: UInt8[np.ndarray, "th tw 3"], uv: Float[np.ndarray, "k 2"]) -> UInt8[np.ndarray, "k 3"]:
    """Bilinear colours at (u, v); v = 0 is the bottom row of the image, and the image repeats."""
    height, width = texture.shape[:2]
    result = np.empty((len(uv), 3), np.uint8)
    for start in range(0, len(uv), 1 << 18):  # in blocks: the blend is made in float64
        u, v = uv[start : start + (1 << 18)].T
        x, y = u * width - 0.5, (1 - v) * height - 0.5
        column, row = np.floor(x), np.floor(y)
        fx, fy = (x - column)[:, None], (y - row)[:, None]
        c0, r0 = column.astype(np.int64) % width, row.astype(np.int64) % height
        c1, r1 = (c0 + 1) % width, (r0 + 1) % height
        upper = texture[r0, c0] * (1 - fx) + texture[r0, c1] * fx
        lower = texture[r1, c0] * (1 - fx) + texture[r1, c1] * fx
        result[start : start + len(x)] = np.round(upper * (1 - fy) + lower * fy)
    return result


class TextureError(ValueError):
    """An image that cannot be read; the mesh can, without it."""


@dataclasses.dataclass(frozen=True)
class Texture:
    """An image of a mesh file, not yet decoded, and what is done to its colours: ``light * tint + offset + plus``.

    Two with the same key are the same image.
    """

    name: str = dataclasses.field(compare=False)
    data: bytes = dataclasses.field(repr=False, compare=False)
    width: int
    height: int
    key: bytes = dataclasses.field(repr=False)
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)  # in linear light
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    plus: "Texture | None" = None
    wrap: tuple[str, str] = ("repeat", "repeat")  # along u and v: repeat, mirror, clamp

    def decode(self, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
        """The image with at most this many texels a side, each the mean of those that it replaces.

        Raises TextureError where the data ends early or is of no known format.
        """
        pixels = _decode(self.name, self.data, min(width, self.width), min(height, self.height))
        if self.plus is None and self.tint == (1, 1, 1) and self.offset == (0, 0, 0):
            return pixels
        curve = to_linear(np.arange(256) / 255)[:, None] * np.array(self.tint) + np.array(self.offset)
        if self.plus is None:
            table = from_linear(curve)
            return np.stack([table[pixels[..., i], i] for i in range(3)], axis=-1)
        other = self.plus.decode(pixels.shape[1], pixels.shape[0])
        rows = np.arange(len(pixels)) * len(other) // len(pixels)
        columns = np.arange(pixels.shape[1]) * other.shape[1] // pixels.shape[1]
        light = to_linear(np.arange(256) / 255)
        for row in range(len(pixels)):
            base = np.stack([curve[pixels[row, :, i], i] for i in range(3)], axis=-1)
            pixels[row] = from_linear(base + light[other[rows[row], columns]])
        return pixels


def open_texture(name: str, data: bytes) -> Texture:
    """The texture in these bytes, by its header alone.

    Raises TextureError for what is no image; ValueError for one of more than MAX_PIXELS, which is not decoded.
    """
    from PIL import Image

    if data.startswith(b"version https://git-lfs"):
        raise TextureError(f"{name} is a Git LFS pointer, not the image (git lfs pull fetches it)")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                width, height = image.size
    except Image.DecompressionBombError:
        raise ValueError(f"the texture {name} has more than {MAX_PIXELS:,} pixels: make it smaller") from None
    except Exception:
        raise TextureError(f"{name} is no image of a format that is read here") from None
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"the texture {name} has {width} × {height} pixels, more than {MAX_PIXELS:,}: make it smaller "
            f"({MAX_TEXTURE} a side are kept)"
        )
    return Texture(name, data, width, height, hashlib.blake2b(data, digest_size=16).digest())


def _decode(name: str, data: bytes, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                image.draft("RGB", (width, height))  # a JPEG is decoded at half or a quarter of its size
                image.load()
                step = max(1, min(image.width // width, image.height // height))
                if image.mode.startswith(("I", "F")):
                    image = _from_wide(np.asarray(image))
                # In strips, for a conversion and a reduction of the whole would each hold it once more. Alpha is
                # left out first: Pillow would weight colours by it.
                strips = []
                rows = max(1, (1 << 22) // max(image.width, 1) // step) * step
                for top in range(0, image.height, rows):
                    strip = image.crop((0, top, image.width, min(top + rows, image.height))).convert("RGB")
                    strips.append(np.asarray(strip.reduce(step) if step > 1 else strip))
        pixels = np.concatenate(strips)
        if pixels.shape[:2] != (height, width):
            pixels = np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))
        return np.array(pixels, np.uint8)
    except MemoryError:
        raise
    except Exception as error:
        raise TextureError(f"{name} cannot be read ({' '.join(str(error).split())[:80]})") from None


def _from_wide(values: np.ndarray):
    """A grey image of more than eight bits as one of eight."""
    from PIL import Image

    top = 1.0 if values.dtype.kind == "f" else 65535.0
    return Image.fromarray(np.round(np.clip(np.nan_to_num(values / top), 0, 1) * 255).astype(np.uint8))


# --- packing -------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Chart:
    """An image in a packed texture: one of the file, repeated, or one made of colours; `lay_out` sets its corner."""

    width: int  # of one repeat
    height: int
    repeats: tuple[int, int] = (1, 1)
    pixels: UInt8[np.ndarray, "h w 3"] | None = None
    left: int = 0
    top: int = 0

    @property
    def span(self) -> tuple[int, int]:
        """Texels across and down, all repeats, without the gutter."""
        return self.width * self.repeats[0], self.height * self.repeats[1]


def lay_out(charts: list[Chart]) -> tuple[int, int]:
    """Place all charts in rows, tallest first, and set the corner of each. Returns the whole's width and height."""
    order = sorted(range(len(charts)), key=lambda i: (-charts[i].span[1], i))
    sides = [(chart.span[0] + 2 * GUTTER, chart.span[1] + 2 * GUTTER) for chart in charts]
    limit = max(math.ceil(math.sqrt(sum(width * height for width, height in sides))), *(width for width, _ in sides))
    x = y = row_height = 0
    for i in order:
        width, height = sides[i]
        if x + width > limit and x > 0:
            x, y, row_height = 0, y + row_height, 0
        charts[i].left, charts[i].top = x + GUTTER, y + GUTTER
        x, row_height = x + width, max(row_height, height)
    return limit, y + row_height


def paint(charts: list[Chart], width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """The packed texture: every chart at its corner, its border repeated into the gutter."""
    canvas = np.zeros((height, width, 3), np.uint8)
    for chart in charts:
        if chart.pixels is None:
            continue
        across, down = chart.span
        rows = np.clip(np.arange(-GUTTER, down + GUTTER), 0, down - 1) % chart.height
        columns = np.clip(np.arange(-GUTTER, across + GUTTER), 0, across - 1) % chart.width
        top, left = chart.top - GUTTER, chart.left - GUTTER
        canvas[top : top + len(rows), left : left + len(columns)] = chart.pixels[rows[:, None], columns]
    return canvas


def bake(
    count: int, side: int, colour_faces: Callable[[slice, np.ndarray], np.ndarray]
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "k 2"]]:
    """An image of blocks of ``side`` × ``side`` texels (at least 2), one per face, for colours that vary over faces.

    ``colour_faces(faces, weights)`` gives the colours of a slice of faces at the barycentric weights [side² 3], as
    [faces side² 3] uint8; beyond the long side of the triangle the weights go below 0. Returns the image, and where
    the three corners of every face are in it (x, y in texels from its upper left).
    """
    columns = math.ceil(math.sqrt(count))
    rows = -(-count // columns)
    canvas = np.zeros((rows, side, columns, side, 3), np.uint8)
    step = np.arange(side) / (side - 1)
    b, c = np.broadcast_to(step, (side, side)).ravel(), np.repeat(step, side)
    weights = np.stack([1 - b - c, b, c], axis=-1)
    stride = max(1, (1 << 18) // (columns * side * side))
    for start in range(0, rows, stride):
        stop = min(start + stride, rows)
        faces = slice(start * columns, min(stop * columns, count))
        blocks = np.zeros(((stop - start) * columns, side * side, 3), np.uint8)
        blocks[: faces.stop - faces.start] = colour_faces(faces, weights)
        canvas[start:stop] = blocks.reshape(stop - start, columns, side, side, 3).transpose(0, 2, 1, 3, 4)
    index = np.arange(count)
    first = np.stack([index % columns * side + 0.5, index // columns * side + 0.5], axis=-1)
    places = first[:, None] + (side - 1) * np.array([[0, 0], [1, 0], [0, 1]])
    return canvas.reshape(rows * side, columns * side, 3), places.reshape(-1, 2)


def wrap_coordinates(uv: Float[np.ndarray, "*k 2"], wrap: tuple[str, str]) -> Float[np.ndarray, "*k 2"]:
    """Coordinates in [0, 1] that show the same texel as these under repeating, mirroring or clamping."""
    uv = np.array(uv)
    for axis, how in enumerate(wrap):
        if how == "clamp":
            uv[..., axis] = np.clip(uv[..., axis], 0, 1)
        elif how == "mirror":
            uv[..., axis] = 1 - np.abs(uv[..., axis] % 2 - 1)
    return uv


def fit_repeats(
    uv: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "k 2"], Int[np.ndarray, "m 3"], Int[np.ndarray, " k"]]:
    """Every face moved by whole images to where its coordinates begin in [0, 1): the repeats that are left are those
    within one face.

    Returns new coordinates, new faces, and the old vertex of each new one; a vertex whose faces moved by different
    amounts is there once for each.
    """
    if len(faces) == 0 or (uv.min() >= -1e-3 and uv.max() <= 1 + 1e-3):
        return uv, faces, np.arange(len(uv))
    shift = np.floor(uv[faces].min(axis=1) + 1e-6)
    moved = np.concatenate([faces.reshape(-1, 1), np.repeat(shift, 3, axis=0)], axis=1)
    rows, index = np.unique(moved, axis=0, return_inverse=True)
    source = rows[:, 0].astype(np.int64)
    return uv[source] - rows[:, 1:], index.reshape(-1, 3), source
