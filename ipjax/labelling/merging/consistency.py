"""Poses that cannot all be right: one that jumps against its neighbours in time, and two objects in one place.

Nothing is known of the camera's motion: it may be led fast. But a pose that is farther from where its neighbours would
have it, half way between them, than they are from each other, is an outlier of a motion that a hand makes.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ipjax.labelling.merging.poses import Poses
from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation

GAP = 3  # images between neighbours, at most
MOVED = 0.3  # diameters by which a pose must be off
TURNED = 0.6  # rad: the same
DETOUR = 1.0  # how many times as far it must be off as its neighbours are from each other
UNRELATED = 0.3  # share of a scene's poses that jump, beyond which its frames do not follow one another
SHAPE = 0.06  # diameters: turns that move the surface by less, as of a round object, are none
INSIDE = 0.2, 0.6  # shares of two objects that lie in the other's box, the smaller and the larger: a fruit in a bowl
# is in its box, but the bowl is not in the fruit's


@dataclasses.dataclass(frozen=True)
class Jump:
    """A pose, by its row, that is off what its neighbours say."""

    row: int
    moved: float  # diameters, from half way between them
    turned: float  # rad, likewise


@dataclasses.dataclass(frozen=True)
class Collision:
    """Two poses, by their rows, in one place."""

    first: int
    second: int
    share: float  # of each, at least, that lies in the other's box


def find_jumps(poses: Poses, surfaces: Mapping[int, Float[np.ndarray, "p 3"]]) -> tuple[list[Jump], list[int]]:
    """Poses that are off what those before and after say, of their object in the same scene; only present ones count.

    Args:
        surfaces: points of each object, by its number; diameter 1.

    Returns:
        The jumps, and the scenes whose frames do not follow one another, of which nothing can be said: single photos.
    """
    found = []
    rows = np.flatnonzero(poses.present)
    order = rows[np.lexsort((poses.image[rows], poses.slot[rows], poses.number[rows], poses.scene[rows]))]
    if len(order) < 3:
        return [], []
    before, at, after = order[:-2], order[1:-1], order[2:]
    same = np.ones(len(at), bool)
    for name in ("scene", "number", "slot"):
        column = getattr(poses, name)
        same &= (column[before] == column[at]) & (column[at] == column[after])
    same &= (poses.image[at] - poses.image[before] <= GAP) & (poses.image[after] - poses.image[at] <= GAP)
    before, at, after = before[same], at[same], after[same]
    first, pose, last = (poses.camera_from_object.take(rows) for rows in (before, at, after))
    turn = vector_from_rotation(np.swapaxes(first.rotation, -1, -2) @ last.rotation)
    middle = first.rotation @ rotation_from_vector(turn / 2)
    length = lambda vectors: np.linalg.norm(vectors, axis=-1)
    moved = length(pose.translation - (first.translation + last.translation) / 2) / pose.scale
    turned = length(vector_from_rotation(np.swapaxes(middle, -1, -2) @ pose.rotation))
    far = (moved > MOVED) & (moved > DETOUR * length(first.translation - last.translation) / pose.scale)
    off = (turned > TURNED) & (turned > DETOUR * length(turn))
    for place in np.flatnonzero(far | off):
        row = int(at[place])
        surface = surfaces[int(poses.number[row])]
        if not far[place] and not all(
            _changes_shape(poses, row, int(other[place]), surface) for other in (before, after)
        ):
            continue
        found.append(Jump(row, float(moved[place]), float(turned[place])))
    scenes, counts = np.unique(poses.scene[at], return_counts=True)
    jumping = [int((poses.scene[[one.row for one in found]] == scene).sum()) if found else 0 for scene in scenes]
    unrelated = [int(s) for s, all_of, some in zip(scenes, counts, jumping, strict=True) if some > UNRELATED * all_of]
    kept = [one for one in found if int(poses.scene[one.row]) not in unrelated]
    return sorted(kept, key=lambda one: one.row), unrelated


def find_collisions(poses: Poses, surfaces: Mapping[int, Float[np.ndarray, "p 3"]]) -> list[Collision]:
    """Pairs of present poses of a frame of which each lies by a large share in the other's box."""
    found = []
    rows = np.flatnonzero(poses.present)
    rows = rows[np.argsort(poses.place[rows], kind="stable")]
    starts = np.flatnonzero(np.diff(poses.place[rows], prepend=-1))
    for some in np.split(rows, starts[1:]):
        for i, first in enumerate(some):
            for second in some[i + 1 :]:
                a, b = (poses.camera_from_object.take(int(row)) for row in (first, second))
                if np.linalg.norm(a.translation - b.translation) > 0.5 * (float(a.scale) + float(b.scale)):
                    continue
                points = [surfaces[int(poses.number[row])] for row in (first, second)]
                shares = sorted((_share_inside(a, points[0], b, points[1]), _share_inside(b, points[1], a, points[0])))
                if shares[0] > INSIDE[0] and shares[1] > INSIDE[1]:
                    found.append(Collision(int(first), int(second), shares[0]))
    return found


def _changes_shape(poses: Poses, first: int, second: int, surface: np.ndarray) -> bool:
    """Whether the turn between two poses shows: it moves the surface off where it was."""
    from scipy.spatial import KDTree

    a, b = (poses.camera_from_object.rotation[row] for row in (first, second))
    moved = surface @ (a.T @ b).T
    distance, _ = KDTree(surface).query(moved)
    return float(np.mean(distance)) > SHAPE


def _share_inside(
    first: Similarity[np.ndarray], points: np.ndarray, second: Similarity[np.ndarray], others: np.ndarray
) -> float:
    """The share of one object's points that lie in the box of another's."""
    placed = (second.inverse() @ first) @ points
    return float(((placed >= others.min(0)) & (placed <= others.max(0))).all(-1).mean())
