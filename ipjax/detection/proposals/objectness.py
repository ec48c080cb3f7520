"""Objectness: how much a mask looks like that of one whole thing, judged by its border, its inside and its shape."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.detection.proposals.segments import Segments, find_borders, list_borders
from ipjax.detection.proposals.surfaces import Surfaces

# Steps of depth (a share of it), of colour (ΔE) and between normals (1 − cosine) that are as strong as can be.
_JUMP, _CONTRAST, _CREASE = 0.03, 44.0, 0.4
_WEAK = 0.25  # of such a step; a border weaker than this is hardly seen


@dataclasses.dataclass(frozen=True)
class Steps:
    """What is known of every border between pixels, those to the right neighbours first, then those to lower ones."""

    strength: Float[np.ndarray, " b"]  # of depth, colour or normals, whichever is stronger; 0 to 1
    jump: Float[np.ndarray, " b"]  # of depth or normals, 0 to 1
    falls: Float[np.ndarray, " b"]  # the same with a sign: positive where the second pixel lies behind
    weak: Float[np.ndarray, " b"]  # 1 where the strength is hardly seen
    trusted: Float[np.ndarray, " b"]  # 1 where depth is known on both sides

    def stack(self) -> Float[np.ndarray, "b 5"]:
        """All of them, in the order of the fields."""
        return np.stack([self.strength, self.jump, self.falls, self.weak, self.trusted], -1)


@dataclasses.dataclass(frozen=True)
class Measures:
    """What is measured of each of n masks."""

    strength: Float[np.ndarray, " n"]  # mean along the border inside the image, 0 to 1
    jump: Float[np.ndarray, " n"]  # of depth or normals alone
    ahead: Float[np.ndarray, " n"]  # −1 to 1: jumps by which the mask lies before, less those by which behind
    weak: Float[np.ndarray, " n"]  # share of the border that is hardly seen
    at_rim: Float[np.ndarray, " n"]  # share of the border that is the image's
    share: Float[np.ndarray, " n"]  # of the image that the mask covers
    compactness: Float[np.ndarray, " n"]  # 4 π area / border²
    solidity: Float[np.ndarray, " n"]  # area by that of the ellipse of the same second moments, 1 for an ellipse
    inner: Float[np.ndarray, " n"]  # mean step of depth or normals inside
    on_plane: Float[np.ndarray, " n"]  # share of the mask that lies on a large plane
    length: Float[np.ndarray, " n"]  # metres from end to end, as far as is seen; 0 where depth is unknown
    votes: Float[np.ndarray, " n"]  # of how many of the ways of making masks nearly the same came

    def stack(self) -> Float[np.ndarray, "n f"]:
        """As features of a linear score, with one of ones. Length is none: things may have any size."""
        log_share = np.log(np.maximum(self.share, 1e-6))
        columns = [
            np.ones_like(self.strength),
            self.strength,
            self.jump,
            self.ahead,
            self.weak,
            self.at_rim,
            log_share,
            (log_share + 4) ** 2,
            np.minimum(self.compactness, 0.7),
            np.minimum(self.solidity, 1.0),
            self.inner,
            self.on_plane,
            np.log1p(self.votes),
        ]
        return np.stack(columns, -1)


def find_steps(surfaces: Surfaces) -> Steps:
    """The steps between neighbouring pixels of a frame."""
    jump = np.minimum(list_borders(surfaces.jump) / _JUMP, 1)
    contrast = np.minimum(list_borders(surfaces.contrast) / _CONTRAST, 1)
    crease = np.minimum(list_borders(surfaces.crease) / _CREASE, 1)
    strength = np.maximum(np.maximum(jump, contrast), crease)
    depth, trusted = surfaces.depth, surfaces.trusted
    falls = list_borders((depth[:, 1:] - depth[:, :-1], depth[1:] - depth[:-1]))
    known = list_borders((trusted[:, 1:] & trusted[:, :-1], trusted[1:] & trusted[:-1]))
    weak = (strength < _WEAK).astype(np.float64)
    return Steps(strength, np.maximum(jump, crease), jump * np.sign(falls), weak, known.astype(np.float64))


def measure_regions(
    members: Bool[np.ndarray, "n s"], segments: Segments, steps: Steps, surfaces: Surfaces, on: Bool[np.ndarray, "h w"]
) -> Measures:
    """Masks that are made of segments."""
    labels = segments.labels
    many = len(segments.area)
    first, _ = find_ends(labels)
    pairs, number = find_borders(labels)
    values = steps.stack()
    apart = number >= 0
    # The sign of a fall is that of the border's own first pixel, which may be of either of the pair's segments.
    turned = np.where(first[apart] == pairs[number[apart], 0], 1.0, -1.0)
    sums = np.stack([np.bincount(number[apart], v[apart], len(pairs)) for v in values.T], -1)
    falls = np.bincount(number[apart], steps.falls[apart] * turned, len(pairs))
    begins, ends = members[:, pairs[:, 0]], members[:, pairs[:, 1]]
    crossed = (begins ^ ends).astype(np.float32)
    length = crossed @ segments.length.astype(np.float32)
    total = crossed @ sums.astype(np.float32)
    total[:, 2] = (begins.astype(np.float32) - ends) @ falls.astype(np.float32)
    # Inside: all borders of its segments, with those between two of them.
    within = np.stack([np.bincount(first[~apart], v, many) for v in (steps.jump[~apart], steps.trusted[~apart])], -1)
    between = (begins & ends).astype(np.float32) @ sums[:, [1, 4]].astype(np.float32)
    holds = members.astype(np.float32)
    inside = holds @ within.astype(np.float32) + between
    rim = np.bincount(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]), minlength=many)
    per_pixel = _pixel_values(surfaces, on)
    moments = np.stack([np.bincount(labels.reshape(-1), v, many) for v in per_pixel.T], -1)
    return _describe(length, total, holds @ rim, inside, members @ moments, surfaces)


def measure_masks(
    masks: Bool[np.ndarray, "n h w"], steps: Steps, surfaces: Surfaces, on: Bool[np.ndarray, "h w"]
) -> Measures:
    """Any masks, one after another: they are fewer than those made of segments."""
    values, per_pixel = steps.stack(), _pixel_values(surfaces, on)
    rows = []
    for mask in masks:
        first, second = find_ends(mask)
        crossed = np.flatnonzero(first ^ second)
        sign = np.where(first[crossed], 1.0, -1.0)
        total = values[crossed].sum(0)
        total[2] = values[crossed, 2] @ sign
        inner = values[first & second][:, [1, 4]].sum(0)
        rim = mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum()
        rows.append((len(crossed), total, rim, inner, per_pixel[mask.reshape(-1)].sum(0)))
    shapes = ((), (5,), (), (2,), (per_pixel.shape[1],))
    length, total, rim, inner, moments = (
        np.array([r[k] for r in rows], float).reshape(-1, *shape) for k, shape in enumerate(shapes)
    )
    return _describe(length, total, rim, inner, moments, surfaces)


def find_ends(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of every border between pixels the values on its two sides."""
    return list_borders((image[:, :-1], image[:-1])), list_borders((image[:, 1:], image[1:]))


