"""Which frames are compared, and which belong together: by what they share, by angle and by distance."""

import numpy as np
from jaxtyping import Float, Int

from ipjax.capture.refinement.graph import Pairs
from ipjax.transforms import Similarity, vector_from_rotation

ANGLE = np.deg2rad(40)  # within which the frames of a group look
DISTANCE = 0.5  # metres, within which they stand


def all_pairs(count: int) -> Pairs:
    """Every frame with every other, both ways."""
    source, target = np.nonzero(~np.eye(count, dtype=bool))
    return Pairs(source, target)


def choose_pairs(shares: Float[np.ndarray, "n n"], partners: int, least: float = 0.1) -> Pairs:
    """Of every frame the pairs with those ``partners`` that see most of what it sees, both ways.

    Args:
      shares: of what frame i sees, how much frame j sees, too.
      least: pairs that share less are of no use.
    """
    both = np.minimum(shares, shares.T)
    np.fill_diagonal(both, 0)
    order = np.argsort(-both, axis=1, kind="stable")[:, :partners]
    kept = np.zeros(both.shape, bool)
    np.put_along_axis(kept, order, True, axis=1)
    kept &= both > least
    return Pairs(*np.nonzero(kept | kept.T))


def group_frames(world_from_camera: Similarity[np.ndarray]) -> Int[np.ndarray, " n"]:
    """The number of each frame's group: any two frames of a group look within `ANGLE` and stand within `DISTANCE`.

    The two nearest groups are joined, and again, as long as that holds (complete linkage).
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import squareform

    rotation, places = world_from_camera.rotation, world_from_camera.translation
    if len(places) < 2:
        return np.zeros(len(places), int)
    relative = np.einsum("iab,jac->ijbc", rotation, rotation)
    angle = np.linalg.norm(vector_from_rotation(relative), axis=-1)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    far = np.maximum(angle / ANGLE, apart / DISTANCE)
    far = (far + far.T) / 2
    np.fill_diagonal(far, 0)
    return fcluster(linkage(squareform(far, checks=False), "complete"), 1.0, "distance") - 1


def within(pairs: Pairs, groups: Int[np.ndarray, " n"]) -> Pairs:
    """Those pairs whose frames are of one group."""
    same = groups[pairs.source] == groups[pairs.target]
    return Pairs(pairs.source[same], pairs.target[same])
