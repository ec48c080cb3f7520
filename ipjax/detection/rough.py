"""A rough mask mended: an object estimated in it and in proposals like it, and in the masks that their poses give."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from ipjax.config import DetectConfig
from ipjax.detection.assignment import overlap, shared_share
from ipjax.detection.crops import Scene, cut_crop
from ipjax.detection.detector import Detector, Sight
from ipjax.detection.masks import mask_from_pose
from ipjax.detection.verification import Candidate, Verifier
from ipjax.inference.estimator import Result

SHARED = 0.7  # share of the smaller of the given mask and a proposal that both have, of proposals that are tried
ALIKE = 0.2  # and their least intersection over union
TRIED = 4  # proposals, at most
GIVEN = "the mask that was given"
NONE = -1  # the number of the proposal that the given mask is


@dataclasses.dataclass(frozen=True)
class Mended:
    """An estimate in a mask that was mended, and what became of the mask."""

    first: Result  # in the given mask
    result: Result  # the best of all that was tried, which the first may be
    given: Bool[np.ndarray, "h w"]  # the mask that was given, and what became of it: of the image without distortion
    mask: Bool[np.ndarray, "h w"]
    proposal: int | None  # the number of the proposal that led to it; None = the given mask did
    used: bool  # the result is another than the first

    @property
    def overlap(self) -> float:
        """Intersection over union of the given mask and the mended one."""
        return overlap(self.given, self.mask)

    @property
    def added(self) -> int:
        """Pixels that the given mask lacked."""
        return int((self.mask & ~self.given).sum())

    @property
    def removed(self) -> int:
        """Pixels of the given mask that are not the object's."""
        return int((self.given & ~self.mask).sum())


def mend_mask(
    detector: Detector,
    index: int,
    sight: Sight,
    given: Bool[np.ndarray, "h w"],
    *,
    diameter: float | None = None,
    seed: int = 0,
) -> Mended | None:
    """Estimate an object in a mask that may be too wide, cut off, or partly another's.

    The pose in a mask gives another mask: without what is another's, with what was left out. Of a mask of which much is
    missing, though, the pose is often wrong: proposals that have most of it, or that it has most of, are tried, too.
    Poses are rated by confidence × score × the square of the share of the given mask that theirs covers: a right pose
    covers nearly all of it, whatever is missing.

    Args:
        detector, index: of the object.
        sight: of `Detector.look` at the frame.
        given: the mask, in ``sight.scene``: of an image with lens distortion, as
            `ipjax.detection.crops.undistort_mask` has it.
        diameter: the object's true diameter in metres, where it is known.

    Returns:
        None where there is no depth to trust in the given mask.
    """
    crop = cut_crop(sight.scene, given, **detector.options)
    if crop is None:
        return None
    about = detector.estimator, detector.detection, detector.options, sight.scene, sight.watch
    verifier = Verifier(*about, diameter=diameter, seed=seed)
    whole = Candidate(index, NONE, 0.0, given, crop)
    first = verifier.attempt(whole, where=GIVEN, drawn=True)  # as the poses that it is compared with in the end
    others = [verifier.attempt(one) for one in detector.rank(sight, index, TRIED, lambda mask: _is_like(mask, given))]
    claims = verifier.settle([verifier.attempt(whole, where=GIVEN), *others], 1)
    rate = lambda claim: claim.value * _cover(claim.mask, given)
    best = max(claims, key=rate, default=None)
    mask, value = _pose_mask(first.result, given, sight.scene, detector.detection), first.value
    if best is None or rate(best) < value * _cover(mask, given):
        return Mended(first.result, first.result, given, mask, None, False)
    proposal = None if best.proposal == NONE else best.proposal
    return Mended(first.result, best.source.result, given, best.mask, proposal, True)


def rate_pose(result: Result, given: Bool[np.ndarray, "h w"], scene: Scene, config: DetectConfig) -> float:
    """What poses for one rough mask are compared by, where no size is known."""
    return result.value and result.value * _cover(_pose_mask(result, given, scene, config), given)


def _pose_mask(result: Result, given: np.ndarray, scene: Scene, config: DetectConfig) -> np.ndarray:
    """The mask that a pose gives; the given one where it gives none."""
    found = result.estimate
    if not bool(found.success):
        return given
    posed = mask_from_pose(result.templates, found.camera_from_object, scene.matrix, scene.depth, config)[0]
    return posed if posed.any() else given


def _cover(mask: np.ndarray, given: np.ndarray) -> float:
    """The square of the share of the given mask that this one has; its power was chosen on 14 real targets, of which it
    turned one more right than 1 does."""
    return (float((mask & given).sum()) / max(int(given.sum()), 1)) ** 2


def _is_like(mask: np.ndarray, given: np.ndarray) -> bool:
    return shared_share(mask, given) >= SHARED and overlap(mask, given) >= ALIKE
