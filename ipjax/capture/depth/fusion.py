"""One depth image of all that is known of a view: its own depth, its neighbours', and stereo."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from ipjax_kernels.depth.fusing import fuse_depth
from jaxtyping import Float

NEIGHBOURS = 4  # views whose depth is carried into one


@dataclasses.dataclass(frozen=True)
class FusedDepth:
    """Depth of one view, and how sure it is."""

    depth: Float[np.ndarray, "h w"]  # metres along z, 0 = unknown
    # Weight of what agrees over that of all that was seen and one more: 0 = unknown, a half = the view's own alone.
    confidence: Float[np.ndarray, "h w"]


def fuse(
    own: Float[np.ndarray, "h w"],
    others: Sequence[Float[np.ndarray, "h w"]],
    weights: Sequence[float] | None = None,
    *,
    slots: int | None = None,
) -> FusedDepth:
    """Fuse a view's own depth with that of others, seen from the same camera.

    The view's own depth counts, with what agrees with it. Holes are filled only where two others agree, and it gives
    way only to three that agree with one another while none agrees with it: frayed borders, mostly.

    Args:
      others: metres, 0 = unknown.
      weights: of the others, relative to its own; all 1 by default.
      slots: pad the others to so many, so that views with fewer neighbours need no other compilation.
    """
    nothing = np.zeros_like(own, np.float32)
    padded = [*others, *[nothing] * max((slots or 0) - len(others), 0)]
    if not padded:
        return FusedDepth(np.asarray(own, np.float32), np.where(own > 0, 0.5, 0).astype(np.float32))
    weight = np.ones(1 + len(padded), np.float32)
    if weights is not None:
        weight[1 : 1 + len(others)] = weights
    depth, confidence = fuse_depth(np.stack([own, *padded]).astype(np.float32), weight)
    return FusedDepth(np.asarray(depth), np.asarray(confidence))
