"""What was found in a frame, and what was not and why."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ipjax.detection.crops import Scene
from ipjax.inference.estimator import Result


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
    confidence: float | None = None  # where a pose was estimated
    score: float | None = None
    mask: Bool[np.ndarray, "h w"] | None = None


@dataclasses.dataclass(frozen=True)
class Detections(Sequence[Detection]):
    """All that was found in a frame, the surest first; with what it was chosen from."""

    found: tuple[Detection, ...]
    rejected: tuple[Rejected, ...]
    proposals: Any  # `ipjax.detection.proposals.propose.Proposals`
    similarity: Float[np.ndarray, "o n"]  # of each object and proposal; -inf where a proposal could not be used
    scene: Scene  # the frame without lens distortion, which masks and poses are of
    seconds: dict[str, float]  # of each stage; compile where it happened

    def __len__(self) -> int:
        return len(self.found)

    def __getitem__(self, index: Any) -> Any:
        return self.found[index]

    def __iter__(self) -> Iterator[Detection]:
        return iter(self.found)
