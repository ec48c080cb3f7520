"""Matching estimates to instances, and the precision of detections (thodan/bop_toolkit, pose_matching.py, score.py).

On the host, in NumPy: what is matched depends on what has been matched before.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int


def match_poses(
    pose_errors: Float[np.ndarray, "e g"],
    scores: Float[np.ndarray, "e"],
    threshold: float,
    valid: Bool[np.ndarray, "g"] | None = None,
) -> Int[np.ndarray, "e"]:
    """The truth [e] that each estimate is matched to at a threshold, −1 = none: by falling score, one to one, the
    smallest error below the threshold (strictly) among valid truths that are still free (pose_matching.py:9-92)."""
    count, truths = pose_errors.shape
    matched = np.full(count, -1)
    free = np.ones(truths, bool) if valid is None else np.asarray(valid, bool).copy()
    for index in np.argsort(-np.asarray(scores), kind="stable"):
        candidates = np.where(free & (pose_errors[index] < threshold), pose_errors[index], np.inf)
        if truths and np.isfinite(candidates.min()):
            best = int(np.argmin(candidates))
            matched[index] = best
            free[best] = False
    return matched


def average_precision(scores: Float[np.ndarray, "e"], correct: Bool[np.ndarray, "e"], count: int) -> float:
    """Precision interpolated at 101 recalls, averaged (COCO's form; score.py:12-53). ``count`` = all true instances."""
    if count == 0 or len(scores) == 0:
        return 0.0
    hits = np.cumsum(np.asarray(correct, bool)[np.argsort(-np.asarray(scores), kind="stable")])
    recall = hits / count
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    at = np.searchsorted(recall, np.linspace(0, 1, 101), side="left")
    return float(np.where(at < len(precision), precision[np.minimum(at, len(precision) - 1)], 0.0).mean())


def detection_precision(
    images: Sequence[tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_"], Bool[np.ndarray, "_"]]],
    count: int,
    threshold: float,
) -> float:
    """Average precision of one object: for each image errors [e, g], scores [e], and which truths are valid [g].

    Every truth can match; estimates matched to one that is hardly visible are neither right nor wrong.
    """
    scores, correct = [np.zeros(0)], [np.zeros(0, bool)]
    for pose_errors, image_scores, valid in images:
        matched = match_poses(pose_errors, image_scores, threshold)
        ignored = np.array([m >= 0 and not valid[m] for m in matched], bool)
        scores.append(np.asarray(image_scores)[~ignored])
        correct.append((matched >= 0)[~ignored])
    return average_precision(np.concatenate(scores), np.concatenate(correct), count)
