"""What was found in a frame, and what was not and why."""

import dataclasses
import enum
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.detection.crops import Scene
from ipjax.inference.estimator import Result
from ipjax.records import Similarity


class Reason(enum.StrEnum):
    """Why a proposal that was tried as an object is no detection of it."""

    NO_POSE = "no pose"  # none was found in it
    WEAKER = "weaker"  # other proposals, elsewhere or around it, gave this object surer poses
    SAME_POSE = "same pose"  # another proposal led to the same pose, and is surer
    OTHER_DEPTH = "other depth"  # the measured depth where its pose is belongs to something else
    OFF_CLICK = "off the click"  # its mask is not at the pixel that was clicked
    SAME_MASK = "same mask"  # more than half of the smaller mask is another instance's of this object
    SAME_PLACE = "same place"  # the pose fills the space of another instance of this object, in SE(3)
    CLAIMED = "claimed"  # more than half of the smaller mask is another object's, which is surer
    ENOUGH = "enough"  # as many surer instances as were wanted are elsewhere
    UNSURE = "unsure"  # its confidence is below the threshold, and a surer instance is told


@dataclasses.dataclass(frozen=True)
class Rival:
    """What a proposal lost to."""

    index: int  # of the object
    name: str
    proposal: int
    confidence: float


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Why something is no detection: for programs, in words, and what it lost to, if to something."""

    why: Reason
    words: str
    rival: Rival | None = None


@dataclasses.dataclass(frozen=True)
class Step:
    """One estimate on the way to a verdict."""

    where: str  # what was cut out, in words
    mask: Bool[np.ndarray, "h w"]  # that
    success: bool
    confidence: float
    score: float  # confidence × agreement of the pose, and how well a known size agrees
    diameter: float  # metres
    camera_from_object: Similarity[np.ndarray]
    posed: Bool[np.ndarray, "h w"] | None = None  # the mask that the pose gives; None where it was not asked

    @staticmethod
    def of(
        where: str,
        mask: Bool[np.ndarray, "h w"],
        result: Result,
        score: float,
        posed: Bool[np.ndarray, "h w"] | None = None,
    ) -> "Step":
        """Of an estimate, without what it came from."""
        found = result.estimate
        known = bool(found.success), float(found.confidence), score, float(found.diameter)
        return Step(where, mask, *known, found.camera_from_object.to_numpy(), posed)


@dataclasses.dataclass(frozen=True)
class Ranking:
    """The proposals of a frame by how much they look like one object."""

    index: int  # of the object
    name: str
    proposals: Int[np.ndarray, " n"]  # their numbers, the most alike first
    similarity: Float[np.ndarray, " n"]  # of each
    whole: int  # so many of the first were compared by whole crops, the others at a glance
    estimated: int  # so many of the first were estimated; the others are too little like the object


@dataclasses.dataclass(frozen=True)
class Detection:
    """An object that was found: where, how sure, and in what pose."""

    index: int  # of the object, in the detector's order
    name: str
    mask: Bool[np.ndarray, "h w"]  # its visible pixels
    box: tuple[int, int, int, int]  # x, y, width, height of the mask; pixels
    score: float  # confidence × agreement of the pose: by it detections are sorted
    result: Result  # pose, confidence, and the crop they come from
    proposal: int  # the number of the proposal that led here
    similarity: float  # of that proposal to the object, by which it was chosen
    overlap: float  # intersection over union of the proposal and the mask that its pose gave
    steps: tuple[Step, ...] = ()  # the estimates that led here, the last one's mask being that of its pose

    @property
    def confidence(self) -> float:
        """The probability that the pose is right."""
        return float(self.result.estimate.confidence)

    @property
    def present(self) -> bool:
        """Confident enough that the object is here; without it the detection is a guess."""
        return bool(self.result.estimate.present)


@dataclasses.dataclass(frozen=True)
class Rejected:
    """What was tried as an object and given up, and why."""

    index: int  # of the object
    name: str
    proposal: int
    similarity: float
    reason: str  # in words
    why: Reason  # for programs
    rival: Rival | None = None  # what it lost to
    confidence: float | None = None  # where a pose was estimated
    score: float | None = None
    mask: Bool[np.ndarray, "h w"] | None = None
    steps: tuple[Step, ...] = ()  # its estimates


@dataclasses.dataclass(frozen=True)
class Detections(Sequence[Detection]):
    """All that was found in a frame, the surest first; with what it was chosen from.

    `ipjax.explain` makes a page of it.
    """

    found: tuple[Detection, ...]
    rejected: tuple[Rejected, ...]
    proposals: Any  # `ipjax.detection.proposals.propose.Proposals`
    similarity: Float[np.ndarray, "o n"]  # of each object and proposal; -inf where a proposal could not be used
    scene: Scene  # the frame without lens distortion, which masks and poses are of
    seconds: dict[str, float]  # of each stage; compile where it happened
    names: tuple[str, ...] = ()  # of all objects that were sought
    rankings: tuple[Ranking, ...] = ()  # of each object, in their order; none where there are no proposals
    clicks: tuple[tuple[float, float], ...] = ()  # that were given, in the image without lens distortion

    def __len__(self) -> int:
        return len(self.found)

    def __getitem__(self, index: Any) -> Any:
        return self.found[index]

    def __iter__(self) -> Iterator[Detection]:
        return iter(self.found)

    def told(self) -> tuple[tuple[Detection, ...], tuple[Rejected, ...]]:
        """What is worth telling of it: of each object its surest detection, be it a guess, and others only where they
        are present; and all that was rejected, those others included."""
        kept: list[Detection] = []
        unsure: list[Rejected] = []
        for one in self.found:
            best = next((other for other in kept if other.index == one.index), None)
            if best is None or one.present:
                kept.append(one)
                continue
            words = f"a confidence of {one.confidence:.2f} is too low to be told beside {best.confidence:.2f}"
            rival = Rival(best.index, best.name, best.proposal, best.confidence)
            known = one.confidence, one.score, one.mask, one.steps
            about = one.index, one.name, one.proposal, one.similarity
            unsure.append(Rejected(*about, words, Reason.UNSURE, rival, *known))
        return tuple(kept), (*self.rejected, *unsure)
