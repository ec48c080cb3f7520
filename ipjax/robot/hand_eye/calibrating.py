"""From a camera's views of a board and the robot's poses to where the camera is mounted; what does not fit is named."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from ipjax.files.wording import abbreviate
from ipjax.robot.hand_eye.motion import FEWEST, check_motion
from ipjax.robot.hand_eye.pairing import agree, find_shift, match, tell_shift
from ipjax.robot.hand_eye.records import EYES, Eye, HandEye, HandEyeError, Views
from ipjax.robot.hand_eye.solving import find_stretch, solve
from ipjax.transforms import Similarity

_SHARE = 0.6  # of the views that must agree
_STRETCHED = 0.005  # of a board's size, that is told where it is certain


@dataclasses.dataclass(frozen=True)
class Calibration:
    """An answer, and what was noticed on the way to it."""

    found: HandEye
    names: tuple[str, ...]  # of the views
    wrong: dict[str, str]  # views that were left out, each with a sentence that begins with its name
    stretch: float  # how much larger the board seems to be than was told (or the robot's metre smaller), 0.01 = 1 %
    stretch_std: float
    notes: tuple[str, ...]  # sentences


def calibrate(
    camera_from_board: Similarity[np.ndarray],
    base_from_gripper: Similarity[np.ndarray],
    eye: Eye,
    *,
    covariance: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    own: Int[np.ndarray, " n"] | None = None,
) -> Calibration:
    """Where the camera is mounted: ``gripper_from_camera`` (in-hand) or ``base_from_camera`` (to-hand).

    Pairs of image and pose that do not fit the others are left out and named.

    Args:
      camera_from_board: of n images, in the order in which they were taken, metres.
      base_from_gripper: of m robot poses, in that order, metres.
      eye: "in-hand", or "to-hand" where the camera stands beside the robot, whose hand holds the board.
      covariance: of camera_from_board, [n, 6, 6] (see `records.Views`).
      names: of the images; numbers where they are not given.
      own: the number of each image's pose; their own numbers where it is not given.

    Raises:
      HandEyeError: too few views, too little motion, a shifted pairing, or poses and images that do not fit at all;
        one sentence that says what to do.
    """
    if eye not in EYES:
        raise HandEyeError(f"a camera is in-hand or to-hand, not {eye!r}")
    count, poses = len(camera_from_board.scale), len(base_from_gripper.scale)
    names = tuple(f"{i:06d}" for i in range(count)) if names is None else tuple(names)
    own = np.arange(count) if own is None else own
    paired = own < poses
    notes = check_motion(base_from_gripper.take(own[paired]))
    views = Views(base_from_gripper.take(own[paired]), camera_from_board.take(paired))
    agreed = agree(views, eye)
    if agreed is None or (~agreed.counted).sum() > 1 or not paired.all():
        shifted = find_shift(camera_from_board, base_from_gripper, own, eye)
        if shifted is not None:
            said = tell_shift(names, match(camera_from_board, base_from_gripper, shifted), own)
            if said is not None:
                raise HandEyeError(said)
    if not paired.all():
        if agreed is None or not agreed.counted.all():
            raise HandEyeError(
                f"there are {count} images and {poses} poses without names, and no order in which they fit: give "
                "poses by the images' names"
            )
        notes.append(f"{abbreviate([n for n, known in zip(names, paired, strict=True) if not known])}: no robot pose")
        names, own = tuple(n for n, known in zip(names, paired, strict=True) if known), own[paired]
        camera_from_board, covariance = views.camera_from_board, None if covariance is None else covariance[paired]
    if agreed is None or len(agreed.used) < max(FEWEST, _SHARE * len(views)):
        raise HandEyeError(_tell_misfit(views, eye, 0 if agreed is None else len(agreed.used)))
    views = dataclasses.replace(views, covariance=covariance)
    begin = agreed.mount_from_camera, agreed.holder_from_board
    found = solve(views, eye, begin, counted=agreed.counted)
    check_motion(views.base_from_gripper.take(found.used), "views that fit one another")
    wrong = _tell_wrong(names, found, match(camera_from_board, base_from_gripper, agreed), own)
    stretch, deviation = find_stretch(views, found)
    if abs(stretch) > max(_STRETCHED, 4 * deviation):
        notes.append(
            f"the board seems to be {100 * abs(stretch):.1f} % {'larger' if stretch > 0 else 'smaller'} than was told "
            f"(± {100 * deviation:.1f} %): measure its squares; printers scale pages, and a wrong focal length looks so"
        )
    return Calibration(found, names, wrong, stretch, deviation, tuple(notes))


def _tell_misfit(views: Views, eye: Eye, count: int) -> str:
    """Why nothing fits, in one sentence: the direction, poses that are inverted, or what may be."""
    other: Eye = "to-hand" if eye == "in-hand" else "in-hand"
    agreed = agree(views, other)
    if agreed is not None and len(agreed.used) >= max(FEWEST, _SHARE * len(views)):
        return (
            f"images and robot poses do not fit --eye {eye}, but they fit --eye {other}, or robot poses that are "
            "gripper_from_base, inverted: base_from_gripper is expected"
        )
    return (
        f"images and robot poses do not fit one another: {count or 'no four'} of {len(views)} views agree on where the "
        "camera is; are these the poses of the images, of the hand in the base's frame, is their rotation written "
        "as was said, and was the board fixed?"
    )


def _tell_wrong(names: Sequence[str], found: HandEye, fits: np.ndarray, own: np.ndarray) -> dict[str, str]:
    """A sentence for each view that was left out."""
    wrong = {}
    for number in np.flatnonzero(~found.counted).tolist():
        off = found.left_out[number]
        turn, shift = np.degrees(np.linalg.norm(off[:3])), 1000 * np.linalg.norm(off[3:])
        elsewhere = [i for i, pose in enumerate(own) if i != number and fits[number, pose]]
        hint = f"; it fits the pose of {names[elsewhere[0]]}" if len(elsewhere) == 1 else ""
        wrong[names[number]] = (
            f"{names[number]}: image and robot pose do not belong together (off by {turn:.1f}° and {shift:.0f} mm)"
            f"{hint}; left out"
        )
    return wrong
