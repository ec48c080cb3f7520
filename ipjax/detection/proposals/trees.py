"""Trees: segments joined one pair after another, the most alike first; every join is a possible object."""

import dataclasses
import heapq

import numpy as np
from jaxtyping import Bool, Float

from ipjax.detection.proposals.segments import Segments


@dataclasses.dataclass(frozen=True)
class Affinity:
    """What makes two regions unlike: weights of the steps across their border, and of their means' difference."""

    jump: float  # depth, per 3 %
    crease: float  # 1 − cosine across the border
    bend: float  # 1 − cosine of the mean normals
    contrast: float  # colour across the border, per ΔE of 35
    colour: float  # of the means, per ΔE of 35
    size: float = 0.3  # the power of the smaller region's share of the frame: small ones are joined first


GEOMETRY = Affinity(jump=1.0, crease=1.5, bend=0.2, contrast=0.0, colour=0.0)
BOTH = Affinity(jump=1.0, crease=1.0, bend=0.1, contrast=0.5, colour=0.5)
COLOUR = Affinity(jump=0.2, crease=0.0, bend=0.0, contrast=0.5, colour=1.0)
AFFINITIES = (GEOMETRY, BOTH, COLOUR)


def grow_tree(
    segments: Segments,
    border: dict[str, Float[np.ndarray, " p"]],
    affinity: Affinity,
    barred: Bool[np.ndarray, " s"] | None = None,
    largest: float = 0.3,
) -> Bool[np.ndarray, "n s"]:
    """All joins of one tree, as the segments that each holds.

    Args:
      segments: what is joined.
      border: sums of "jump", "crease" and "contrast" over the common borders of `segments.pairs`.
      affinity: what makes two regions unlike.
      barred: segments that take no part, for instance those of a table.
      largest: joins of more than this share of the frame are not made.
    """
    total = segments.area.sum()
    area = list(segments.area)
    lab, normal = [tuple(x) for x in segments.lab.tolist()], [tuple(x) for x in segments.normal.tolist()]
    steps = np.stack([segments.length, border["jump"], border["crease"], border["contrast"]], -1)
    neighbours: list[dict[int, np.ndarray]] = [{} for _ in area]
    for (a, b), step in zip(segments.pairs.tolist(), steps, strict=True):
        if barred is None or not (barred[a] or barred[b]):
            neighbours[a][b] = neighbours[b][a] = step

    def unlike(a: int, b: int) -> float:
        length, jump, crease, contrast = neighbours[a][b].tolist()
        one, other = lab[a], lab[b]
        colour = ((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2) ** 0.5
        one, other = normal[a], normal[b]
        bend = 1 - (one[0] * other[0] + one[1] * other[1] + one[2] * other[2])
        cost = affinity.jump * jump / 0.03 + affinity.crease * crease + affinity.contrast * contrast / 35
        cost = cost / length + affinity.bend * bend + affinity.colour * colour / 35
        return (cost + 0.02) * (min(area[a], area[b]) / total) ** affinity.size

    alive = [True] * len(area)
    queue = [(unlike(a, b), a, b) for a in range(len(area)) for b in neighbours[a] if a < b]
    heapq.heapify(queue)
    children: list[tuple[int, int]] = []
    while queue:
        _, a, b = heapq.heappop(queue)
        if not (alive[a] and alive[b]) or area[a] + area[b] > largest * total:
            continue
        new, both = len(area), area[a] + area[b]
        alive[a] = alive[b] = False
        alive.append(True)
        lab.append(tuple((area[a] * x + area[b] * y) / both for x, y in zip(lab[a], lab[b], strict=True)))
        normal.append(tuple((area[a] * x + area[b] * y) / both for x, y in zip(normal[a], normal[b], strict=True)))
        area.append(both)
        joined: dict[int, np.ndarray] = {}
        for old in (a, b):
            for other, step in neighbours[old].items():
                if other not in (a, b) and alive[other]:
                    joined[other] = joined[other] + step if other in joined else step
        neighbours.append(joined)
        for other, step in joined.items():
            neighbours[other][new] = step
            heapq.heappush(queue, (unlike(other, new), other, new))
        children.append((a, b))

    many = len(segments.area)
    members = np.zeros((many + len(children), many), bool)
    members[np.arange(many), np.arange(many)] = True
    for index, (a, b) in enumerate(children):
        members[many + index] = members[a] | members[b]
    return members[many:]
