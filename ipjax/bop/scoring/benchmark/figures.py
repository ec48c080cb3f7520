"""The figures of a participant on a data set, for each object: areas under accuracy curves, shares, seconds.

They are those of PoseCNN (https://arxiv.org/abs/1711.00199), DenseFusion (https://arxiv.org/abs/1901.04780) and RobotP
(https://doi.org/10.3390/s21041299), beside BOP's recalls. An instance without an estimate is infinitely wrong.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ipjax import metrics
from ipjax.bop.scoring.summaries import Instance, Score

THRESHOLDS = np.linspace(0, metrics.ADD_LIMIT, 201)  # metres, of the curves that are drawn; the areas need none
RECALLS = ("vsd", "mssd", "mspd", "ar")


@dataclass(frozen=True)
class Figures:
    """What is told of one object, or of all of them; shares are from 0 to 1."""

    targets: int  # instances that were to be found
    found: int  # of these, those that have an estimate
    auc_add: float  # area under the accuracy curve of ADD, from 0 to 10 cm
    auc_add_s: float
    add_s_2cm: float  # share with ADD-S below 2 cm
    pose_5deg_5cm: float  # share within 5° and 5 cm of the symmetric pose whose rotation is nearest
    seconds: float | None  # mean time of an image (of all objects in it); None where the file does not tell it
    recalls: dict[str, float]  # BOP's average recalls "vsd", "mssd", "mspd", "ar", those that were measured


@dataclass(frozen=True)
class Entry:
    """One participant on one data set."""

    participant: str
    dataset: str
    objects: dict[int, Figures]
    mean: Figures  # over objects; targets and found are sums
    all: Figures  # over instances; its recalls are BOP's
    add_curve: list[float]  # share of all instances with ADD below each of `THRESHOLDS`
    add_s_curve: list[float]
    score: Score = field(repr=False, compare=False)


def summarise(score: Score, participant: str, dataset: str) -> Entry:
    """The figures of a score that has ADD and ADD-S; ValueError where it has not."""
    if not {"add", "add_s"} & set(score.metrics):
        raise ValueError(f"{participant}: the areas need ADD and ADD-S, which were not measured")
    by_object: dict[int, list[Instance]] = {obj: [] for obj in score.objects}
    for one in score.instances:
        by_object[one.obj_id].append(one)
    objects = {}
    for obj, mine in by_object.items():
        entry = score.objects[obj]
        objects[obj] = _measure(mine, entry.get("seconds"), {n: entry[n] for n in RECALLS if n in entry})
    everything = score.all_frames.recalls
    add, add_s = (np.array([getattr(i, name) for i in score.instances]) for name in ("add", "add_s"))
    return Entry(
        participant,
        dataset,
        objects,
        _average(list(objects.values())),
        _measure(score.instances, score.seconds_per_image, {n: everything[n] for n in RECALLS if n in everything}),
        metrics.recall(add, THRESHOLDS).tolist(),
        metrics.recall(add_s, THRESHOLDS).tolist(),
        score,
    )


def _measure(instances: Sequence[Instance], seconds: float | None, recalls: dict[str, float]) -> Figures:
    add, add_s, turns, shifts = (
        np.array([getattr(one, name) for one in instances], np.float64)
        for name in ("add", "add_s", "least_turn", "shift")
    )
    return Figures(
        targets=len(instances),
        found=sum(one.found for one in instances),
        auc_add=float(metrics.auc(add)),
        auc_add_s=float(metrics.auc(add_s)),
        add_s_2cm=float(metrics.recall(add_s, np.array([metrics.GRASP_LIMIT]))[0]),
        pose_5deg_5cm=float(metrics.pose_recall(turns, shifts)),
        seconds=seconds,
        recalls=recalls,
    )


def _average(figures: list[Figures]) -> Figures:
    """The mean of every figure over objects; of times over those that are known."""

    def mean(name: str) -> float:
        return math.fsum(getattr(one, name) for one in figures) / len(figures)

    seconds = [one.seconds for one in figures if one.seconds is not None]
    names = [name for name in RECALLS if all(name in one.recalls for one in figures)]
    return Figures(
        targets=sum(one.targets for one in figures),
        found=sum(one.found for one in figures),
        auc_add=mean("auc_add"),
        auc_add_s=mean("auc_add_s"),
        add_s_2cm=mean("add_s_2cm"),
        pose_5deg_5cm=mean("pose_5deg_5cm"),
        seconds=math.fsum(seconds) / len(seconds) if seconds else None,
        recalls={name: math.fsum(one.recalls[name] for one in figures) / len(figures) for name in names},
    )
