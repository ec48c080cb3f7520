"""Borders of masks, moved by a pixel or two to where the photo has them.

A model is drawn where the camera was thought to stand, which is a pixel off for a millimetre. Beside the border, what
is surely inside and what is surely outside have colours, and the pixels between take the side that they are like.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

_BAND = 1 / 320  # of the image's width, on either side of the drawn border, that is asked
_BANDS = (1.0, 4.0)  # pixels that it is at least and at most
_AROUND = 1.5  # times that, standard deviation, from which the colours of a side are taken
_NOISE = 4.0  # ΔE that colours of one thing differ by anyway
_LOUDEST = 3.0  # of a pixel's evidence, as a logarithm of odds: one pixel's colour proves nothing
_PRIOR = 1.0  # logarithm of odds per pixel of distance from the drawn border
_SMALLEST = 30  # pixels of a mask that has an inside
_ABSENT = 1e9


def snap(
    rgb: UInt8[np.ndarray, "h w 3"], ids: Int[np.ndarray, "h w"], count: int, allowed: Bool[np.ndarray, "h w"]
) -> Int[np.ndarray, "h w"]:
    """Which thing each pixel shows, −1 = none, after colours were asked at the borders.

    Args:
      ids: as drawn.
      count: of things.
      allowed: where a mask may grow to.
    """
    blurred = cv2.GaussianBlur(rgb, (0, 0), 0.5).astype(np.float32) / 255
    lab = cv2.cvtColor(blurred, cv2.COLOR_RGB2Lab)
    best, found = np.zeros(ids.shape, np.float32), np.full(ids.shape, -1, ids.dtype)
    band = float(np.clip(_BAND * ids.shape[1], *_BANDS))
    margin = round((4 * _AROUND + 1) * band)
    for number in range(count):
        mask = ids == number
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if not len(rows):
            continue
        window = (
            slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
            slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
        )
        odds = _judge(lab[window], mask[window], band)
        surer = odds > best[window]
        best[window][surer] = odds[surer]
        found[window][surer] = number
    return np.where(allowed | (ids >= 0), found, -1).astype(ids.dtype)


def _judge(lab: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], band: float) -> Float[np.ndarray, "h w"]:
    """Logarithms of the odds that pixels show the thing; beyond the border's band they are as drawn."""
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    distance = np.where(mask, distance - 0.5, distance + 0.5)  # from the border, which is between two pixels
    drawn = np.where(mask, np.float32(_ABSENT), np.float32(-_ABSENT))
    if mask.sum() < _SMALLEST:
        return drawn
    share_in, mean_in, spread_in = _colours(lab, distance > band, _AROUND * band)
    share_out, mean_out, spread_out = _colours(lab, distance < -band, _AROUND * band)
    evidence = 0.5 * (((lab - mean_out) ** 2).sum(-1) / spread_out - ((lab - mean_in) ** 2).sum(-1) / spread_in)
    evidence += 1.5 * np.log(spread_out / spread_in)
    told = np.minimum(share_in, share_out) > 1e-3  # both sides are near
    evidence = cv2.GaussianBlur(
        np.where(told, np.clip(evidence, -_LOUDEST, _LOUDEST), 0).astype(np.float32), (0, 0), 0.7
    )
    return np.where(np.abs(distance) <= band, evidence + _PRIOR * distance, drawn).astype(np.float32)


def _colours(lab: np.ndarray, chosen: np.ndarray, around: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share, mean colour and variance per axis of the chosen pixels around each pixel."""
    weight = chosen.astype(np.float32)
    blur = lambda image: cv2.GaussianBlur(image, (0, 0), around)
    share = blur(weight)
    total = np.maximum(share, 1e-6)[..., None]
    mean = blur(lab * weight[..., None]) / total
    square = blur(lab**2 * weight[..., None]) / total
    return share, mean, np.maximum((square - mean**2).sum(-1) / 3, 0) + _NOISE**2
