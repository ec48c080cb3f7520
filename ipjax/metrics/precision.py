"""Matching estimates to instances, and the precision of detections: of poses by error, of boxes and masks by IoU.

Poses: https://github.com/thodan/bop_toolkit (pose_matching.py, score.py). Boxes and masks: COCO's protocol
(https://cocodataset.org/#detection-eval, cocoeval.py), with BOP's rule of what is ignored.

On the host, in NumPy: what is matched depends on what has been matched before.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

OVERLAPS = np.linspace(0.5, 0.95, 10)  # IoU from which a detection is right; AP is the mean over all of them


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


def box_overlaps(boxes: Float[np.ndarray, "d 4"], truths: Float[np.ndarray, "g 4"]) -> Float[np.ndarray, "d g"]:
    """Intersection over union of boxes (x, y, width, height; any unit); 0 where they do not meet (maskApi.c, bbIou)."""
    low = np.maximum(boxes[:, None, :2], truths[None, :, :2])
    high = np.minimum(boxes[:, None, :2] + boxes[:, None, 2:], truths[None, :, :2] + truths[None, :, 2:])
    sides = high - low
    shared = np.where((sides > 0).all(-1), sides.prod(-1), 0.0)
    union = boxes[:, None, 2:].prod(-1) + truths[None, :, 2:].prod(-1) - shared
    return np.where(shared > 0, shared / np.where(shared > 0, union, 1.0), 0.0)


def mask_overlaps(masks: Bool[np.ndarray, "d h w"], truths: Bool[np.ndarray, "g h w"]) -> Float[np.ndarray, "d g"]:
    """Intersection over union of masks; 0 where they share no pixel (maskApi.c, rleIou)."""
    flat, true = (np.reshape(stack, (len(stack), -1)) for stack in (masks, truths))
    # Single precision counts exactly up to 2²⁴ pixels, and a part has fewer; a part at a time keeps memory small.
    shared = np.zeros((len(flat), len(true)))
    for start in range(0, flat.shape[-1], 2**16):
        part = slice(start, start + 2**16)
        shared += flat[:, part].astype(np.float32) @ true[:, part].astype(np.float32).T
    union = flat.sum(1)[:, None] + true.sum(1)[None] - shared
    return np.where(shared > 0, shared / np.where(shared > 0, union, 1.0), 0.0)


def match_overlaps(
    overlaps: Float[np.ndarray, "d g"],
    thresholds: Float[np.ndarray, "t"] = OVERLAPS,
    ignored: Bool[np.ndarray, "g"] | None = None,
) -> Int[np.ndarray, "t d"]:
    """The truth [t, d] that each detection is matched to at each threshold, −1 = none (cocoeval.py, evaluateImg).

    One to one, in the order of the detections: the largest IoU from the threshold on among truths that are still free;
    one that is ignored only where no other is left. Of equals the last.

    Args:
        overlaps: IoU, detections in falling order of their scores.
        thresholds: each is matched for itself.
        ignored: truths that need not be found (BOP: less than a tenth visible). A detection matched to one is neither
            right nor wrong. BOP's annotations have no crowds, so that none is matched twice.
    """
    count, truths = overlaps.shape
    matched = np.full((len(thresholds), count), -1)
    if truths == 0:
        return matched
    free = np.ones((len(thresholds), truths), bool)
    skipped = np.zeros(truths, bool) if ignored is None else np.asarray(ignored, bool)
    least = np.minimum(thresholds, 1 - 1e-10)[:, None]
    for index, row in enumerate(overlaps):
        possible = free & (row >= least)
        wanted = possible & ~skipped
        possible = np.where(wanted.any(1, keepdims=True), wanted, possible)
        best = truths - 1 - np.argmax(np.where(possible, row, -1.0)[:, ::-1], axis=1)
        found = np.flatnonzero(possible.any(1))
        matched[found, index] = best[found]
        free[found, best[found]] = False
    return matched


def overlap_precision(
    images: Sequence[tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_"], Bool[np.ndarray, "_"]]],
    thresholds: Float[np.ndarray, "t"] = OVERLAPS,
) -> tuple[Float[np.ndarray, "t"], Float[np.ndarray, "t"]] | None:
    """Average precision [t] and largest recall [t] of one object over images, at each threshold of IoU.

    Args:
        images: of each the IoU [d, g], scores [d] of the detections, and which truths are ignored [g].

    Returns:
        None where no truth counts: COCO leaves such an object out of its means.
    """
    count = sum(int((~np.asarray(ignored, bool)).sum()) for _, _, ignored in images)
    if count == 0:
        return None
    scores, right, kept = [], [], []
    for overlaps, image_scores, ignored in images:
        order = np.argsort(-np.asarray(image_scores), kind="stable")
        matched = match_overlaps(overlaps[order], thresholds, ignored)
        skipped = (matched >= 0) & np.append(np.asarray(ignored, bool), False)[matched]
        scores.append(np.asarray(image_scores)[order])
        right.append((matched >= 0) & ~skipped)
        kept.append(~skipped)
    every, hits, counted = np.concatenate(scores), np.concatenate(right, axis=1), np.concatenate(kept, axis=1)
    precision = [average_precision(every[c], h[c], count) for h, c in zip(hits, counted, strict=True)]
    return np.array(precision), hits.sum(1) / count
