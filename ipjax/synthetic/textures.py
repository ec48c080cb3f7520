"""Random printed textures, from a seed, for synthetic objects, tables and walls."""

import numpy as np
from jaxtyping import UInt8

TEXTURE = 512  # texels on a side


def make_texture(seed: int, size: int = TEXTURE) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """A printed surface: a few colours, bands, panels, dots, rows of invented letters, and grain."""
    rng = np.random.default_rng([seed, 7])
    palette = make_palette(rng, 6)
    image = make_marble(rng, size, palette[0], palette[1])
    for _ in range(rng.integers(3, 6)):
        _paint_band(rng, image, palette)
    for _ in range(rng.integers(10, 16)):
        _paint_panel(rng, image, palette)
    for _ in range(rng.integers(14, 22)):
        _paint_letters(rng, image, palette)
    grain = rng.normal(0, 5, (size, size, 1)) + 18 * (_smooth_noise(rng, size, 24) - 0.5)[..., None]
    return np.clip(image + grain, 0, 255).astype(np.uint8)


def make_palette(rng: np.random.Generator, count: int) -> np.ndarray:
    """Colours that differ in hue and in brightness, [count 3] in 0 … 255."""
    hue = (rng.uniform() + np.arange(count) * 0.381966 + rng.normal(0, 0.03, count)) % 1
    value = rng.permutation(np.linspace(0.25, 1.0, count))
    saturation = rng.uniform(0.25, 0.95, count)
    wheel = np.clip(np.abs((hue[:, None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    return 255 * value[:, None] * (1 - saturation[:, None] * (1 - wheel))


def _smooth_noise(rng: np.random.Generator, size: int, cells: int) -> np.ndarray:
    """Smooth noise in [0, 1], `cells` bumps across."""
    coarse = rng.uniform(size=(cells + 3, cells + 3)).astype(np.float32)
    at = np.arange(size) / size * cells + 1
    low = np.floor(at).astype(int)
    part = (at - low).astype(np.float32)
    part = part * part * (3 - 2 * part)
    rows = coarse[low] * (1 - part[:, None]) + coarse[low + 1] * part[:, None]
    return rows[:, low] * (1 - part) + rows[:, low + 1] * part


def make_marble(rng: np.random.Generator, size: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Two colours [3] that run into each other in smooth veins, [size size 3] in the colours' range."""
    field = _smooth_noise(rng, size, 3) / 1.5 + _smooth_noise(rng, size, 8) / 3 + _smooth_noise(rng, size, 25) / 8
    blend = np.clip((field - field.mean()) * 2.5 + 0.5, 0, 1)[..., None]
    return first * (1 - blend) + second * blend


def _paint_band(rng: np.random.Generator, image: np.ndarray, palette: np.ndarray) -> None:
    size = len(image)
    start, width = rng.integers(0, size), int(rng.integers(size // 40, size // 10))
    where = (
        (slice(start, start + width), slice(None))
        if rng.uniform() < 0.5
        else (slice(None), slice(start, start + width))
    )
    image[where] = palette[rng.integers(len(palette))]


def _paint_panel(rng: np.random.Generator, image: np.ndarray, palette: np.ndarray) -> None:
    size = len(image)
    half = rng.uniform(0.03, 0.13, 2) * size
    x, y = rng.uniform(0, size, 2)
    left, right = max(int(x - half[0]), 0), min(int(x + half[0]) + 1, size)
    top, bottom = max(int(y - half[1]), 0), min(int(y + half[1]) + 1, size)
    rows, columns = np.mgrid[top:bottom, left:right]
    u, v = (columns - x) / half[0], (rows - y) / half[1]
    shape = rng.integers(4)
    if shape == 0:
        inside = np.ones_like(u, bool)
    elif shape == 1:
        inside = u**2 + v**2 < 1
    elif shape == 2:
        inside = np.abs(u) + np.abs(v) < 1
    else:
        inside = (v < 1 - 2 * np.abs(u)) & (v > -0.9)
    colour, rim = palette[rng.choice(len(palette), 2, replace=False)]
    part = image[top:bottom, left:right]
    part[inside] = colour
    part[inside & (np.maximum(np.abs(u), np.abs(v)) > 0.82)] = rim


def _paint_letters(rng: np.random.Generator, image: np.ndarray, palette: np.ndarray) -> None:
    """A line of an invented script: 5 × 4 bitmaps, half of them mirror-symmetric, as letters are."""
    size = len(image)
    zoom, count = int(rng.integers(2, 9)), int(rng.integers(3, 9))
    line = np.zeros((5, 5 * count), bool)
    for letter in range(count):
        bitmap = rng.uniform(size=(5, 4)) < 0.55
        if rng.uniform() < 0.5:
            bitmap[:, 2:] = bitmap[:, 1::-1]
        line[:, 5 * letter : 5 * letter + 4] = bitmap
    ink = line.repeat(zoom, 0).repeat(zoom, 1)
    if rng.uniform() < 0.35:
        ink = ink.T
    y, x = rng.integers(0, size, 2)
    part = image[y : y + ink.shape[0], x : x + ink.shape[1]]
    part[ink[: part.shape[0], : part.shape[1]]] = palette[rng.integers(len(palette))]
