"""The largest distance among many points, by bounds on groups of them rather than by all pairs."""

import math

import numpy as np
from jaxtyping import Float

CLOSE = 1e-9  # relative: pairs that can only be longer by less than this are not looked at
GROUPS = 2048  # of points at most; their bounds are compared pair by pair
PAIRS = 1 << 21  # distances that are held at a time
_multiply = np.matmul  # of all pairs that are compared: tests count them


def largest_distance(points: Float[np.ndarray, "n 3"]) -> float:
    """The largest distance between two of the points, to 1e-9 of itself.

    Branch and bound. With c a centre of the points and r the distances from it, no pair is longer than r_p + r_q: that
    leaves few points of most shapes, and none of a sphere once one diameter is known. The rest are split into groups,
    and two groups are compared only where the ball and the cone around each allow a longer pair than the longest so
    far. Time is quadratic only for bodies of constant width that are no spheres, memory is bounded always.
    """
    if len(points) < 2:
        return 0.0
    low, high = points.min(0), points.max(0)
    centred = points - (low + high) / 2
    pair = _sweep(centred)
    centre = _middle(centred, pair)
    centred = centred - centre
    best = _length(centred, pair)
    radius = np.linalg.norm(centred, axis=-1)
    keep = np.flatnonzero(radius + radius.max() > best * (1 + CLOSE))
    if len(keep):
        found = _compare(centred[keep], radius[keep], best)
        if found is not None:
            pair = (int(keep[found[0]]), int(keep[found[1]]))
    return math.dist(points[pair[0]], points[pair[1]])


def _length(points: np.ndarray, pair: tuple[int, int]) -> float:
    return float(np.linalg.norm(points[pair[0]] - points[pair[1]]))


def _sweep(points: np.ndarray) -> tuple[int, int]:
    """A pair that is nearly the farthest: from the ends along many directions, on to the farthest of each."""
    count = 48
    height = 1 - (np.arange(count) + 0.5) / count  # half a sphere of directions
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)
    best, pair = -1.0, (0, 0)
    for direction in directions:
        along = points @ direction
        ends = (int(along.argmin()), int(along.argmax()))
        length = _length(points, ends)
        if length > best:
            best, pair = length, ends
    for _ in range(8):
        start = pair[1]
        end = int(((points - points[start]) ** 2).sum(1).argmax())
        length = _length(points, (start, end))
        if length <= best:
            break
        best, pair = length, (start, end)
    return pair


def _middle(points: np.ndarray, pair: tuple[int, int]) -> np.ndarray:
    """A centre of a small ball around all points (Bădoiu and Clarkson 2003), or the pair's middle if that is better."""
    centre = middle = (points[pair[0]] + points[pair[1]]) / 2
    reach = float(((points - middle) ** 2).sum(1).max())
    for step in range(1, 40):
        squared = ((points - centre) ** 2).sum(1)
        far = int(squared.argmax())
        if squared[far] < reach:
            reach, middle = float(squared[far]), centre
        centre = centre + (points[far] - centre) / (step + 1)
    return middle


def _compare(points: np.ndarray, radius: np.ndarray, best: float) -> tuple[int, int] | None:
    """The farthest pair if it is longer than `best`, by groups of points; None if there is none."""
    order, size = _split(points)
    groups = order.reshape(-1, size)
    members = points[groups]  # the last group repeats a point: no harm
    middle = (members.min(1) + members.max(1)) / 2
    ball = np.linalg.norm(members - middle[:, None], axis=-1).max(1)
    reach = radius[groups].max(1)
    # The cone around a group, seen from the centre: its axis and half its opening.
    axis = middle / np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), 1e-300)
    inner = np.einsum("gki,gi->gk", members, axis) / np.maximum(radius[groups], 1e-300)
    opening = np.arccos(np.clip(inner.min(1), -1, 1)) + 1e-7
    found = None
    count = len(groups)
    rows = max(1, PAIRS // count)
    for start in range(0, count, rows):
        mine = slice(start, min(start + rows, count))
        apart = np.linalg.norm(middle[mine, None] - middle[None], axis=-1) + ball[mine, None] + ball[None]
        angle = np.arccos(np.clip(-axis[mine] @ axis.T, -1, 1)) - opening[mine, None] - opening[None]
        a, b = reach[mine, None], reach[None]
        cosine = np.cos(np.clip(angle, 0, np.pi))
        # Past a right angle the larger radius need not be the better.
        seen = np.sqrt(a * a + b * b + 2 * a * b * np.maximum(cosine, 0))
        bound = np.minimum(apart, np.minimum(seen, a + b))
        first, second = np.nonzero(np.triu(bound > best * (1 + CLOSE), start))
        values = bound[first, second]
        turn = np.argsort(-values)
        first, second, values = first[turn] + start, second[turn], values[turn]
        batch = max(1, PAIRS // size**2)
        for begin in range(0, len(first), batch):
            if values[begin] <= best * (1 + CLOSE):
                break
            i, j = first[begin : begin + batch], second[begin : begin + batch]
            product = _multiply(members[i], members[j].swapaxes(1, 2))
            squared = (radius[groups[i]] ** 2)[:, :, None] + (radius[groups[j]] ** 2)[:, None] - 2 * product
            at = int(squared.argmax())
            length = math.sqrt(max(float(squared.ravel()[at]), 0.0))
            if length > best:
                which, one, two = np.unravel_index(at, squared.shape)
                best, found = length, (int(groups[i[which], one]), int(groups[j[which], two]))
    return found


def _split(points: np.ndarray) -> tuple[np.ndarray, int]:
    """An order of the points in which every run of `size` of them lies close together, padded with the last."""
    size = max(32, -(-len(points) // GROUPS))
    levels = max(0, math.ceil(math.log2(max(len(points) / size, 1))))
    size = -(-len(points) // 2**levels)
    order = np.concatenate([np.arange(len(points)), np.full(size * 2**levels - len(points), len(points) - 1)])
    for level in range(levels):
        boxes = points[order].reshape(2**level, -1, 3)
        widest = np.ptp(boxes, axis=1).argmax(1)
        along = np.take_along_axis(boxes, widest[:, None, None], axis=2)[..., 0]
        half = along.shape[1] // 2
        turn = np.argpartition(along, half, axis=1)
        order = np.take_along_axis(order.reshape(2**level, -1), turn, axis=1).ravel()
    return order, size
