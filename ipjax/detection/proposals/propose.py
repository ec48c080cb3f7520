"""Proposals of masks in an RGB-D frame: many are made, those that differ and look like things are kept."""

import dataclasses
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ipjax.detection.proposals.components import find_components
from ipjax.detection.proposals.objectness import border_strength, judge, measure_masks, measure_regions
from ipjax.detection.proposals.planes import find_planes
from ipjax.detection.proposals.segments import make_segments, sum_over_pairs
from ipjax.detection.proposals.surfaces import Surfaces, make_surfaces
from ipjax.detection.proposals.trees import AFFINITIES, grow_tree
from ipjax.files.cameras.reading import as_intrinsics


@dataclasses.dataclass(frozen=True)
class ProposalConfig:
    """Settings of `propose`."""

    most: int = 64  # proposals that are kept
    side: int = 320  # pixels of the longer side that the image is cut up at
    segments: int = 500
    compactness: float = 0.12  # of the segments
    planes: int = 3  # sought at most
    plane_tolerance: float = 0.008  # metres at 1 m; grows with z^1.5
    plane_share: float = 0.05  # of the image that a plane covers at least
    least: float = 0.0012  # share of the image that a proposal covers at least
    largest: float = 0.25  # and at most
    overlap: float = 0.7  # IoU from which the lesser of two proposals is dropped
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
    height, width = depth.shape
    scale = min(config.side / max(height, width), 1.0)
    small = max(round(width * scale), 16), max(round(height * scale), 16)
    surfaces = make_surfaces(rgb, depth, matrix, *small)
    masks, objectness = _make_masks(surfaces, config)
    kept = suppress(masks, objectness, config.overlap, config.most)
    large = np.zeros((len(kept), height, width), bool)
    for index, number in enumerate(kept):
        large[index] = enlarge(masks[number], width, height)
    return Proposals(large, objectness[kept])


def _make_masks(surfaces: Surfaces, config: ProposalConfig) -> tuple[np.ndarray, np.ndarray]:
    """Every proposal at the frame's working size, with its objectness."""
    planes = find_planes(surfaces, config.planes, config.plane_tolerance, config.plane_share, config.seed)
    on = np.zeros(surfaces.shape, bool)
    for pixels, _ in planes:
        on |= pixels
    segments = make_segments(surfaces, config.segments, config.compactness)
    labels = segments.labels
    border = {
        "jump": sum_over_pairs(labels, surfaces.jump),
        "crease": sum_over_pairs(labels, surfaces.crease),
        "contrast": sum_over_pairs(labels, surfaces.contrast),
    }
    on_plane = np.bincount(labels.reshape(-1), on.reshape(-1)) > 0.5 * segments.area
    trees = [np.eye(len(segments.area), dtype=bool)]
    for affinity in AFFINITIES:
        trees += [grow_tree(segments, border, affinity, barred, config.largest) for barred in (None, on_plane)]
    members = np.concatenate(trees)
    share = members @ segments.area / labels.size
    members = np.unique(members[(share >= config.least) & (share <= config.largest)], axis=0)
    pieces = find_components(surfaces, ~on & surfaces.trusted)
    share = pieces.mean((1, 2))
    pieces = pieces[(share >= config.least) & (share <= config.largest)]
    strength = border_strength(surfaces)
    objectness = np.concatenate(
        [judge(measure_regions(members, segments, strength)), judge(measure_masks(pieces, strength))]
    )
    return np.concatenate([members[:, labels], pieces]), objectness


def suppress(
    masks: Bool[np.ndarray, "n h w"], objectness: Float[np.ndarray, " n"], overlap: float, most: int
) -> np.ndarray:
    """The numbers of the best masks, best first, of which no two overlap by more than an IoU of ``overlap``."""
    packed = np.packbits(masks.reshape(len(masks), -1), axis=1)
    packed = np.pad(packed, ((0, 0), (0, -packed.shape[1] % 8))).view(np.uint64)
    order = np.argsort(-objectness, kind="stable")
    packed, area = packed[order], masks.sum((1, 2))[order]
    alive, kept = np.ones(len(order), bool), []
    while alive.any() and len(kept) < most:
        best = int(alive.argmax())
        kept.append(best)
        rest = np.flatnonzero(alive)
        common = np.bitwise_count(packed[rest] & packed[best]).sum(1, dtype=np.int64)
        alive[rest[common > overlap * (area[rest] + area[best] - common)]] = False
        alive[best] = False
    return order[kept]


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
    if config.most < 1 or config.side < 32 or config.segments < 2:
        raise ValueError("most must be at least 1, side at least 32 and segments at least 2")
    if not 0 < config.least < config.largest <= 1:
        raise ValueError(f"least and largest must be shares, the smaller first: {config.least:g}, {config.largest:g}")
    with np.errstate(over="ignore", invalid="ignore"):
        metres = depth.astype(np.float32)
    metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))
    return np.ascontiguousarray(rgb), metres, as_intrinsics(camera).matrix