def count_votes(
    masks: Bool[np.ndarray, "n k"], ways: Int[np.ndarray, " n"], overlap: float = 0.75
) -> Float[np.ndarray, " n"]:
    """How many ways of making masks, a bit each, gave nearly the same one; masks are rows of few pixels."""
    holds = masks.astype(np.float32)
    area = holds.sum(1)
    common = holds @ holds.T
    alike = common > overlap * (area[:, None] + area - common)
    alike |= np.eye(len(masks), dtype=bool)
    each = np.unpackbits(ways.astype("<i8").view(np.uint8).reshape(-1, 8), axis=1).astype(np.float32)
    return (alike.astype(np.float32) @ each > 0).sum(1).astype(np.float64)


# Of a logistic regression on 24 made scenes, half of whose things are scans of HOPE: `benchmarks.proposals --fit 24`.
# In the order of `Measures.stack`. They were fitted while segments were a little less compact; the command now gives
# each to within 1.1 of these, and the results page was measured with these.
WEIGHTS = np.array([-3.83, -0.38, 6.21, 3.10, -2.28, -5.39, 0.53, -0.19, -1.97, 5.24, -1.68, -2.81, 0.57])


def judge(measures: Measures) -> Float[np.ndarray, " n"]:
    """Objectness, a logit: the higher, the likelier the mask is of one whole thing."""
    return measures.stack() @ WEIGHTS


def _pixel_values(surfaces: Surfaces, on: np.ndarray) -> Float[np.ndarray, "p 9"]:
    """What is summed over each mask: 1, x, y, x², xy, y², if it is on a plane, depth where it is trusted, if it is."""
    y, x = np.indices(surfaces.shape, dtype=np.float64).reshape(2, -1)
    trusted = surfaces.trusted.reshape(-1)
    depth = surfaces.depth.reshape(-1) * trusted
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, on.reshape(-1), depth, trusted], -1)


def _describe(length, total, rim, inside, moments, surfaces: Surfaces) -> Measures:
    area, x, y, xx, xy, yy, on, depth, trusted = moments.T
    around, inner = np.maximum(length + rim, 1), np.maximum(length, 1)
    x, y, some = x / np.maximum(area, 1), y / np.maximum(area, 1), np.maximum(area, 1)
    # A pixel is a square: it has a spread of 1 / 12 of its own.
    xx, xy, yy = xx / some - x * x + 1 / 12, xy / some - x * y, yy / some - y * y + 1 / 12
    determinant = np.maximum(xx * yy - xy * xy, 1e-6)
    longest = (xx + yy) / 2 + np.sqrt(np.maximum(((xx - yy) / 2) ** 2 + xy * xy, 0))
    focal = np.sqrt(surfaces.camera[0, 0] * surfaces.camera[1, 1])
    return Measures(
        strength=total[:, 0] / inner,
        jump=total[:, 1] / inner,
        ahead=total[:, 2] / inner,
        weak=total[:, 3] / inner,
        at_rim=rim / around,
        share=area / surfaces.depth.size,
        compactness=4 * np.pi * area / around**2 * (4 / np.pi) ** 2,  # a border of pixels is 4 / π too long
        solidity=area / (4 * np.pi * np.sqrt(determinant)),
        inner=inside[:, 0] / np.maximum(inside[:, 1], 1),
        on_plane=on / some,
        length=np.sqrt(12 * longest) * depth / np.maximum(trusted, 1) / focal,  # of a bar of that spread
        votes=np.zeros(len(area)),
    )
