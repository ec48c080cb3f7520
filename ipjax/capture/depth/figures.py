"""How good aligned depth is, told without the truth: by stereo, by neighbouring frames, by edges of the colours."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from ipjax.capture.depth.rigs import Rig
from ipjax.capture.depth.stereo import Views, choose_neighbours

_NEAR = 0.04  # of the depth: two that differ by more are of different surfaces


@dataclasses.dataclass(frozen=True)
class Figures:
    """Of one way to align depth, over a few frames; nan = could not be told."""

    filled: float  # share of the pixels whose depth is known
    off_stereo: float  # median distance from the stereo that is sure, metres
    off_neighbours: float  # median distance from the same way's depth of a neighbouring frame, metres
    edge_contrast: float  # how much steeper the colours are where depth jumps than beside, 1 = not at all

    def tell(self) -> str:
        """The figures in words, for the report of a step."""
        number = lambda value, unit: "unknown" if value != value else f"{1e3 * value:.1f} {unit}"
        contrast = "unknown" if self.edge_contrast != self.edge_contrast else f"{self.edge_contrast:.2f} times"
        return (
            f"{100 * self.filled:.1f} % filled, {number(self.off_stereo, 'mm')} from stereo, "
            f"{number(self.off_neighbours, 'mm')} between frames, colours {contrast} as steep where depth jumps"
        )


def measure_modes(
    maker: Any, rig: Rig, indices: Sequence[int], *, progress: Callable[[str, int, int], None] | None = None
) -> dict[str, Figures]:
    """The three modes side by side, on some frames of a `DepthMaker`; none where these have no poses."""
    ways = {
        "solve": lambda index: maker.by_rig(index, rig).depth,
        "paper": maker.by_paper,
        "factory": maker.by_factory,
    }
    views: Views = maker.shrink()
    chosen = [index for index in indices if maker.trajectory.registered[index]]
    if len(views.indices) < 3 or not chosen:
        return {}
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in ways}
    for done, index in enumerate(chosen):
        place = views.indices.index(index)
        stereo = maker.stereo(place)
        near = choose_neighbours(views, place)[0]
        for name, way in ways.items():
            depth = way(index)
            beside = way(views.indices[near[0]]) if near else np.zeros_like(depth)
            rows[name].append(_measure(maker, views, place, near[0] if near else place, depth, beside, stereo, index))
        if progress is not None:
            progress("comparing", done + 1, len(chosen))
    result = {}
    for name, each in rows.items():
        table = np.array(each, float)
        known = np.isfinite(table)
        columns = [np.median(table[known[:, k], k]) if known[:, k].any() else np.nan for k in range(table.shape[1])]
        result[name] = Figures(*(float(x) for x in columns))
    return result


def _measure(maker, views, place, other, depth, beside, stereo, index) -> tuple[float, ...]:
    small, small_beside = (_shrink(image, views.size) for image in (depth, beside))
    both = stereo.sure & (small > 0)
    apart = np.abs(small - stereo.depth)[both]
    near = apart[apart < _NEAR * small[both]]
    off_stereo = float(np.median(near)) if len(near) > 50 else np.nan
    return (
        float((depth > 0).mean()),
        off_stereo,
        _between(views, place, other, small, small_beside),
        _edge_contrast(maker.read(index).rgb, depth),
    )


def _between(views, place, other, depth, beside) -> float:
    points = views.lift(depth)[depth > 0]
    if not len(points) or place == other:
        return np.nan
    moved = views.pose(other).inverse() @ (views.pose(place) @ points)
    pixels = moved[:, :2] / np.maximum(moved[:, 2:], 1e-6) * views.K[[0, 1], [0, 1]] + views.K[:2, 2]
    column, row = np.round(pixels).astype(int).T
    width, height = views.size
    inside = (moved[:, 2] > 0.05) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    there = beside[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    apart = np.abs(there - moved[:, 2])
    near = inside & (there > 0) & (apart < _NEAR * moved[:, 2])
    return float(np.median(apart[near])) if near.sum() > 50 else np.nan


def _edge_contrast(rgb: np.ndarray, depth: Float[np.ndarray, "h w"]) -> float:
    """The colours' slope on the jumps of the depth over that 6 pixels beside them."""
    steep = np.max([ndimage.gaussian_gradient_magnitude(rgb[..., k].astype(np.float32), 1.0) for k in range(3)], axis=0)
    jumps = find_jumps(depth)
    if jumps.sum() < 50:
        return np.nan
    away = np.asarray(ndimage.distance_transform_edt(~jumps))
    beside = (away > 5) & (away < 8)
    return float(steep[jumps].mean() / max(steep[beside].mean(), 1e-6))


def find_jumps(depth: Float[np.ndarray, "h w"], jump: float = 0.03) -> np.ndarray:
    """The nearer side of the places where depth jumps between known neighbours."""
    far = ndimage.maximum_filter(depth, 3)
    return (depth > 0) & (far - depth > jump * np.maximum(depth, 1e-6))


def _shrink(depth: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "hs ws"]:
    """Every few pixels, the one in the middle."""
    height, width = depth.shape
    rows = np.clip(((np.arange(size[1]) + 0.5) * height / size[1]).astype(int), 0, height - 1)
    columns = np.clip(((np.arange(size[0]) + 0.5) * width / size[0]).astype(int), 0, width - 1)
    return np.asarray(depth, np.float64)[rows][:, columns]
