"""Proposals verified: an object estimated in each, and once more in the mask that its pose gives."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Bool

from ipjax.config import DetectConfig
from ipjax.detection.assignment import Claim, overlap, same_instance
from ipjax.detection.crops import Crop, Scene, cut_crop
from ipjax.detection.masks import mask_from_pose
from ipjax.detection.records import Detection, Reason, Rejected, Rival, Step, Verdict
from ipjax.detection.stopwatch import Stopwatch
from ipjax.estimation.features import describe
from ipjax.files.images.masks import box_of
from ipjax.inference.estimator import Estimator, Result
from ipjax.records import Patches

ELSEWHERE = Verdict(Reason.OTHER_DEPTH, "the depth where its pose is belongs to something else")
OFF_CLICK = Verdict(Reason.OFF_CLICK, "its pose is not at the click")
PROPOSAL, REST, POSED = "a proposal", "what another instance left of a proposal", "the mask of its pose"
NEAR = 5  # pixels beside a mask at which a click is still on it
AT_CLICK = 2  # poses that are mended there, besides those of any search
CLOSE = 0.02  # diameters of ADD-S within which poses at a click are as good as one
BESIDE = 3  # pixels beside a pose's outline that are not left to another instance
LEAST_REST = 150  # pixels of a proposal that its pose must leave for another instance to be sought there
REST_SHARE = 0.25  # and that share of the pose's own outline


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A part of a frame that may be an object."""

    index: int  # of the object
    proposal: int  # its number
    similarity: float
    mask: Bool[np.ndarray, "h w"]  # of the proposal, or of what an instance left of it
    crop: Crop


@dataclasses.dataclass(frozen=True)
class Trial:
    """A candidate that was estimated."""

    candidate: Candidate
    result: Result
    value: float  # confidence × score, and how well a known size agrees
    where: str = PROPOSAL  # what was cut out, in words
    earlier: tuple[Step, ...] = ()  # that led to it

    @property
    def rival(self) -> Rival:
        """It, as what others lost to."""
        about = self.candidate.index, self.result.info.name, self.candidate.proposal
        return Rival(*about, float(self.result.estimate.confidence))

    def as_step(self, posed: Bool[np.ndarray, "h w"] | None = None) -> Step:
        """It, and the mask of its pose."""
        return Step.of(self.where, self.candidate.crop.mask, self.result, self.value, posed)


