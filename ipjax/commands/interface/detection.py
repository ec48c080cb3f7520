"""Objects of a frame that no mask was given for: where they were found, and what is told of it."""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

from ipjax.commands.interface.frames import FrameFiles, Images
from ipjax.commands.interface.messages import Messages

ALL = "all"


@dataclasses.dataclass(frozen=True)
class Found:
    """An object's estimate in a frame, in the mask that was found for it."""

    index: int  # of the object
    result: Any  # `ipjax.inference.estimator.Result`; None where nothing was found
    mask: Any  # height × width, of the image without lens distortion
    seconds: float  # of cutting it out
    diameter: float | None  # that was given
    about: dict[str, Any] | None  # how the mask was found, as JSON


def parse_instances(text: str) -> int | None:
    """``--instances``: a number from 1 on, or "all", which is None."""
    if text == ALL:
        return None
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"a number from 1 on, or {ALL!r}, not {text!r}")
    return count


def is_without_masks(files: FrameFiles) -> bool:
    """No mask and no box says where the objects are."""
    return not any(mask is not None for mask in files.masks) and not any(box is not None for box in files.boxes)


def make_detector(objects: list[tuple[Any, Any]], encoder: Any, *, quick: bool, crop: str) -> Any:
    """An `ipjax.Detector` of the objects of the command line."""
    from ipjax.detection.detector import Detector

    return Detector(objects, encoder, quick=quick, crop=crop)


def detect_frame(
    name: str,
    images: Images,
    detector: Any,
    estimator: Any,
    diameters: list[float | None],
    arguments: argparse.Namespace,
    messages: Messages,
) -> tuple[list[Found], dict[str, Any]]:
    """Find the objects, and estimate each in the mask that was found, with the settings that were asked for; write the
    page of ``--explain``.

    Returns:
        For each object, in their order, its instances, the surest first: the best guess, and of several those that are
        present; and how they were ranked and what was rejected, as JSON.
    """
    messages.print_notes()
    start = time.perf_counter()
    detections = detector.detect(
        images.rgb,
        images.depth,
        images.camera,
        instances=arguments.instances,
        diameters=diameters,
        clicks=arguments.click,
        depth_scale=arguments.depth_scale,
        seed=arguments.seed,
        progress=not arguments.quiet,
    )
    spent = time.perf_counter() - start
    detections, seconds = _estimate_again(detections, estimator, diameters, arguments)
    told, rejected = detections.told()
    found = []
    for index in range(len(estimator.objects)):
        size = diameters[index]
        mine = [one for one in told if one.index == index]
        known = [Found(index, one.result, one.mask, seconds[id(one)], size, _about(one)) for one in mine]
        found += known or [Found(index, None, None, 0.0, size, None)]
    count, hits = len(detections.proposals.masks), len(told)
    many = {0: "no mask was", 1: "the mask was"}.get(hits, f"{hits} masks were")
    messages.note(f"{name}: {many} found, not given: {count} proposals, ranked and verified in {spent:.1f} s")
    entry = {
        "proposals": count,
        "seconds": {stage: round(value, 6) for stage, value in detections.seconds.items()},
        "ranking": [
            {
                "object": one.name,
                "proposals": one.proposals.tolist(),
                "similarity": one.similarity.tolist(),
                "compared_whole": one.whole,
                "estimated": one.estimated,
            }
            for one in detections.rankings
        ],
        "rejected": [_rejected_as_json(one) for one in rejected],
    }
    if arguments.explain is not None:
        entry["page"] = str(_explain(name, detections, arguments))
    return found, entry


def _estimate_again(
    detections: Any, estimator: Any, diameters: list[float | None], arguments: argparse.Namespace
) -> tuple[Any, dict[int, float]]:
    """The detections that are told, estimated as was asked for, and the seconds that cutting each out took, by its id;
    one that cannot be cut out is rejected."""
    from ipjax.detection.crops import cut_crop
    from ipjax.detection.records import Reason, Rejected, Step

    told, rejected = detections.told()
    found, lost, seconds = [], [], {}
    for one in told:
        start = time.perf_counter()
        resolution = estimator.objects[one.index][1].resolution
        crop = cut_crop(detections.scene, one.mask, resolution=resolution, crop=arguments.crop)
        spent = time.perf_counter() - start
        if crop is None:
            about = one.index, one.name, one.proposal, one.similarity
            words = "there is no depth to trust in the mask of its pose"
            known = one.confidence, one.score, one.mask, one.steps
            lost.append(Rejected(*about, words, Reason.OTHER_DEPTH, None, *known))
            continue
        given = {"seed": arguments.seed, "diameter": diameters[one.index]}
        result = estimator.run(one.index, crop.view, crop.camera_from_crop, **given)
        step = Step.of("that mask, with the settings asked for", one.mask, result, result.value)
        found.append(dataclasses.replace(one, result=result, score=step.score, steps=(*one.steps, step)))
        seconds[id(found[-1])] = spent
    found.sort(key=lambda one: -one.score)
    return dataclasses.replace(detections, found=tuple(found), rejected=(*rejected, *lost)), seconds


