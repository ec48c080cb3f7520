"""A picture that shows whether new views are right, and what of them is unknown."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from ipjax.capture.models.frames import PosedFrame

_MOST = 24  # views on a sheet
_TILE = 240  # pixels wide
_GAP = 4
_UNKNOWN = (np.array([255, 0, 255]), np.array([120, 0, 120]))  # stripes that no scene has


def draw_sheet(views: Sequence[PosedFrame], columns: int = 4) -> UInt8[np.ndarray, "h w 3"]:
    """Views, evenly picked, each with its depth beside it (near is bright); what is unknown is striped magenta."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(_MOST, len(views))).round().astype(int))
    tiles = [_draw(views[int(i)]) for i in chosen]
    height, width = tiles[0].shape[:2]
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3), 255, np.uint8)
    for index, tile in enumerate(tiles):
        y, x = (index // columns) * (height + _GAP), (index % columns) * (width + _GAP)
        sheet[y : y + height, x : x + width] = tile
    return sheet


def _draw(view: PosedFrame) -> UInt8[np.ndarray, "h w 3"]:
    width, height = view.size
    rows, columns = np.mgrid[:height, :width]
    stripes = np.where((((rows + columns) // 6) % 2)[..., None] > 0, *_UNKNOWN).astype(np.uint8)
    known = view.usable[..., None]
    depth = np.where(view.depth > 0, view.depth, np.nan)
    near, far = np.nanpercentile(depth, (1, 80)) if view.usable.any() else (0.0, 1.0)
    bright = np.nan_to_num(np.clip((far - depth) / max(far - near, 1e-6), 0, 1)) * 215 + 40
    grey = np.repeat(bright.astype(np.uint8)[..., None], 3, -1)
    both = np.hstack([np.where(known, view.rgb, stripes), np.where(known, grey, stripes)])
    tile = cv2.resize(both, (2 * _TILE, round(_TILE * height / width)), interpolation=cv2.INTER_AREA)
    text = f"{view.name}  {100 * view.usable.mean():.0f} % known"
    cv2.rectangle(tile, (0, 0), (8 * len(text), 15), (30, 30, 30), -1)
    cv2.putText(tile, text, (3, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)
    return tile
