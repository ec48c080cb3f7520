"""Finding result files in another unit, in other axes, or of inverse poses, which would score 0 without a hint."""

import math
from collections.abc import Sequence

import numpy as np

from ipjax.bop.records import MM
from ipjax.transforms import Similarity

# What a file's translations are multiplied by when they are in another unit; other powers of ten have no name here.
_UNITS = {10.0**k: "" for k in range(-9, 10)} | {1e-3: "metres", 1e-1: "centimetres", 1 / 25.4: "inches"}
_MOST_TURNS = 60  # rotations that leave an icosahedron as it is; no other solid with finitely many has more
_ALIKE = 1 + 2 * math.cos(math.radians(15))  # the trace of a turn by 15°


def suspect_conventions(
    pairs: Sequence[tuple[Similarity[np.ndarray], Sequence[Similarity[np.ndarray]], np.ndarray]],
) -> str | None:
    """What is wrong with all of a file's poses, given each with those of the annotation and with the rotations of the
    object's symmetries: in words, or None. It takes what no failing method would produce: three quarters of the lengths
    off by the factor of another unit; half of the rotations right when transposed, and hardly any as they are; three
    quarters of the objects behind the camera, at the right distance."""
    if not pairs:
        return None
    estimates = np.stack([estimate.translation for estimate, _, _ in pairs])
    truths = np.stack([np.median([truth.translation for truth in truths], axis=0) for _, truths, _ in pairs])
    lengths = np.linalg.norm(estimates, axis=-1), np.linalg.norm(truths, axis=-1)
    ratio = np.maximum(lengths[0] / np.maximum(lengths[1], 1e-9), 1e-12)
    factor = min(_UNITS, key=lambda factor: abs(math.log(np.median(ratio) / factor)))
    alike = np.mean(np.abs(np.log(ratio / factor)) < math.log(1.25)) > 0.75
    few = len(pairs) < 3
    if alike and factor != 1 and not (few and 0.01 < factor < 100):
        off = f"{1 / factor:g} times too small" if factor < 1 else f"{factor:g} times too large"
        unit = f"; it seems to be in {_UNITS[factor]}" if _UNITS[factor] else ""
        middle = [f"{np.median(length) / MM:.4g}" for length in lengths]
        return (
            f"the translations are some {off} (median length {middle[0]}, annotated {middle[1]} mm): t must be in "
            f"millimetres{unit}"
        )
    if few:
        return None
    # The axis of a body of revolution may be right either way.
    turned = [pair for pair in pairs if len(pair[2]) <= _MOST_TURNS]
    right = [_is_turned_like(estimate.rotation, truths, same) for estimate, truths, same in turned]
    other = [_is_turned_like(estimate.rotation.T, truths, same) for estimate, truths, same in turned]
    if len(turned) >= 3 and np.mean(right) < 0.25 and np.mean(other) >= 0.5:
        return "the rotations are right when R is transposed: R and t must map the model into the camera's frame"
    if factor == 1 and alike and np.mean((estimates[:, 2] < 0) & (truths[:, 2] > 0)) > 0.75:
        return "the objects are behind the camera (z below 0): poses must be in OpenCV axes, x right, y down, z ahead"
    return None


def _is_turned_like(rotation: np.ndarray, truths: Sequence[Similarity[np.ndarray]], symmetries: np.ndarray) -> bool:
    """Whether a rotation is within 15° of one of the true ones, up to the object's symmetries."""
    return any((rotation * (truth.rotation @ symmetries)).sum((-2, -1)).max() > _ALIKE for truth in truths)
