"""Looking through a capture once: every measure that the findings rest on."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Int

from ipjax.capture.checks.images import ImageMeasures, measure_image
from ipjax.capture.checks.neighbours import PairMeasures, measure_pair
from ipjax.capture.checks.registration import EdgeCorrelation, Shift
from ipjax.capture.poses.features import Match, detect, find_still, look_up, match_pair
from ipjax.capture.poses.given import misreadings, read_given
from ipjax.capture.records import Capture, CaptureFrame
from ipjax.transforms import Similarity

_MOST = 60  # frames that are looked at: of a longer capture, runs that are spread over it
_RUN = 4  # frames of a run
_POINTS = 1000  # features of a frame
_AFTER = 3  # a thing that stays is sought between frames so far apart, too: neighbours may not have moved enough


@dataclasses.dataclass(frozen=True)
class Inspection:
    """What was measured of a capture."""

    capture: Capture
    looked_at: Int[np.ndarray, " k"]  # indices of the frames
    images: tuple[ImageMeasures, ...]  # of each of them
    pairs: tuple[PairMeasures, ...]  # of those that follow one another
    readings: tuple[str, ...]  # in which ways the given poses were read: "" = as they are; () = there are none
    registered: bool  # whether there is depth in the colours' pixels
    shift: Shift | None  # of depth against the colours; None = too few outlines, or no depth that is registered
    still: Bool[np.ndarray, "h w"]  # what moves with the camera and is not masked
    masked: float  # share of the image that masks hide already


def inspect(capture: Capture, *, progress: Callable[[int, int], None] | None = None) -> Inspection:
    """Look through a capture.

    Args:
      progress: called as ``progress(done, total)`` after every frame.

    Raises:
      CaptureError: a frame cannot be read.
    """
    looked_at = _choose(len(capture))
    matrix = capture.camera.to_matrix()
    edges, registered = EdgeCorrelation(), False
    images, features, masked = [], [], []
    for done, index in enumerate(looked_at, 1):
        frame = capture.read_frame(int(index))
        images.append(measure_image(frame))
        features.append(detect(frame, _POINTS))
        masked.append(1 - float(frame.usable.mean()))
        if frame.depth is not None:
            registered = True
            edges.add(frame.rgb, np.where(frame.usable, frame.depth, 0))
        if progress is not None:
            progress(done, 2 * len(looked_at) - 1)
    steps = [1, _AFTER]
    tried = [(i, i + step) for step in steps for i in range(len(looked_at) - step)]
    raw = {pair: match_pair(features, *pair) for pair in tried}
    still = find_still(features, list(raw.values()), capture.size)
    hidden = [look_up(still, one.pixel) if len(one) else np.zeros(0, bool) for one in features]
    readings, poses = _read_poses(capture)
    pairs = []
    frame: CaptureFrame | None = None
    for i in range(len(looked_at) - 1):
        if progress is not None:
            progress(len(looked_at) + i + 1, 2 * len(looked_at) - 1)
        if looked_at[i + 1] != looked_at[i] + 1:
            frame = None
            continue
        first = frame or capture.read_frame(int(looked_at[i]))
        frame = capture.read_frame(int(looked_at[i + 1]))
        found = _leave_out(raw[i, i + 1], hidden)
        both = [(pose.take(int(looked_at[i])), pose.take(int(looked_at[i + 1]))) for pose in poses]
        pairs.append(measure_pair((first, frame), features, found, matrix, both))
    return Inspection(
        capture=capture,
        looked_at=looked_at,
        images=tuple(images),
        pairs=tuple(pairs),
        readings=readings,
        registered=registered,
        shift=edges.find_shift(),
        still=still,
        masked=float(np.mean(masked)),
    )


def _choose(count: int) -> np.ndarray:
    """Which frames are looked at: all, or runs spread over a long capture."""
    if count <= _MOST:
        return np.arange(count)
    starts = np.linspace(0, count - _RUN, _MOST // _RUN).astype(int)
    return np.unique(starts[:, None] + np.arange(_RUN))


def _read_poses(capture: Capture) -> tuple[tuple[str, ...], list[Similarity[np.ndarray]]]:
    """The given poses as they are, and as they may be meant."""
    if capture.world_from_camera is None:
        return (), []
    given = read_given(capture)
    forms = [("", given), *misreadings(given)]
    return tuple(text for text, _ in forms), [form.world_from_camera for _, form in forms]


def _leave_out(found: Match, hidden: list[np.ndarray]) -> Match:
    """Without what moves with the camera."""
    return found.only(~(hidden[found.first][found.points[:, 0]] | hidden[found.second][found.points[:, 1]]))
