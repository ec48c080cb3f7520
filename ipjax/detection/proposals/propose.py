"""Proposals of masks in an RGB-D frame: many are made, those that differ and look like things are kept."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ipjax.cameras import resize_pixels
from ipjax.detection.proposals.candidates import Candidates, Cutting, make_candidates
from ipjax.detection.proposals.objectness import Measures, count_votes, judge
from ipjax.detection.proposals.planes import find_planes, mark_planes
from ipjax.detection.proposals.surfaces import make_surfaces
from ipjax.files.cameras.reading import as_intrinsics

_SIZES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28)  # metres, of balls that are tried at a click where no size is known
_LONGER = 1.4  # times its diameter: a thing is not seen longer than that, depth and masks being what they are


@dataclasses.dataclass(frozen=True)
class ProposalConfig:
    """Settings of `propose`."""

    most: int = 64  # proposals that are kept
    cuttings: tuple[Cutting, ...] = (Cutting(), Cutting(side=640, segments=1200, least=0.0004, largest=0.02, most=400))
    planes: int = 3  # sought at most
    plane_tolerance: float = 0.008  # metres at 1 m; grows with z^1.5
    plane_share: float = 0.05  # of the image that a plane covers at least
    overlap: float = 0.7  # IoU from which the lesser of two proposals is dropped
    # Metres, of the things that are sought, where they are known: balls of that size are tried, too, and masks that are
    # longer than the largest are left out.
    diameters: tuple[float, ...] = ()
    at: tuple[tuple[float, float], ...] = ()  # pixels (x, y), one of which every proposal has; none = anywhere
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Proposals:
    """Masks that may be of one object each."""

    masks: Bool[np.ndarray, "n h w"]  # in the image's size, best first
    objectness: Float[np.ndarray, " n"]  # what they are sorted by


def propose(rgb: Any, depth: Any, camera: Any, config: ProposalConfig | None = None) -> Proposals:
    """Masks of what may be an object, best first.

    Args:
      rgb: height × width × 3, uint8.
      depth: height × width, metres along z; 0, NaN, infinite and negative = unknown, which all of it may be.
      camera: `Intrinsics`, `Camera`, 3 × 3 K or (fx, fy, cx, cy), pixels. Distortion is passed over.
      config: settings; the same frame, camera and settings give the same proposals.

    Returns:
      At most ``config.most`` masks; none where nothing stands out.

    Raises:
      ValueError: shapes, types or settings that cannot be right, in words.
    """
    config = ProposalConfig() if config is None else config
    rgb, depth, matrix = _check(rgb, depth, camera, config)
    made = make_all(rgb, depth, matrix, config)
    masks, measures, owner = pool(made)
    if not len(masks):
        return Proposals(np.zeros((0, *depth.shape), bool), np.zeros(0))
    objectness = np.concatenate([judge(each) for each in measures])
    if config.diameters:
        length = np.concatenate([each.length for each in measures])
        objectness = np.where(length > _LONGER * max(config.diameters), -np.inf, objectness)
    height, width = depth.shape
    if config.at:
        objectness = np.where(_have(masks, config.at, (width, height)), objectness, -np.inf)
    kept = suppress(masks, objectness, config.overlap, config.most)
    kept = kept[np.isfinite(objectness[kept])]
    large = np.zeros((len(kept), height, width), bool)
    for index, number in enumerate(kept):
        which, row = owner[number].tolist()
        large[index] = enlarge(made[which].mask(row), width, height)
    return Proposals(large, objectness[kept])


def make_all(rgb: np.ndarray, depth: np.ndarray, matrix: np.ndarray, config: ProposalConfig) -> list[Candidates]:
    """The candidates of every resolution; no resolution is used that exceeds the image's, except the first."""
    height, width = depth.shape
    longer = max(height, width)
    made, planes = [], []
    for index, cutting in enumerate(config.cuttings):
        if index and longer <= config.cuttings[index - 1].side:
            break
        scale = min(cutting.side / longer, 1.0)
        small = max(round(width * scale), 16), max(round(height * scale), 16)
        surfaces = make_surfaces(rgb, depth, matrix, *small)
        if not index:
            planes = find_planes(surfaces, config.planes, config.plane_tolerance, config.plane_share, config.seed)
        on = mark_planes(surfaces, planes, config.plane_tolerance)
        if index:
            made.append(make_candidates(surfaces, on, cutting))
            continue
        pixels = [tuple(resize_pixels(np.asarray(one, float), (width, height), small).tolist()) for one in config.at]
        sizes = config.diameters or (_SIZES if pixels else ())
        made.append(make_candidates(surfaces, on, cutting, sizes, pixels))
    return made


