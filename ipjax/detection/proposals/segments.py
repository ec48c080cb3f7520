"""Segments: small pieces of a frame that lie on one surface of one colour, and which of them touch."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ipjax.detection.proposals.surfaces import Surfaces


@dataclasses.dataclass(frozen=True)
class Segments:
    """A partition of the frame, with what trees and objectness need to know of its pieces."""

    labels: Int[np.ndarray, "h w"]  # 0 … s − 1
    area: Float[np.ndarray, " s"]  # pixels
    lab: Float[np.ndarray, "s 3"]  # mean
    normal: Float[np.ndarray, "s 3"]  # mean, shorter than 1 where they differ
    pairs: Int[np.ndarray, "p 2"]  # neighbours, the smaller label first
    length: Float[np.ndarray, " p"]  # of their common border, pixels


def make_segments(surfaces: Surfaces, count: int, compactness: float) -> Segments:
    """SLIC on colour, normals and inverse depth.

    Args:
      surfaces: the frame.
      count: how many segments, about.
      compactness: of SLIC, against colour: L* from 0 to 100 is 0.7.
    """
    from skimage.segmentation import slic

    trusted = surfaces.trusted[..., None]
    inverse = 1 / surfaces.depth
    if trusted.any():
        inverse = inverse / np.median(inverse[surfaces.trusted])
    features = np.concatenate(
        [
            surfaces.lab / 100 * np.array([0.7, 1.3, 1.3], np.float32),
            0.25 * surfaces.normals * trusted,
            2 * np.clip(inverse, 0, 4)[..., None] * trusted,
        ],
        axis=-1,
    )
    labels = slic(
        np.ascontiguousarray(features, np.float64),
        n_segments=count,
        # SLIC stretches features to a range of 1, which depth decides: without this, colour would count the less the
        # deeper the scene.
        compactness=compactness / max(float(np.ptp(features)), 1e-6),
        max_num_iter=10,
        start_label=0,
        convert2lab=False,
        channel_axis=-1,
    )
    _, flat = np.unique(labels, return_inverse=True)
    return describe_segments(surfaces, flat.reshape(labels.shape))


def describe_segments(surfaces: Surfaces, labels: Int[np.ndarray, "h w"]) -> Segments:
    """What is to be known of a partition with labels 0 … s − 1, none of them empty."""
    area = np.bincount(labels.reshape(-1)).astype(np.float64)
    mean = lambda values: np.stack(
        [np.bincount(labels.reshape(-1), values[..., k].reshape(-1)) / area for k in range(values.shape[-1])], -1
    )
    pairs, inverse = find_borders(labels)
    return Segments(
        labels=labels,
        area=area,
        lab=mean(surfaces.lab),
        normal=mean(surfaces.normals),
        pairs=pairs,
        length=np.bincount(inverse[inverse >= 0], minlength=len(pairs)).astype(np.float64),
    )


def find_borders(labels: Int[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, "p 2"], Int[np.ndarray, " b"]]:
    """Pairs of labels that touch, and the pair of every border of pixels, −1 inside a segment.

    Borders are in the order of `list_borders`: those to the right neighbours first, then those to the lower ones.
    """
    first = np.concatenate([labels[:, :-1].reshape(-1), labels[:-1].reshape(-1)])
    second = np.concatenate([labels[:, 1:].reshape(-1), labels[1:].reshape(-1)])
    many = int(labels.max()) + 1
    code = np.minimum(first, second).astype(np.int64) * many + np.maximum(first, second)
    apart = first != second
    codes, numbers = np.unique(code[apart], return_inverse=True)
    found = np.full(len(code), -1)
    found[apart] = numbers
    return np.stack([codes // many, codes % many], -1), found


def list_borders(values: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Values of all borders of pixels in one row."""
    return np.concatenate([values[0].reshape(-1), values[1].reshape(-1)])


def sum_over_pairs(labels: Int[np.ndarray, "h w"], values: tuple[np.ndarray, np.ndarray]) -> Float[np.ndarray, " p"]:
    """The sum of values over the common border of each pair of `find_borders`."""
    pairs, number = find_borders(labels)
    inside = number >= 0
    return np.bincount(number[inside], list_borders(values)[inside], minlength=len(pairs))