def _explain(name: str, detections: Any, arguments: argparse.Namespace) -> Path:
    """Write the page of a frame; with ``--frames`` one in the folder, which is made."""
    from ipjax.detection.explanation.page import explain

    path = arguments.explain
    if arguments.frames is not None:
        path.mkdir(parents=True, exist_ok=True)
        path = path / f"{name}.html"
    explain(path, detections, name)
    return path


def _rejected_as_json(one: Any) -> dict[str, Any]:
    return {
        "object": one.name,
        "proposal": one.proposal,
        "similarity": one.similarity,
        "confidence": one.confidence,
        "score": one.score,
        "why": one.why.value,
        "reason": one.reason,
        "lost_to": None if one.rival is None else dataclasses.asdict(one.rival),
        "steps": [_step_as_json(step) for step in one.steps],
    }


def _step_as_json(one: Any) -> dict[str, Any]:
    return {
        "where": one.where,
        "success": one.success,
        "confidence": one.confidence,
        "score": one.score,
        "pixels": int(one.mask.sum()),
    }


def _about(one: Any) -> dict[str, Any]:
    from ipjax.files.images.run_lengths import encode_rle

    return {
        "how": "a proposal that looks like the object, verified by its pose; the mask is that of the pose",
        "score": one.score,
        "confidence": one.confidence,
        "box": list(one.box),
        "mask": encode_rle(one.mask),
        "proposal": one.proposal,
        "similarity": one.similarity,
        "overlap_with_proposal": one.overlap,
        "steps": [_step_as_json(step) for step in one.steps],
    }


def mend_mask(
    name: str,
    images: Images,
    sight: Any,
    detector: Any,
    estimator: Any,
    index: int,
    first: Any,
    mask: Any,
    messages: Messages,
    **options: Any,
) -> tuple[Any, dict[str, Any] | None, Any]:
    """``--mask-is-rough``: estimate again in the mask that the best pose gives.

    Args:
        sight: of `ipjax.Detector.look` at the frame.
        first: the estimate in the given mask.
        options: of `ipjax.Estimator.run`.

    Returns:
        The surer result, what changed as JSON (None where there is no mask to mend), and the mask.
    """
    from ipjax.detection.crops import cut_crop, undistort_mask
    from ipjax.detection.rough import mend_mask, rate_pose
    from ipjax.files.images.run_lengths import encode_rle

    info = estimator.objects[index][1]
    given = undistort_mask(mask, images.camera)
    mended = mend_mask(detector, index, sight, given, **options)
    cut = {"resolution": info.resolution, "crop": estimator.options["crop"]}
    crop = None if mended is None else cut_crop(sight.scene, mended.mask, **cut)
    if mended is None or crop is None:
        messages.note(f"{name}: {info.name}: the mask was kept: no pose gives another")
        return first, None, given
    again = estimator.run(index, crop.view, crop.camera_from_crop, **options)
    rate = lambda result: rate_pose(result, given, sight.scene, detector.detection)
    used = rate(again) >= rate(first)
    before, after = (float(result.estimate.confidence) for result in (first, again))
    outcome = f"confidence {before:.2f} → {after:.2f}" if used else "kept as it was: it is the surer one"
    by = "" if mended.proposal is None else f", by proposal {mended.proposal}"
    messages.note(
        f"{name}: {info.name}: of the mask {mended.removed} pixels are not the object's and {mended.added} are missing "
        f"(overlap {mended.overlap:.2f}{by}); {outcome}"
    )
    about = {
        "overlap": mended.overlap,
        "added_pixels": mended.added,
        "removed_pixels": mended.removed,
        "proposal": mended.proposal,
        "used": used,
        "confidence_before": before,
        "mask": encode_rle(mended.mask),
    }
    return (again, about, mended.mask) if used else (first, about, given)
