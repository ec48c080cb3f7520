"""Pictures that show whether depth and colours fit."""

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from ipjax.capture.depth.figures import find_jumps

_FACTORY, _MADE = (255, 64, 64), (64, 255, 96)


def draw_depths(
    rgb: UInt8[np.ndarray, "h w 3"],
    factory: Float[np.ndarray, "h w"],
    made: Float[np.ndarray, "h w"],
    confidence: Float[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "hp wp 3"]:
    """Colours with the jumps of both depths (the factory's red, this one green), both depths, and the confidence."""
    import cv2

    edges = rgb.copy()
    for depth, colour in ((factory, _FACTORY), (made, _MADE)):
        edges[find_jumps(_close(depth))] = colour
    known = np.concatenate([depth[depth > 0] for depth in (factory, made)])
    near, far = np.percentile(known, [1, 95]) if len(known) else (0.0, 1.0)
    panels = [edges, _paint(made, near, far), _paint(factory, near, far)]
    panels.append(np.repeat(np.round(255 * confidence).astype(np.uint8)[..., None], 3, axis=-1))
    words = ("jumps of depth: factory red, this green", "this depth", "the factory's depth", "confidence")
    for panel, text in zip(panels, words, strict=True):
        scale = max(rgb.shape[1] / 1200, 0.3)
        place = (8, round(34 * scale) + 4)
        cv2.putText(panel, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 2, cv2.LINE_AA)
        cv2.putText(panel, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([np.concatenate(panels[:2], axis=1), np.concatenate(panels[2:], axis=1)], axis=0)


def _paint(depth, near, far) -> np.ndarray:
    import cv2

    share = np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
    image = cv2.applyColorMap(np.round(255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    image[depth <= 0] = 0
    return image


def _close(depth) -> np.ndarray:
    """Small holes take the farthest depth beside them, so that jumps across them show."""
    return np.where(depth > 0, depth, ndimage.maximum_filter(depth, 5))