def pool(made: list[Candidates]) -> tuple[np.ndarray, list[Measures], np.ndarray]:
    """All masks at the first one's resolution, what is measured of them, and whose they are: (resolution, number)."""
    height, width = made[0].labels.shape
    masks = np.concatenate([one.sample(width, height) for one in made])
    step = max(round(max(height, width) / 80), 1)
    few = masks[:, step // 2 :: step, step // 2 :: step]
    few = few.reshape(len(masks), few.shape[1] * few.shape[2])
    votes = count_votes(few, np.concatenate([m.ways for m in made]))
    begin = np.cumsum([len(one.ways) for one in made])[:-1]
    each = [dataclasses.replace(one.measures, votes=v) for one, v in zip(made, np.split(votes, begin), strict=True)]
    owner = [(which, row) for which, one in enumerate(made) for row in range(len(one.ways))]
    return masks, each, np.array(owner, int).reshape(-1, 2)


def suppress(
    masks: Bool[np.ndarray, "n h w"], objectness: Float[np.ndarray, " n"], overlap: float, most: int
) -> np.ndarray:
    """The numbers of the best masks, best first, of which no two overlap by more than an IoU of ``overlap``."""
    packed = np.packbits(masks.reshape(len(masks), -1), axis=1)
    packed = np.ascontiguousarray(np.pad(packed, ((0, 0), (0, -packed.shape[1] % 8)))).view(np.uint64)
    order = np.argsort(-objectness, kind="stable")
    packed = packed[order]
    area = np.bitwise_count(packed).sum(1, dtype=np.int64)
    alive, kept = np.ones(len(order), bool), []
    while alive.any() and len(kept) < most:
        best = int(alive.argmax())
        kept.append(best)
        # Masks whose areas differ by more cannot overlap by so much.
        rest = np.flatnonzero(alive & (area >= overlap * area[best]) & (area * overlap <= area[best]))
        common = np.bitwise_count(packed[rest] & packed[best]).sum(1, dtype=np.int64)
        alive[rest[common > overlap * (area[rest] + area[best] - common)]] = False
        alive[best] = False
    return order[kept]


def _have(masks: np.ndarray, pixels: Sequence[tuple[float, float]], size: tuple[int, int]) -> np.ndarray:
    """Which masks, at whatever resolution, have one of these pixels of an image of this width and height, or one beside
    it: borders are that uncertain."""
    height, width = masks.shape[1:]
    found = np.zeros(len(masks), bool)
    for pixel in pixels:
        x, y = np.floor(resize_pixels(np.asarray(pixel, float), size, (width, height)) + 0.5).astype(int).tolist()
        found |= masks[:, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].any((1, 2))
    return found


def enlarge(mask: Bool[np.ndarray, "h w"], width: int, height: int) -> np.ndarray:
    """A mask at the image's size, its border smooth."""
    if mask.shape == (height, width):
        return mask
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def _check(rgb: Any, depth: Any, camera: Any, config: ProposalConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rgb, depth = np.asarray(rgb), np.asarray(depth)
    shown = lambda image: " × ".join(map(str, image.shape)) or "a number"
    if rgb.ndim != 3 or rgb.shape[-1] != 3:
        raise ValueError(f"rgb must be height × width × 3, not {shown(rgb)}")
    if rgb.dtype != np.uint8:
        raise ValueError(f"rgb must be uint8, not {rgb.dtype}")
    if depth.shape != rgb.shape[:2]:
        raise ValueError(f"depth of {shown(depth)} does not fit rgb of {shown(rgb)}: give it height × width, aligned")
    if depth.dtype.kind != "f":
        raise ValueError(f"depth must be metres as floats, not {depth.dtype}")
    if min(depth.shape) < 16:
        raise ValueError(f"an image of {shown(depth)} is too small for proposals: 16 pixels at least on a side")
    if config.most < 1 or not config.cuttings:
        raise ValueError("most must be at least 1, and cuttings name at least one resolution")
    for cutting in config.cuttings:
        if cutting.side < 32 or cutting.segments < 2:
            raise ValueError("a cutting has a side of at least 32 pixels and at least 2 segments")
        if not 0 < cutting.least < cutting.largest <= 1:
            raise ValueError(f"least and largest are shares, the smaller first: {cutting.least:g}, {cutting.largest:g}")
    if not all(0 <= x < depth.shape[1] and 0 <= y < depth.shape[0] for x, y in np.round(config.at).tolist()):
        raise ValueError(f"at: {list(config.at)} are not all pixels of the image")
    if not all(np.isfinite(config.diameters)) or min(config.diameters, default=1) <= 0:
        raise ValueError(f"diameters are positive metres, not {list(config.diameters)}")
    with np.errstate(over="ignore", invalid="ignore"):
        metres = depth.astype(np.float32)
    metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))
    return np.ascontiguousarray(rgb), metres, as_intrinsics(camera).matrix
