"""Parts with textures, colours or neither, packed into one image."""

import dataclasses
import math

import numpy as np

from ipjax.files.meshes.formats.part import GREY, Part, drop_unused, split_corners
from ipjax.files.meshes.textures import (
    GUTTER,
    MAX_REPEATS,
    MAX_TEXTURE,
    Chart,
    Texture,
    bake,
    fit_repeats,
    from_linear,
    lay_out,
    paint,
    sample_texture,
    to_linear,
    wrap_coordinates,
)


def _decode(texture: Texture, width: int, height: int, images: dict[Texture, np.ndarray | None]) -> np.ndarray:
    """The image at about this size, decoded once; None is left in `images` for one that fails."""
    images[texture] = None
    found = texture.decode(max(width, 1), max(height, 1))
    images[texture] = found
    return found


def pack(parts: list[Part], images: dict[Texture, np.ndarray | None]) -> tuple[np.ndarray, np.ndarray, str, list[Part]]:
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
    colours = get_colours(part)
    corners = colours[part.faces]
    flat = (corners == corners[:, :1]).all((1, 2))
    result = []
    if flat.any():
        one = drop_unused(dataclasses.replace(part, faces=part.faces[flat], colours=colours))
        values = get_colours(one)
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

        def colour_faces(faces: slice, weights: np.ndarray) -> np.ndarray:
            mixed = np.einsum("kc,fci->fki", weights, corners[faces].astype(np.float64))
            return np.round(np.clip(mixed, 0, 255)).astype(np.uint8)

        pixels, place = bake(len(corners), 4 if len(corners) < 300_000 else 2, colour_faces)
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

    def colour_faces(faces: slice, weights: np.ndarray) -> np.ndarray:
        place = wrap_coordinates(np.einsum("kc,fci->fki", weights, uv[faces]), texture.wrap)
        colour = sample_texture(image, place.reshape(-1, 2)).reshape(*place.shape[:2], 3)
        return from_linear(light[colour] * np.maximum(np.einsum("kc,fci->fki", weights, shade[faces]), 0))

    pixels, place = bake(len(part.faces), side, colour_faces)
    return split_corners(part), Chart(pixels.shape[1], pixels.shape[0], pixels=pixels), place


def get_colours(part: Part) -> np.ndarray:
    """Colours of the part's vertices as bytes; plain grey where it has none."""
    return np.full((len(part.vertices), 3), GREY, np.uint8) if part.colours is None else part.colours
