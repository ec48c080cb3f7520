"""Errors of many poses of one object in metres and doubles: `ipjax.metrics` for every pair of a true and a found pose.

The symmetry that attains an error is found in float32 (exact branch and bound over symmetries and vertices), many pairs
in a call; the error is measured there in float64, so that thresholds fall as they do in BOP's toolkit. Pairs are two
similarities with a leading axis; where the second has a scale, the model is measured at its estimated size.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ipjax import metrics
from ipjax.bop.dataset import Dataset
from ipjax.records import Camera
from ipjax.transforms import Similarity

BATCH = 64  # pairs of poses per call


@dataclass(frozen=True)
class Model:
    """What scoring needs of an object, in metres."""

    points: np.ndarray  # [n, 3] float64
    diameter: float
    symmetries: Similarity[np.ndarray]  # leading axis s; the first is the identity

    @staticmethod
    def load(dataset: Dataset, obj_id: int) -> "Model":
        """From the data set's ``models_eval``."""
        info = dataset.models()[obj_id]
        return Model(np.asarray(dataset.mesh(obj_id).vertices, np.float64), info.diameter, info.symmetries)


@dataclass(frozen=True)
class SurfaceErrors:
    """Errors of v pairs of poses; infinite where the benchmark's pre-checks say so."""

    mssd: np.ndarray  # metres
    mspd: np.ndarray  # pixels
    rotation: np.ndarray  # radians, to the symmetry that attains MSSD
    translation: np.ndarray  # metres, likewise


def stack(poses: Sequence[Similarity[np.ndarray]]) -> Similarity[np.ndarray]:
    """Poses as one similarity with a leading axis."""
    none = Similarity(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
    return jax.tree.map(lambda first, *parts: np.concatenate([first, *(x[None] for x in parts)]), none, *poses)


def surface_errors(
    model: Model, cameras: np.ndarray, truths: Similarity[np.ndarray], estimates: Similarity[np.ndarray]
) -> SurfaceErrors:
    """MSSD, MSPD and the symmetry-aware rotation and translation errors of pairs of poses; ``cameras`` [v, 3, 3] are K.

    Memory is bounded whatever the number of pairs, symmetries and vertices.
    """
    found = SurfaceErrors(*(np.zeros(len(truths.scale)) for _ in range(4)))
    hull = _hull(model.points)
    nearest = _turn_to_nearest(hull, model.symmetries, truths, estimates)
    seen = _turn_to_nearest(model.points, model.symmetries, truths, estimates, cameras)
    for row, camera in enumerate(cameras):
        truth, estimate = nearest.take(row), estimates.take(row)
        found.mssd[row] = metrics.surface_distance(hull, truth, estimate)
        found.mspd[row] = metrics.projection_distance(model.points, camera, seen.take(row), estimate)
        found.rotation[row] = metrics.rotation_error(truth.rotation, estimate.rotation)
        found.translation[row] = metrics.translation_error(truth.translation, estimate.translation)
    found.mssd[~metrics.spheres_overlap(model.diameter, truths, estimates)] = np.inf
    return found


def farthest_distances(model: Model, truths: Similarity[np.ndarray], estimates: Similarity[np.ndarray]) -> np.ndarray:
    """MSSD [v] of pairs of poses, without BOP's pre-check; with the scale of the estimates a wrong size counts."""
    hull = _hull(model.points)
    nearest = _turn_to_nearest(hull, model.symmetries, truths, estimates)
    pairs = ((nearest.take(row), estimates.take(row)) for row in range(len(truths.scale)))
    return np.array([metrics.surface_distance(hull, *pair) for pair in pairs], np.float64)


def least_turns(
    model: Model, truths: Similarity[np.ndarray], estimates: Similarity[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation errors [v], radians, and translation errors [v], metres, of pairs of poses, to the symmetric pose whose
    rotation is nearest (`surface_errors` has those to the one that attains MSSD)."""
    pairs = ((truths.take(row), estimates.take(row)) for row in range(len(truths.scale)))
    found = np.array([metrics.symmetric_errors(model.symmetries, *pair) for pair in pairs], np.float64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def average_distances(
    model: Model,
    truths: Similarity[np.ndarray],
    estimates: Similarity[np.ndarray],
    *,
    nearest: bool,
) -> np.ndarray:
    """ADD [v], or ADD-S with ``nearest``, of pairs of poses; one k-d tree of the model serves all of them.

    Without BOP's pre-check, by which it is infinite where the origins are a diameter apart: the area under a curve to
    10 cm also counts what is that far off. Where the check matters, MSSD is infinite.
    """
    from scipy.spatial import KDTree

    count = len(truths.scale)
    tree = KDTree(model.points) if nearest and count else None
    query = None if tree is None else (lambda points: tree.query(points, workers=-1)[0])
    found = np.zeros(count)
    for row in range(count):
        pair = truths.take(row), estimates.take(row)
        found[row] = metrics.add_s(model.points, *pair, nearest=query) if nearest else metrics.add(model.points, *pair)
    return found


def _turn_to_nearest(
    points: np.ndarray,
    symmetries: Similarity[np.ndarray],
    truths: Similarity[np.ndarray],
    estimates: Similarity[np.ndarray],
    cameras: np.ndarray | None = None,
) -> Similarity[np.ndarray]:
    """Each true pose after the symmetry of the object that brings it nearest to the estimate, in space or, with the
    cameras, in the image."""
    count = len(truths.scale)
    chosen = np.zeros(count, int)
    if len(symmetries.scale) > 1 and count:
        constant = jnp.asarray(_padded(points), jnp.float32), _padded_symmetries(symmetries).to_jax()
        for start in range(0, count, BATCH):
            rows = np.minimum(np.arange(start, start + BATCH), count - 1)
            pairs = [poses.take(rows).to_jax() for poses in (truths, estimates)]
            camera = None if cameras is None else Camera.from_matrix(cameras[rows])
            found = _choose_symmetries(*constant, *pairs, camera, min(count - start, BATCH))
            chosen[start : start + BATCH] = np.asarray(found)[: count - start]
    # Padding repeats the first symmetry.
    return truths @ symmetries.take(np.where(chosen < len(symmetries.scale), chosen, 0))


@jax.jit
def _choose_symmetries(points, symmetries, truths, estimates, cameras, count):
    """The symmetry that attains the least error, for a batch of pairs, one after the other.

    So each takes the steps that it needs; a vmap would take those of the longest for all.
    """

    def choose(row, chosen):
        truth, estimate, camera = jax.tree.map(lambda x: x[row], (truths, estimates, cameras))
        return chosen.at[row].set(metrics.closest_symmetry(points, symmetries, truth, estimate, camera=camera)[1])

    return jax.lax.fori_loop(0, count, choose, jnp.zeros(len(truths.scale), jnp.int32))


def _hull(points: np.ndarray) -> np.ndarray:
    """Vertices of the convex hull: all that MSSD needs, since it is the maximum of a convex function."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # flat, or too few
        return points


def _padded(points: np.ndarray) -> np.ndarray:
    """The points, the first one repeated, to one of a few sizes: objects share a compiled program, maxima do not
    change."""
    count = len(points)
    step = max(64, 2 ** max(math.ceil(math.log2(count)) - 2, 0))
    return np.concatenate([points, np.repeat(points[:1], -count % step, axis=0)])


def _padded_symmetries(symmetries: Similarity[np.ndarray]) -> Similarity[np.ndarray]:
    """Likewise, the identity repeated."""
    count = len(symmetries.scale)
    extra = 8 - count if count <= 8 else -count % 64
    return symmetries.take(np.concatenate([np.arange(count), np.zeros(extra, int)]))
