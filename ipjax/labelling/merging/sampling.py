"""Which frames a person should look at: those that tell most about whether the labels can be trusted."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ipjax.labelling.merging.consistency import Collision, Jump
from ipjax.labelling.merging.poses import Poses

APART = 5  # frames between two of one reason, at least
DOUBT = 0.75  # confidence of a present pose below which it is doubtful
TIE = 0.25  # margin below which another pose is nearly as good
MISFIT = 0.6  # overlap of the given mask and that of the pose, below which one of them is wrong


@dataclasses.dataclass(frozen=True)
class Choice:
    """A frame to look at, by its place, the rows of its poses that it is about, and why."""

    place: int
    rows: tuple[int, ...]
    reason: str


def choose_frames(
    poses: Poses, jumps: Sequence[Jump], collisions: Sequence[Collision], count: int, seed: int = 0
) -> list[Choice]:
    """At most ``count`` frames, the most telling of each reason in turn; the last reason is chance, as a check on the
    others.

    Args:
        seed: of that chance.
    """
    rows = np.flatnonzero(poses.present)
    kinds: list[list[Choice]] = [
        [
            Choice(
                int(poses.place[one.row]),
                (one.row,),
                f"jumps: {one.moved:.2f} diameters and {np.degrees(one.turned):.0f}° off its neighbours",
            )
            for one in sorted(jumps, key=lambda one: -(one.moved + one.turned))
        ],
        [
            Choice(
                int(poses.place[one.first]),
                (one.first, one.second),
                f"two objects in one place: each lies by {one.share:.0%} in the other's box",
            )
            for one in sorted(collisions, key=lambda one: -one.share)
        ],
        _lowest(poses, rows, poses.margin, TIE, "another pose is nearly as good: margin {:.2f}"),
        _lowest(poses, rows, poses.confidence, DOUBT, "just believed: confidence {:.2f}"),
        _lowest(poses, rows, poses.overlap, MISFIT, "the pose does not fit its mask: overlap {:.2f}"),
        [
            Choice(int(poses.place[row]), (int(row),), "picked by chance")
            for row in np.random.default_rng(seed).permutation(rows)[: 8 * count]
        ],
    ]
    chosen: list[Choice] = []
    left: list[Choice] = []
    taken: dict[int, list[int]] = {}
    while len(chosen) < count and any(kinds):
        for number, kind in enumerate(kinds):
            while kind and len(chosen) < count:
                one = kind.pop(0)
                near = any(abs(one.place - place) < APART for place in taken.get(number, ()))
                if not near and one.place not in (other.place for other in chosen):
                    chosen.append(one)
                    taken.setdefault(number, []).append(one.place)
                    break
                left.append(one)
    for one in left:  # of few frames also those that are beside another
        if len(chosen) < count and one.place not in (other.place for other in chosen):
            chosen.append(one)
    return chosen


def _lowest(poses: Poses, rows: np.ndarray, values: np.ndarray, limit: float, words: str) -> list[Choice]:
    """Poses whose value is below a limit, the lowest first."""
    low = rows[values[rows] < limit]  # NaN is not
    low = low[np.argsort(values[low], kind="stable")]
    return [Choice(int(poses.place[row]), (int(row),), words.format(values[row])) for row in low]
