"""Objectness: how much a mask looks like that of one whole thing, judged by its border."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ipjax.detection.proposals.segments import Segments, find_borders, list_borders
from ipjax.detection.proposals.surfaces import Surfaces


@dataclasses.dataclass(frozen=True)
class Borders:
    """What is measured along the border of each of n masks."""

    strength: Float[np.ndarray, " n"]  # mean along the border inside the image, 0 to 1
    at_rim: Float[np.ndarray, " n"]  # share of the border that is the image's
    share: Float[np.ndarray, " n"]  # of the image that the mask covers
    compactness: Float[np.ndarray, " n"]  # 4 π area / border²


def border_strength(surfaces: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Of every border of pixels: 1 where depth jumps by 3 % or colour changes by a ΔE of 44, less where by less."""
    pair = zip(surfaces.jump, surfaces.contrast, strict=True)
    first, second = (np.minimum(np.maximum(jump / 0.03, 0.8 * contrast / 35), 1) for jump, contrast in pair)
    return first, second


def measure_regions(members: Bool[np.ndarray, "n s"], segments: Segments, strength: tuple) -> Borders:
    """The borders of masks that are made of segments."""
    labels = segments.labels
    pairs, number = find_borders(labels)
    sums = np.bincount(number[number >= 0], list_borders(strength)[number >= 0], minlength=len(pairs))
    weights = np.stack([segments.length, sums], -1).astype(np.float32)
    crossed = (members[:, pairs[:, 0]] ^ members[:, pairs[:, 1]]).astype(np.float32)
    length, total = (crossed @ weights).T
    rim = np.bincount(
        np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]), minlength=len(segments.area)
    )
    return _describe(length, total, members @ rim, members @ segments.area, labels.size)


def measure_masks(masks: Bool[np.ndarray, "n h w"], strength: tuple) -> Borders:
    """The borders of any masks."""
    across, down = masks[:, :, 1:] ^ masks[:, :, :-1], masks[:, 1:] ^ masks[:, :-1]
    length = across.sum((1, 2)) + down.sum((1, 2))
    flat = lambda edges: edges.reshape(len(edges), np.prod(edges.shape[1:])).astype(np.float32)
    total = flat(across) @ strength[0].reshape(-1) + flat(down) @ strength[1].reshape(-1)
    rim = masks[:, 0].sum(-1) + masks[:, -1].sum(-1) + masks[:, :, 0].sum(-1) + masks[:, :, -1].sum(-1)
    return _describe(length, total, rim, masks.sum((1, 2)), masks[0].size if len(masks) else 1)


def judge(borders: Borders) -> Float[np.ndarray, " n"]:
    """Objectness: a strong border inside the image, a large area, a compact shape."""
    return (
        borders.strength
        - 0.5 * borders.at_rim
        + 0.05 * np.log(np.maximum(borders.share, 1e-6))
        + 0.1 * np.minimum(borders.compactness, 0.7)
    )


def _describe(length, total, rim, area, pixels) -> Borders:
    around = np.maximum(length + rim, 1)
    return Borders(
        strength=total / np.maximum(length, 1),
        at_rim=rim / around,
        share=area / pixels,
        compactness=4 * np.pi * area / around**2 * (4 / np.pi) ** 2,  # a border of pixels is 4 / π too long
    )
