"""Which of all that was tried are detections: one thing is one object, and one instance of it is found once."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ipjax.detection.records import Reason, Rival, Verdict
from ipjax.metrics.surface import add_s
from ipjax.records import Similarity, Templates

SAMPLE = 256  # surface points that two poses are compared by
_distance = jax.jit(add_s)


@dataclasses.dataclass(frozen=True)
class Claim:
    """An object at a pose, and the pixels that it would take."""

    index: int  # of the object
    name: str
    mask: Bool[np.ndarray, "h w"]
    pose: Similarity  # camera_from_object
    confidence: float
    value: float  # what claims are sorted by
    source: Any = None  # what the caller knows it by
    proposal: int = -1  # that led to it

    @property
    def rival(self) -> Rival:
        """It, as what others lost to."""
        return Rival(self.index, self.name, self.proposal, self.confidence)


def shared_share(first: Bool[np.ndarray, "h w"], second: Bool[np.ndarray, "h w"]) -> float:
    """The share of the smaller mask that the other one covers, too."""
    smaller = min(int(first.sum()), int(second.sum()))
    return int((first & second).sum()) / smaller if smaller else 0.0


def overlap(first: Bool[np.ndarray, "h w"], second: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union."""
    either = int((first | second).sum())
    return int((first & second).sum()) / either if either else 0.0


def same_instance(templates: Templates, first: Similarity, second: Similarity, apart: float) -> bool:
    """Whether two poses of an object fill the same space, turns after which it looks the same included.

    By ADD-S, the mean distance of one's surface to the nearest point of the other's, less than ``apart`` diameters of
    the smaller. Two solid things cannot be in one place, so also a pose that is turned wrongly is of that instance.
    """
    points = sample_surface(templates)
    distance = float(_distance(points, first, second))
    return distance < apart * min(float(first.scale), float(second.scale))


def sample_surface(templates: Templates) -> Float[jax.Array, "n 3"]:
    """As many points of every object's surface, so that they are compared by one program."""
    surface = templates.surface
    points = np.asarray(surface.points, np.float32)
    points = points[np.asarray(surface.normals).any(axis=1)]  # padding repeats the first point, without a normal
    return jnp.asarray(points[np.linspace(0, len(points) - 1, SAMPLE).astype(int)])


def assign(
    claims: Sequence[Claim],
    templates: Sequence[Templates],
    *,
    instances: int | Sequence[int],
    taken: float,
    apart: float,
) -> tuple[list[Claim], list[tuple[Claim, Verdict]]]:
    """Those claims that hold, the surest first, and why each of the others does not.

    The claim of highest value holds first; then the next one whose place is not taken: by its own object (the same pose
    within ``apart`` diameters, or more than ``taken`` of the smaller mask), or by another. By what the poses are worth,
    not by how alike the crops are: objects assigned by that were less precise.

    Args:
      instances: of an object, at most; one number for all, or one for each.
    """
    kept: list[Claim] = []
    dropped: list[tuple[Claim, Verdict]] = []
    for claim in sorted(claims, key=lambda one: -one.value):
        mine = [one for one in kept if one.index == claim.index]
        again = next(((why, one) for one in mine if (why := _why_same(claim, one, templates, taken, apart))), None)
        other = next((one for one in kept if shared_share(one.mask, claim.mask) > taken), None)
        most = instances if isinstance(instances, int) else instances[claim.index]
        if again is not None:
            why, one = again
            by = "its mask" if why is Reason.SAME_MASK else "its pose"
            words = f"the same instance, by {by}, was found with more confidence"
            dropped.append((claim, Verdict(why, words, one.rival)))
        elif other is not None:
            words = f"its pixels are taken by {other.name}, which is surer"
            dropped.append((claim, Verdict(Reason.CLAIMED, words, other.rival)))
        elif len(mine) >= most:
            words = f"{most} surer instance{'s were' if most > 1 else ' was'} found"
            dropped.append((claim, Verdict(Reason.ENOUGH, words, mine[-1].rival)))
        else:
            kept.append(claim)
    return kept, dropped


def _why_same(claim: Claim, other: Claim, templates: Sequence[Templates], taken: float, apart: float) -> Reason | None:
    if shared_share(claim.mask, other.mask) > taken:
        return Reason.SAME_MASK
    same = same_instance(templates[claim.index], claim.pose, other.pose, apart)
    return Reason.SAME_PLACE if same else None
