"""The obvious NumPy loop for `ipjax_kernels.closing`: the oracle of the tests."""

import numpy as np


def close_hands(points, normals, seen, linear, offset, hand, retreat, depth, facing, centred=False):
    """One hand after another, one point after another. Returns the fields of ``closing.Touch`` by name."""
    found = {name: [] for name in ("hits", "low", "high", "facing", "cosine", "seen", "contact", "centre")}
    for matrix, shift in zip(linear, offset, strict=True):
        placed = np.array([matrix @ point + shift for point in points])
        along = np.array([matrix[0] @ normal / np.linalg.norm(matrix[0]) for normal in normals])
        low, high = _ends(placed, hand)
        centre = (low + high) / 2 if centred and low <= high else 0.0
        placed[:, 0] -= centre
        if centred:
            low, high = _ends(placed, hand)
        hits, under = 0, ([], [])
        for k, (u, v, w) in enumerate(placed):
            in_finger = hand.opening / 2 <= abs(u) < hand.opening / 2 + hand.thickness and abs(v) < hand.breadth / 2
            hit = in_finger and hand.root - retreat < w < hand.tip
            for low_corner, high_corner in zip(hand.low, hand.high, strict=True):
                reached = low_corner - np.array([0, 0, retreat])
                hit |= bool(((placed[k] > reached) & (placed[k] < high_corner)).all())
            hits += hit
            if _is_between(placed[k], hand) and w > hand.pad:
                if u <= low + depth and along[k] < -facing:
                    under[0].append(k)
                if u >= high - depth and along[k] > facing:
                    under[1].append(k)
        mean = lambda values, chosen, empty: np.mean(values[chosen]) if chosen else empty
        found["hits"].append(hits)
        found["low"].append(low)
        found["high"].append(high)
        found["facing"].append([len(side) for side in under])
        found["cosine"].append([mean(np.abs(along), side, 0.0) for side in under])
        found["seen"].append([mean(seen, side, 0.0) for side in under])
        middle = (hand.pad + hand.tip) / 2
        found["contact"].append(
            [
                [end, mean(placed[:, 1], side, 0.0), mean(placed[:, 2], side, middle)]
                for end, side in zip((low, high), under, strict=True)
            ]
        )
        found["centre"].append(centre)
    return {name: np.asarray(values, np.float64) for name, values in found.items()}


def _is_between(place, hand):
    u, v, w = place
    return abs(v) < hand.breadth / 2 and hand.root < w < hand.tip and abs(u) < hand.opening / 2


def _ends(placed, hand):
    inside = [place[0] for place in placed if _is_between(place, hand)]
    return (min(inside), max(inside)) if inside else (np.inf, -np.inf)
