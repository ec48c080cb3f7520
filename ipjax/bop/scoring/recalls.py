"""From the errors of every target to recalls, their intervals, medians and areas under curves."""

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ipjax import metrics
from ipjax.bop.records import MM
from ipjax.bop.scoring.protocol import Protocol, ScoredTarget
from ipjax.bop.scoring.summaries import Instance


def count_hits(target: ScoredTarget, name: str, diameter: float) -> np.ndarray:
    """True positives of a target at every threshold: [10], or [10, 10] for VSD (tolerance, threshold)."""
    thresholds = metrics.PIXEL_THRESHOLDS if name == "mspd" else metrics.THRESHOLDS
    table = getattr(target, name) / (1.0 if name in ("mspd", "vsd") else diameter)
    if table.ndim == 2:
        table = table[..., None]
    scores = np.array([e.score for e in target.estimates])
    found = np.zeros((table.shape[-1] if len(scores) else (10 if name == "vsd" else 1), len(thresholds)), np.int64)
    if len(scores):
        if target.mssd.shape == (1, 1):
            found[:] = target.valid[0] & (table[0, 0][:, None] < thresholds)
        else:
            for k in range(table.shape[-1]):
                found[k] = [
                    (metrics.match_poses(table[..., k], scores, t, target.valid) >= 0).sum() for t in thresholds
                ]
    return found if name == "vsd" else found[0]


def average_recalls(hits: Mapping[str, np.ndarray], counts: np.ndarray, chosen: np.ndarray) -> dict[str, float]:
    """Average recalls over the chosen targets; BOP's AR, where all three of its metrics are there."""
    total = max(int(counts[chosen].sum()), 1)
    recalls = {name: float(table[chosen].sum(0).mean() / total) for name, table in hits.items()}
    return recalls | _mean_recall(recalls)


def _mean_recall(recalls: dict[str, Any]) -> dict[str, Any]:
    """BOP's AR, where all three of its metrics are there."""
    names = ("mssd", "mspd", "vsd")
    return {"ar": sum(recalls[n] for n in names) / 3} if set(names) <= set(recalls) else {}


def bootstrap_recalls(
    hits: Mapping[str, np.ndarray],
    counts: np.ndarray,
    of_image: np.ndarray,
    chosen: np.ndarray,
    samples: int,
    seed: int,
) -> dict[str, tuple[float, float]]:
    """95 % intervals of the average recalls when images are drawn with replacement."""
    used, place = np.unique(of_image[chosen], return_inverse=True)
    if samples < 1 or len(used) < 2:
        return {}
    weights = np.random.default_rng(seed).multinomial(len(used), np.full(len(used), 1 / len(used)), size=samples)
    totals = np.maximum(weights @ np.bincount(place, counts[chosen], len(used)), 1)
    recalls = {n: weights @ np.bincount(place, t[chosen].mean(-1), len(used)) / totals for n, t in hits.items()}
    recalls |= _mean_recall(recalls)
    return {n: tuple(np.percentile(values, [2.5, 97.5]).tolist()) for n, values in recalls.items()}


def find_instances(targets: list[ScoredTarget]) -> list[Instance]:
    """Every instance that counts, with the estimate that falls to it: by falling score, the smallest MSSD."""
    found = []
    for target in targets:
        scores = np.array([e.score for e in target.estimates])
        table = np.where(np.isfinite(target.mssd), target.mssd, 1e9)  # infinitely far is still an estimate
        matched = metrics.match_poses(table, scores, np.inf, target.valid) if len(scores) else np.zeros(0, int)
        owner = {int(g): e for e, g in enumerate(matched) if g >= 0}
        for g, truth in enumerate(target.truths):
            if not target.valid[g]:
                continue
            e = owner.get(g)
            place = (target.row.scene_id, target.row.im_id, target.row.obj_id, truth.index)
            if e is None:
                nothing = math.inf
                vsd = 1.0 if target.vsd.size else math.nan
                found.append(
                    Instance(
                        *place,
                        found=False,
                        score=0.0,
                        mssd=nothing,
                        mspd=nothing,
                        vsd=vsd,
                        add=nothing,
                        add_s=nothing,
                        rotation=nothing,
                        translation=nothing,
                        scale=math.nan,
                        least_turn=nothing,
                        shift=nothing,
                    )
                )
                continue
            found.append(
                Instance(
                    *place,
                    True,
                    float(scores[e]),
                    float(target.mssd[e, g]),
                    float(target.mspd[e, g]),
                    float(target.vsd[e, g].mean()) if target.vsd.size else math.nan,
                    float(target.add[e, g]) if target.add.size else math.nan,
                    float(target.add_s[e, g]) if target.add_s.size else math.nan,
                    float(target.rotation[e, g]),
                    float(target.translation[e, g]),
                    math.nan if (scale := target.estimates[e].scale) is None else abs(scale - 1),
                    float(target.sized_mssd[e, g]) if target.sized_mssd.size else math.nan,
                    float(target.sized_add[e, g]) if target.sized_add.size else math.nan,
                    float(target.least_turn[e, g]),
                    float(target.shift[e, g]),
                )
            )
    return found


def count_right_sizes(targets: list[ScoredTarget], instances: list[Instance]) -> dict[str, np.ndarray]:
    """For each target the instances whose size is right, one table [targets, 1] for each tolerance."""
    places = {(s.row.scene_id, s.row.im_id, s.row.obj_id): i for i, s in enumerate(targets)}
    tables = {f"size_{round(100 * x)}": np.zeros((len(targets), 1), np.int64) for x in metrics.SIZE_TOLERANCES.tolist()}
    for one in instances:
        for table, tolerance in zip(tables.values(), metrics.SIZE_TOLERANCES.tolist(), strict=True):
            table[places[one.scene_id, one.im_id, one.obj_id], 0] += one.scale < tolerance
    return tables


def find_medians(instances: list[Instance]) -> dict[str, float]:
    """Median errors of rotation, translation and size over the instances that have an estimate; empty without any."""
    if not instances:
        return {}
    medians = {
        "rotation_deg": float(np.degrees(np.median([i.rotation for i in instances]))),
        "translation_mm": float(np.median([i.translation for i in instances]) / MM),
    }
    scales = [i.scale for i in instances if not math.isnan(i.scale)]
    if scales:
        medians["scale_percent"] = float(100 * np.median(scales))
    return medians


def summarise_distances(instances: list[Instance], protocol: Protocol) -> dict[str, float]:
    """Areas under the accuracy curves of ADD and ADD-S as PoseCNN's toolbox sums them, and the shares of instances that
    pass BOP's pre-check and are below a tenth of the diameter."""
    add, add_s = np.array([i.add for i in instances]), np.array([i.add_s for i in instances])
    either = np.array([i.add_s if i.obj_id in protocol.symmetric else i.add for i in instances])
    tenths = np.array([0.1 * protocol.infos[i.obj_id].diameter for i in instances])
    near = np.isfinite([i.mssd for i in instances])
    return {
        "add_auc": _area(add),
        "add_s_auc": _area(add_s),
        "add_or_s_auc": _area(either),
        "recall_01d": float(np.mean(near & (either < tenths))),
        "add_s_01d": float(np.mean(near & (add_s < tenths))),
    }


def _area(distances: np.ndarray) -> float:
    return float(metrics.area_under_accuracy(jnp.asarray(distances, jnp.float32)))