@dataclasses.dataclass
class Verifier:
    """Estimates one object's candidates in a frame, and collects what is given up."""

    estimator: Estimator
    settings: DetectConfig
    options: dict[str, Any]  # of `cut_crop`
    scene: Scene
    watch: Stopwatch
    diameter: float | None = None
    click: tuple[float, float] | None = None  # a pixel of what is sought
    seed: int = 0
    rejected: list[Rejected] = dataclasses.field(default_factory=list)

    def verify(self, candidates: Sequence[Candidate], instances: int) -> list[Claim]:
        """The poses of candidates, the pixels that they claim; what does not differ is estimated once."""
        return self.settle([self.attempt(one) for one in candidates], instances)

    def settle(self, trials: Sequence[Trial], instances: int) -> list[Claim]:
        """The second half of `verify`: the poses of candidates that were estimated.

        Where more than one instance is wanted, what a pose leaves of its proposal may be another: two that touch are
        often one proposal.
        """
        chosen: list[Trial] = []
        most = self.settings.mended + (instances - 1 if self.click is None else AT_CLICK)
        mended = self._mend(trials, chosen, most)
        found = list(mended)
        while mended and instances > 1 and len(found) < self.settings.mended + 2 * instances:
            rests = [rest for trial in mended if (rest := self._rest(trial)) is not None]
            again = [self.attempt(one, "verify rest", REST) for one in rests]
            mended = self._mend(again, chosen, len(chosen) + instances)
            found += mended
        return self._claims(found)

    def attempt(
        self,
        candidate: Candidate,
        stage: str = "verify",
        where: str = PROPOSAL,
        earlier: tuple[Step, ...] = (),
        *,
        drawn: bool = False,
    ) -> Trial:
        """Estimate a candidate; ``stage`` is what the seconds are counted as, ``where`` what was cut out, in words.

        Which pieces of a frame are worth a second look shows without drawing; what is told is ``drawn``. Confidences
        of one kind are not to be compared with those of the other.
        """
        crop = candidate.crop
        patches = describe_crop(self.estimator, crop, self.watch)
        about = crop.view, crop.camera_from_crop
        with self.watch(stage):
            result = self.estimator.run(candidate.index, *about, seed=self.seed, patches=patches, drawn=drawn)
        self.watch.move("compile", result.seconds.get("compile", 0.0), stage)
        return Trial(candidate, result, self._value(result), where, earlier)

    def _value(self, result: Result) -> float:
        """What trials are compared by: confidence × score, and how well a known size agrees."""
        if self.diameter is None or not result.value:
            return result.value
        off = np.log(float(result.estimate.diameter) / self.diameter) / self.settings.size_deviation
        return result.value * float(np.exp(-0.5 * off**2))

    def _mend(self, trials: Sequence[Trial], chosen: list[Trial], most: int) -> list[Trial]:
        """The best poses that differ, estimated again in the masks that they give; ``chosen`` has them, too."""
        mended: list[Trial] = []
        for trial in sorted(trials, key=lambda one: -one.value):
            if trial.value <= 0:
                self._reject(trial, Verdict(Reason.NO_POSE, "no pose was found"))
                continue
            if (other := next((one for one in chosen if self._is_same(trial, one)), None)) is not None:
                words = "another proposal led to the same pose, and is surer"
                self._reject(trial, Verdict(Reason.SAME_POSE, words, other.rival))
            elif len(chosen) >= most:
                words = "other proposals have surer poses"
                self._reject(trial, Verdict(Reason.WEAKER, words, chosen[-1].rival))
            else:
                about = trial.result.templates, trial.result.estimate.camera_from_object
                with self.watch("mask"):
                    mask, whole = mask_from_pose(*about, self.scene.matrix, self.scene.depth, self.settings)
                    crop = cut_crop(self.scene, mask, **self.options)
                if self.click is not None and not is_at(whole, self.click):
                    self._reject(trial, OFF_CLICK, mask)
                    continue
                chosen.append(trial)
                if crop is None:
                    self._reject(trial, ELSEWHERE, mask)
                else:
                    again = dataclasses.replace(trial.candidate, crop=crop)
                    earlier = *trial.earlier, trial.as_step(mask)
                    mended.append(self.attempt(again, "verify again", POSED, earlier, drawn=True))
        return mended

    def _is_same(self, trial: Trial, other: Trial) -> bool:
        """Whether one of two poses is enough: they are of one instance or, where a click says which that is and
        nearly all poses are of it, hardly differ."""
        apart = self.settings.same if self.click is None else CLOSE
        first, second = (one.result.estimate.camera_from_object for one in (trial, other))
        return same_instance(trial.result.templates, first, second, apart)

    def _rest(self, trial: Trial) -> Candidate | None:
        """The largest piece of a proposal that its pose leaves; None where that is too little for another instance."""
        found = trial.result.estimate
        if trial.value <= 0:
            return None
        about = trial.result.templates, found.camera_from_object, self.scene.matrix, self.scene.depth
        with self.watch("mask"):
            whole = mask_from_pose(*about, self.settings)[1]
            side = 2 * BESIDE + 1
            grown = cv2.dilate(whole.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
            left = (trial.candidate.mask & ~grown).astype(np.uint8)
            _, labels, stats, _ = cv2.connectedComponentsWithStats(left, connectivity=4)
            if len(stats) < 2:
                return None
            largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
            if stats[largest, cv2.CC_STAT_AREA] < max(LEAST_REST, REST_SHARE * whole.sum()):
                return None
            mask = labels == largest
            crop = cut_crop(self.scene, mask, **self.options)
        return None if crop is None else dataclasses.replace(trial.candidate, mask=mask, crop=crop)

    def _claims(self, trials: Sequence[Trial]) -> list[Claim]:
        """The pixels of each pose; a pose whose depth is another's claims nothing."""
        claims = []
        for trial in trials:
            found, info = trial.result.estimate, trial.result.info
            if trial.value <= 0:
                self._reject(trial, Verdict(Reason.NO_POSE, "no pose was found in the mask of its first pose"))
                continue
            about = trial.result.templates, found.camera_from_object, self.scene.matrix, self.scene.depth
            with self.watch("mask"):
                mask = mask_from_pose(*about, self.settings)[0]
            if not mask.any():
                self._reject(trial, ELSEWHERE)
                continue
            if self.click is not None and not is_at(mask, self.click):
                self._reject(trial, OFF_CLICK, mask)
                continue
            known = found.camera_from_object, float(found.confidence), trial.value, trial
            claims.append(Claim(trial.candidate.index, info.name, mask, *known, trial.candidate.proposal))
        return claims

    def _reject(self, trial: Trial, verdict: Verdict, mask: Bool[np.ndarray, "h w"] | None = None) -> None:
        self.rejected.append(reject(trial, verdict, mask))


def is_at(mask: Bool[np.ndarray, "h w"], pixel: tuple[float, float], near: int = NEAR) -> bool:
    """Whether a mask has a pixel within ``near`` pixels of this one (x, y)."""
    x, y = (round(value) for value in pixel)
    return bool(mask[max(y - near, 0) : max(y + near + 1, 0), max(x - near, 0) : max(x + near + 1, 0)].any())


def describe_crop(estimator: Estimator, crop: Crop, watch: Stopwatch) -> Patches:
    """The patches of a crop, which is described when it is first wanted."""
    if crop.patches is not None:
        return crop.patches
    with watch("describe"):
        run = estimator.compiled("describe", describe, watch.spent, estimator.encoder, crop.view)
        patches: Patches = jax.block_until_ready(run(estimator.encoder, crop.view))
    crop.patches = patches
    return patches


def as_detection(claim: Claim) -> Detection:
    """A claim that holds."""
    trial: Trial = claim.source
    box = box_of(claim.mask)
    assert box is not None  # a claim without pixels was rejected
    about = trial.candidate.proposal, trial.candidate.similarity, overlap(trial.candidate.mask, claim.mask)
    steps = *trial.earlier, trial.as_step(claim.mask)
    return Detection(claim.index, claim.name, claim.mask, box, claim.value, trial.result, *about, steps)


def reject(trial: Trial, verdict: Verdict, mask: Bool[np.ndarray, "h w"] | None = None) -> Rejected:
    """A trial that was given up, for this reason; ``mask``: of its pose, where it is known."""
    candidate = trial.candidate
    return Rejected(
        candidate.index,
        trial.result.info.name,
        candidate.proposal,
        candidate.similarity,
        verdict.words,
        verdict.why,
        verdict.rival,
        float(trial.result.estimate.confidence),
        trial.value,
        candidate.crop.mask if mask is None else mask,
        (*trial.earlier, trial.as_step(mask)),
    )
