"""All masks that one resolution gives: joins of segments under several affinities, and pieces off the planes."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from ipjax.detection.proposals.components import find_basins, find_components
from ipjax.detection.proposals.objectness import Measures, find_steps, judge, measure_masks, measure_regions
from ipjax.detection.proposals.segments import Segments, make_segments, sum_over_pairs
from ipjax.detection.proposals.surfaces import Surfaces
from ipjax.detection.proposals.trees import AFFINITIES, grow_tree
from ipjax.detection.proposals.windows import find_windows


@dataclasses.dataclass(frozen=True)
class Cutting:
    """How one resolution is cut up."""

    side: int = 320  # pixels of the image's longer side
    segments: int = 500
    compactness: float = 0.25  # of the segments
    least: float = 0.0012  # share of the image that a mask covers at least
    largest: float = 0.25  # and at most
    most: int = 800  # masks that are compared with one another, the best by what each shows alone


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Masks of one resolution, first those made of segments, then any others."""

    labels: Int[np.ndarray, "h w"]
    members: Bool[np.ndarray, "n s"]
    pieces: Bool[np.ndarray, "m h w"]
    ways: Int[np.ndarray, " k"]  # a bit for each way in which it was made
    measures: Measures

    def mask(self, number: int) -> Bool[np.ndarray, "h w"]:
        """One of them, at the resolution that it was made at."""
        rest = number - len(self.members)
        return self.members[number][self.labels] if rest < 0 else self.pieces[rest]

    def sample(self, width: int, height: int) -> Bool[np.ndarray, "k h w"]:
        """All of them at another resolution, a pixel for a pixel."""
        rows = ((np.arange(height) + 0.5) * self.labels.shape[0] / height).astype(int)[:, None]
        columns = ((np.arange(width) + 0.5) * self.labels.shape[1] / width).astype(int)
        return np.concatenate([self.members[:, self.labels[rows, columns]], self.pieces[:, rows, columns]])


def make_candidates(
    surfaces: Surfaces,
    on: Bool[np.ndarray, "h w"],
    cutting: Cutting,
    diameters: Sequence[float] = (),
    at: Sequence[tuple[float, float]] = (),
) -> Candidates:
    """Every mask of a frame at its resolution, of the sizes that are allowed.

    Args:
      surfaces: the frame.
      on: the pixels of large planes.
      cutting: how it is cut up.
      diameters: metres, of the things that are sought, where they are known.
      at: pixels (x, y) of these surfaces, one of which all that is sought has; none = anywhere.
    """
    segments = make_segments(surfaces, cutting.segments, cutting.compactness)
    members, ways = _join(surfaces, segments, on, cutting)
    least = int(cutting.least * on.size)
    off = ~on & surfaces.trusted
    kinds = [
        find_components(surfaces, off, least=least),
        find_basins(surfaces, least=least),
        find_windows(surfaces, off, diameters, least=least, at=at),
    ]
    kinds = [kind[kind.mean((1, 2)) <= cutting.largest] for kind in kinds]
    pieces = np.concatenate(kinds)
    steps = find_steps(surfaces)
    bits = 1 << (1 + 2 * len(AFFINITIES) + np.arange(len(kinds)))
    ways = np.concatenate([ways, np.repeat(bits, [len(kind) for kind in kinds])])
    measures = [
        measure_regions(members, segments, steps, surfaces, on),
        measure_masks(pieces, steps, surfaces, on),
    ]
    names = [field.name for field in dataclasses.fields(Measures)]
    both = Measures(**{name: np.concatenate([getattr(m, name) for m in measures]) for name in names})
    best = np.sort(np.argsort(-judge(both), kind="stable")[: cutting.most])
    some = Measures(**{name: getattr(both, name)[best] for name in names})
    regions = best[best < len(members)]
    return Candidates(segments.labels, members[regions], pieces[best[len(regions) :] - len(members)], ways[best], some)


def _join(surfaces: Surfaces, segments: Segments, on: np.ndarray, cutting: Cutting) -> tuple[np.ndarray, np.ndarray]:
    """Segments, and all joins of the trees; each once, with a bit for each tree that has it."""
    labels = segments.labels
    border = {
        "jump": sum_over_pairs(labels, surfaces.jump),
        "crease": sum_over_pairs(labels, surfaces.crease),
        "contrast": sum_over_pairs(labels, surfaces.contrast),
    }
    on_plane = np.bincount(labels.reshape(-1), on.reshape(-1)) > 0.5 * segments.area
    trees = [np.eye(len(segments.area), dtype=bool)]
    for affinity in AFFINITIES:
        trees += [grow_tree(segments, border, affinity, barred, cutting.largest) for barred in (None, on_plane)]
    members = np.concatenate(trees)
    ways = np.repeat(1 << np.arange(len(trees)), [len(tree) for tree in trees])
    share = members @ segments.area / labels.size
    fits = (share >= cutting.least) & (share <= cutting.largest)
    members, ways = members[fits], ways[fits]
    # Equal sets have equal sums of large random numbers, and others do not.
    keys = np.random.default_rng(0).integers(1 << 52, size=len(segments.area))
    _, first, same = np.unique(members @ keys, return_index=True, return_inverse=True)
    together = np.zeros(len(first), ways.dtype)
    np.bitwise_or.at(together, same, ways)
    return members[first], together
