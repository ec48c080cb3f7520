"""The masks of a file that holds several: which of them may be the object's, and which it is."""

import dataclasses
import logging
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

MOST = 16  # masks that are tried unless --candidates says otherwise; each takes as long as an estimate
_LARGE = 0.25  # share of the image beyond which a mask is tried last: a wall, a table


@dataclasses.dataclass(frozen=True)
class Choice:
    """What the command line says of the masks of one object's file."""

    name: str  # of the object
    label: int | None = None
    category: int | None = None
    instance: int | None = None
    most: int = MOST


def read_masks(
    path: Path, choice: Choice, size: tuple[int, int], image: int | None = None, scene: int | None = None
) -> list[Any]:
    """The candidates of a mask file that may be of the object, those to be tried first in front.

    Args:
        choice: label, category or number that was asked for. A category that nobody asked for is the number in a name
            of BOP's, obj_000005.
        size: height and width of the image.
        image, scene: which image, in a file of several.

    Raises:
        ValueError: as `ipjax.read_candidates`; nothing of the category or number; several categories and none
            asked for.
    """
    from ipjax.files.images.candidates import DETECTIONS, Candidate, read_candidates
    from ipjax.files.images.masks import read_mask

    if choice.label is not None:
        if path.suffix.lower() in DETECTIONS:
            raise ValueError(f"{path}: --mask-label is of an image of labels; detections have --obj-id and --instance")
        return [Candidate(read_mask(path, choice.label), None, None, 0, f"{path}, label {choice.label}")]
    found = read_candidates(path, size=size, image=image, scene=scene)
    if choice.instance is not None:
        found = [one for one in found if one.index == choice.instance] or _refuse_number(path, choice.instance, found)
    else:
        found = _of_category(path, choice, found)
    if len(found) > choice.most:
        by = "score" if all(one.score is not None for one in found) else "size"
        logging.getLogger("ipjax").info(
            "%s: of %d masks the %d first by %s are tried, one estimate each; --candidates says how many, "
            "--instance which one",
            path,
            len(found),
            choice.most,
            by,
        )
    return _in_order(found)[: choice.most]


def _refuse_number(path: Path, number: int, found: Sequence[Any]) -> list[Any]:
    there = ", ".join(str(one.index) for one in found[:12]) + (" …" if len(found) > 12 else "")
    raise ValueError(f"{path}: it has no mask {number} of this image; there are {there} (--instance)")


def _of_category(path: Path, choice: Choice, found: list[Any]) -> list[Any]:
    there = sorted({one.category for one in found if one.category is not None})
    match = re.fullmatch(r"obj_?(\d+)", choice.name)
    wanted = choice.category
    if wanted is None and match is not None and there:
        wanted = int(match[1])
    if wanted is None:
        if len(there) > 1:
            raise ValueError(
                f"{path}: it has detections of the objects {', '.join(map(str, there))}: say with --obj-id which is "
                f"{choice.name}, or with --instance which detection"
            )
        return found
    mine = [one for one in found if one.category == wanted]
    if not mine:
        has = f"it has those of {', '.join(map(str, there))}" if there else "its masks have no classes"
        raise ValueError(f"{path}: there is no detection of object {wanted}; {has} (--obj-id)")
    return mine


def _in_order(found: list[Any]) -> list[Any]:
    """By falling score; without scores large before small, but what fills much of the image last."""
    if all(one.score is not None for one in found):
        return sorted(found, key=lambda one: -one.score)
    return sorted(found, key=lambda one: (one.mask.mean() > _LARGE, -int(one.mask.sum())))


def check_any(images: Any, candidates: Sequence[Any], box: Any, **options: Any) -> None:
    """Refuse an object of which no mask can be used, for the reason of the first; ValueError, in words."""
    from ipjax.inference.frames import frame

    errors: list[ValueError] = []
    for one in candidates:
        try:
            frame(images.rgb, images.depth, one.mask, images.camera, box=box, **options)
        except ValueError as error:
            errors.append(error)
        else:
            return
    if len(errors) == 1:
        raise errors[0]
    raise ValueError(f"none of {len(errors)} masks can be used; {candidates[0].source}: {errors[0]}")


def estimate_best(
    estimator: Any, index: int, images: Any, candidates: Sequence[Any], box: Any, **options: Any
) -> tuple[Any, float, list[dict[str, Any]]]:
    """Estimate an object in each of several masks, and keep the estimate of highest confidence.

    Args:
        estimator: of `ipjax.Estimator`.
        index: of the object.
        images: of `ipjax.commands.interface.frames.read_frame`.
        candidates: of `read_masks`, not empty.
        box: what lies outside of it is left out of every mask; or None.
        options: of `ipjax.Estimator.run`.

    Returns:
        The best result, the seconds that its crop took, and what became of each mask, as JSON.

    Raises:
        ValueError: no mask can be used; the reason of the first.
    """
    best: tuple[float, Any, float] | None = None
    first: ValueError | None = None
    told = []
    for one in candidates:
        entry: dict[str, Any] = {
            "index": one.index,
            "source": one.source,
            "score": one.score,
            "category": one.category,
            "pixels": int(one.mask.sum()),
            "confidence": None,
            "rejected": None,
            "chosen": False,
        }
        told.append(entry)
        start = time.perf_counter()
        try:
            crop = estimator.frame(index, images.rgb, images.depth, one.mask, images.camera, box)
        except ValueError as error:
            first = first or error
            entry["rejected"] = str(error)
            continue
        seconds = time.perf_counter() - start
        result = estimator.run(index, *crop, **options)
        confidence = float(result.estimate.confidence) if bool(result.estimate.success) else 0.0
        entry["confidence"] = confidence
        if best is None or confidence > best[0]:
            for other in told:
                other["chosen"] = other is entry
            best = confidence, result, seconds
    if best is None:
        raise first or ValueError("there are no masks")
    return best[1], best[2], told
