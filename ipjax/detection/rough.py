"""An object estimated again in the mask that its pose gives: a rough mask is mended by the pose it led to."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool

from ipjax.config import DetectConfig
from ipjax.detection.assignment import overlap
from ipjax.detection.crops import Scene, cut_crop
from ipjax.detection.masks import mask_from_pose
from ipjax.inference.estimator import Estimator, Result


@dataclasses.dataclass(frozen=True)
class Mended:
    """An estimate in a mask that was mended, and what became of the mask."""

    result: Result  # the surer of both
    mask: Bool[np.ndarray, "h w"]  # of the image without lens distortion
    overlap: float  # intersection over union of the given mask and the mended one
    added: int  # pixels that the given mask lacked
    removed: int  # pixels of it that are not the object's
    used: bool  # the estimate in the mended mask is the surer one
    before: float  # confidence in the given mask


def estimate_again(
    estimator: Estimator,
    index: int,
    scene: Scene,
    given: Bool[np.ndarray, "h w"],
    first: Result,
    config: DetectConfig = DetectConfig(),
    **options: Any,
) -> Mended | None:
    """Estimate an object once more, in the mask of its pose: without what is another's, with what was left out.

    Args:
        estimator, index: that made ``first``, the estimate in the ``given`` mask.
        scene: the frame, of `ipjax.detection.crops.read_scene`.
        given: a mask of it.
        options: of `Estimator.run`.

    Returns:
        None where there is no pose, or all of the depth where it is belongs to something else.
    """
    found = first.estimate
    if not bool(found.success):
        return None
    mask = mask_from_pose(first.templates, found.camera_from_object, scene.matrix, scene.depth, config)[0]
    cut: dict[str, Any] = {"resolution": first.info.resolution} | estimator.options
    cut.pop("depth_scale", None)  # the scene is in metres
    crop = cut_crop(scene, mask, **cut)
    if crop is None:
        return None
    again = estimator.run(index, crop.view, crop.camera_from_crop, **options)
    used = _value(again) >= _value(first)
    return Mended(
        result=again if used else first,
        mask=mask,
        overlap=overlap(given, mask),
        added=int((mask & ~given).sum()),
        removed=int((given & ~mask).sum()),
        used=used,
        before=float(found.confidence),
    )


def _value(result: Result) -> float:
    found = result.estimate
    return float(found.confidence) * float(found.hypotheses.score[0]) if bool(found.success) else 0.0
