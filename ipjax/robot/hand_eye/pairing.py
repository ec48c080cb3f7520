"""Which images belong to which robot poses: those on which one calibration agrees are found first, then the others are
judged by it.

The start that most pairs agree on is found among closed forms of four views each (least quantile of squares; P. J.
Rousseeuw, "Least median of squares regression", 1984, https://doi.org/10.1080/01621459.1984.10477105). The pairs whose
error is usual for it join until none is left that could. What does not join is looked for at other poses: an image that
was skipped moves all later ones by one.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2, f

from ipjax.robot.hand_eye.motion import FEWEST
from ipjax.robot.hand_eye.records import Eye, HandEye, Noise, Views
from ipjax.robot.hand_eye.solving import residuals, solve, start_many
from ipjax.transforms import Similarity

SHIFTS = (0, 1, -1, 2, -2)  # places by which a pairing is tried to be wrong
WORST = Noise(np.deg2rad(2), 0.02)  # of a view along each axis, beyond which poses and images do not belong together
_CHANCE = 1e-4  # that a right pair is taken for a wrong one
_DOUBT = 0.01  # chance of a right pair's error, below which it may be a wrong one that hides in the noise it makes
_AGREEING = 0.45  # share of the pairs on which a start must agree: less than half, since half may be shifted
_SUBSETS = 60
_ARM = 0.3  # metres, by which angles and lengths of a start's errors are compared
_ROUNDS = 20


def agree(views: Views, eye: Eye) -> HandEye | None:
    """The calibration on which most pairs of image and pose agree, and which (`HandEye.counted`).

    None where no four of them make one that is better than `WORST`.
    """
    count = len(views)
    if count < FEWEST:
        return None
    plain = dataclasses.replace(views, covariance=None)  # no error of a robot's pose can hide in it, and it is quick
    if (whole := _solve_whole(plain, eye)) is not None:
        return whole
    wanted = min(count, max(FEWEST + 1, int(np.ceil(_AGREEING * count))))
    begin, errors = _find_start(plain, eye, wanted)
    agrees = errors <= np.sort(errors)[wanted - 1]
    # The smallest errors of all tell too small a noise (C. Croux and G. Haesbroeck, 1999, of trimmed covariances).
    share = agrees.mean()
    trimmed = 1.0 if share == 1 else chi2.cdf(chi2.ppf(share, 6), 8) / share
    found = solve(plain, eye, begin, counted=agrees)
    for _ in range(_ROUNDS):
        joined = is_usual(found.distance * trimmed, int(agrees.sum()))
        begin, trimmed = (found.mount_from_camera, found.holder_from_board), 1.0
        if joined.sum() < FEWEST or (joined == agrees).all():
            break
        agrees = joined
        found = solve(plain, eye, begin, counted=agrees)
    return found if _is_fair(found) else None


def _solve_whole(views: Views, eye: Eye) -> HandEye | None:
    """The calibration on which all pairs agree without any doubt; None where there is one."""
    found = solve(views, eye)
    return found if _is_fair(found) and is_usual(found.distance, len(views), _DOUBT).all() else None


def _is_fair(found: HandEye) -> bool:
    return bool(found.noise.rotation < WORST.rotation and found.noise.translation < WORST.translation)


def is_usual(distance: Float[np.ndarray, "*b"], count: int, chance: float = _CHANCE) -> Bool[np.ndarray, "*b"]:
    """Whether an error, in standard deviations that ``count`` pairs told, is one that a right pair may have."""
    return distance < 6 * f.isf(chance, 6, max(6 * count - 12, 1))


def _find_start(
    views: Views, eye: Eye, wanted: int
) -> tuple[tuple[Similarity[np.ndarray], Similarity[np.ndarray]], Float[np.ndarray, " n"]]:
    """The closed form of four views whose errors, the ``wanted`` smallest, are smallest; and all of its errors."""
    rng = np.random.default_rng(0)
    subsets = np.argsort(rng.uniform(size=(_SUBSETS, len(views))), axis=1)[:, :FEWEST]
    mounts, boards = start_many(views, eye, subsets)
    off = residuals(views, eye, mounts, boards)
    size = np.square(_ARM * off[..., :3]).sum(-1) + np.square(off[..., 3:]).sum(-1)
    best = int(np.sort(size, axis=1)[:, wanted - 1].argmin())
    return (mounts.take(best), boards.take(best)), size[best]


def match(
    camera_from_board: Similarity[np.ndarray], base_from_gripper: Similarity[np.ndarray], found: HandEye
) -> Bool[np.ndarray, "n m"]:
    """Which of n images fit which of m robot poses, by a calibration."""
    images, poses = (len(x.scale) for x in (camera_from_board, base_from_gripper))
    first, second = (grid.ravel() for grid in np.indices((images, poses)))
    every = Views(base_from_gripper.take(second), camera_from_board.take(first))
    off = residuals(every, found.eye, found.mount_from_camera, found.holder_from_board)
    deviations = np.repeat([found.noise.rotation, found.noise.translation], 3)
    # Half of it for what the calibration itself does not know.
    return is_usual(0.5 * np.square(off / deviations).sum(-1), len(found.used)).reshape(images, poses)


def find_shift(
    camera_from_board: Similarity[np.ndarray],
    base_from_gripper: Similarity[np.ndarray],
    own: Int[np.ndarray, " n"],
    eye: Eye,
) -> HandEye | None:
    """The calibration on which most pairs agree, be they shifted by a place or two; None where there is none.

    Args:
      camera_from_board: of n images, in order.
      base_from_gripper: of m poses, in order.
      own: the number of the pose that each image was given.
    """
    best, most = None, 0
    for shift in SHIFTS:
        there = (own + shift >= 0) & (own + shift < len(base_from_gripper.scale))
        views = Views(base_from_gripper.take(own[there] + shift), camera_from_board.take(there))
        agreed = agree(views, eye)
        if agreed is not None and len(agreed.used) > most:
            best, most = agreed, len(agreed.used)
    return best


def tell_shift(names: Sequence[str], fits: Bool[np.ndarray, "n m"], own: Int[np.ndarray, " n"]) -> str | None:
    """What is wrong with a pairing, where a run of images fits the poses beside theirs; None where none does.

    Args:
      names: of the images, in order.
      fits: which images fit which poses.
      own: the number of the pose that each image was given, as far as there is one.
    """
    images, last = np.arange(len(names)), fits.shape[1] - 1
    right = fits[images, np.clip(own, 0, last)] & (own <= last)
    runs = []
    for shift in SHIFTS[1:]:
        other = own + shift
        shifted = (other >= 0) & (other <= last) & fits[images, np.clip(other, 0, last)] & ~right
        runs.append((int(shifted.sum()), -abs(shift), shift, np.flatnonzero(shifted)))
    count, _, shift, places = max(runs, key=lambda run: run[:2])
    if not count or count < 0.6 * (places[-1] - places[0] + 1):
        return None
    # What neither fits its own pose nor has another one is of the run that it lies beside.
    first, end = places[0], places[-1]
    while first > 0 and not right[first - 1]:
        first -= 1
    while end < len(names) - 1 and not right[end + 1]:
        end += 1
    has = (own + shift >= 0) & (own + shift <= last)
    if end == first or (has[first : end + 1] & ~np.isin(images[first : end + 1], places)).sum() > 0.4 * count:
        return None
    step = {1: "the pose after theirs", -1: "the pose before theirs", 2: "the second pose after theirs"}
    where = step.get(shift, "the second pose before theirs")
    if first == 0 and end == len(names) - 1:
        who = "all images seem"
    elif end == len(names) - 1:
        who = f"images from {names[first]} on seem"
    elif first == 0:
        who = f"images up to {names[end]} seem"
    else:
        who = f"images from {names[first]} to {names[end]} seem"
    extra = "a pose has no image" if (shift > 0) == (end == len(names) - 1) else "an image has no pose"
    return f"{who} to belong to {where}; {extra} there: remove it, or give poses by the images' names"
