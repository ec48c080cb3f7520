"""The first poses of a capture, by whichever way it allows, and how good they are."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from ipjax.capture.moving import find_moving
from ipjax.capture.poses import rgbd, structure
from ipjax.capture.poses.boards import Board
from ipjax.capture.poses.features import Features, Match, detect, match
from ipjax.capture.poses.given import check_given, read_given
from ipjax.capture.poses.scale import make_metric
from ipjax.capture.poses.sightings import find_by_board
from ipjax.capture.poses.tracks import clean, join, reproject, triangulate
from ipjax.capture.records import Capture, CaptureError, Tracks, Trajectory
from ipjax.capture.splatting import with_depth
from ipjax.files.wording import abbreviate
from ipjax.transforms import Similarity

Method = Literal["auto", "given", "board", "structure", "depth"]
METHODS: tuple[Method, ...] = ("auto", "given", "board", "structure", "depth")


@dataclasses.dataclass(frozen=True)
class InitialPoses:
    """Where the camera stood, and what tells it."""

    trajectory: Trajectory
    tracks: Tracks  # those that the poses explain
    points: Float[np.ndarray, "c 3"]  # of the tracks, in the world
    still: Bool[np.ndarray, "h w"]  # what moves with the camera, as far as it was found
    off: float  # median distance of a point from its pixel, pixels; NaN = there are no tracks
    depth_off: float  # median difference of its depth from the measured one, metres; NaN = none was measured
    notes: tuple[str, ...]  # what a person should know, a sentence each


def find_poses(
    capture: Capture,
    method: Method = "auto",
    *,
    board: Board | None = None,
    find_gripper: bool = True,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> InitialPoses:
    """The poses of a capture's frames, metric.

    Args:
      method: "given", "board", "structure" (motion, by pycolmap), "depth" (features and depth, without pycolmap), or
        "auto": by the board, if one is described; as given, if they are; else by features and depth; and by structure
        from motion, if pycolmap is installed, where that fails or leaves frames out.
      board: what lies in the scene, for "board".
      find_gripper: leave out what moves with the camera.
      seed: same seed, same poses.
      progress: told a step in words, and how many of how many are done.

    Raises:
      CaptureError: in one sentence why there are none.
    """
    say = progress or (lambda step, done, total: None)
    if method == "auto":
        method = "board" if board is not None else "given" if capture.world_from_camera is not None else "auto"
    if method == "board" and board is None:
        raise CaptureError("poses by a board need its description (--board)")
    K = capture.camera.to_matrix()
    features, depths = [], []
    for index in range(len(capture)):
        read = capture.read_frame(index)
        depths.append(read.depth is not None)
        features.append(detect(with_depth(capture, read)))
        say("features", index + 1, len(capture))
    matches, still = match(
        features, K, capture.size, still=find_gripper, progress=lambda done, total: say("matches", done, total)
    )
    tracks = join(features, matches)
    if find_gripper:
        still = still | find_moving(capture)  # plain surfaces have no features
    notes = [*_tell_gripper(still), *_tell_place(capture, depths)]
    if method == "given":
        trajectory = check_given(read_given(capture), tracks, K)
    elif method == "board":
        assert board is not None
        trajectory = find_by_board(capture, board, lambda done, total: say("board", done, total))
    else:
        trajectory = _find(capture, features, matches, method, seed)
    tracks = clean(tracks, trajectory, K)
    points, told = triangulate(tracks, trajectory.world_from_camera, K, trajectory.registered)
    off, own = reproject(tracks, points, trajectory.world_from_camera, K)
    told = told[tracks.track]
    measured = told & (tracks.depth > 0)
    median = lambda values: float(np.median(values)) if len(values) else float("nan")
    depth_off = median(np.abs(own - tracks.depth)[measured])
    return InitialPoses(trajectory, tracks, points, still, median(off[told]), depth_off, tuple(notes))


def _find(
    capture: Capture, features: Sequence[Features], matches: Sequence[Match], method: Method, seed: int
) -> Trajectory:
    """From features and their depth, or from features alone; the poses begin at the first frame that has one.

    With their depth is the surer and the more exact where all is well (benchmarks/results/captures.md); without it
    frames come in whose depth has holes where their features are.
    """
    names, K = capture.names, capture.camera.to_matrix()
    if not any((one.depth > 0).any() for one in features):
        raise CaptureError(f"{capture.folder}: no feature has a measured depth, so nothing tells the scale")
    ways: dict[str, Callable[[], Trajectory]] = {
        "depth": lambda: rgbd.find_by_depth(names, features, matches, K),
        "structure": lambda: make_metric(
            names, structure.map_incrementally(names, features, matches, K, capture.size, seed=seed)
        )[0],
    }
    if method != "auto":
        return _begin_at_first(ways[method]())
    found: list[Trajectory] = []
    reasons: list[str] = []
    for name in ("depth", "structure"):
        if name == "structure" and (not structure.is_available() or (found and found[0].registered.all())):
            continue
        try:
            found.append(ways[name]())
        except CaptureError as error:
            reasons.append(str(error))
    if not found:
        hint = "" if structure.is_available() else f" (another way is at hand: {structure.MISSING})"
        raise CaptureError(reasons[0] + hint)
    return _begin_at_first(max(found, key=lambda one: int(one.registered.sum())))


def _begin_at_first(trajectory: Trajectory) -> Trajectory:
    """The same in the frame of the first camera that has a pose."""
    first = int(trajectory.registered.argmax())
    poses = trajectory.world_from_camera
    moved = poses.take(first).inverse() @ poses
    known = trajectory.registered
    rotation = np.where(known[:, None, None], moved.rotation, np.eye(3))
    translation = np.where(known[:, None], moved.translation, 0)
    return dataclasses.replace(trajectory, world_from_camera=Similarity(rotation, translation, poses.scale))


def _tell_place(capture: Capture, registered: Sequence[bool]) -> list[str]:
    """What was assumed of where the depth camera stands."""
    if all(registered) or capture.depth_camera is None or capture.colour_from_depth is not None:
        return []
    return [
        "where the depth camera stands is not known (colour_from_depth in depth_camera.json), and was taken for the "
        "colour camera's own place: sizes may be some percent off; ipjax capture depth finds it"
    ]


def _tell_gripper(still: Bool[np.ndarray, "h w"]) -> list[str]:
    if not still.any():
        return []
    rows, columns = np.nonzero(still)
    return [
        f"something moves with the camera at columns {columns.min()} to {columns.max()}, rows {rows.min()} to "
        f"{rows.max()} ({100 * still.mean():.0f} % of the image), and was left out; give ignore.png if it is larger"
    ]


def describe(found: InitialPoses) -> list[str]:
    """How good the poses are, in sentences."""
    trajectory, tracks = found.trajectory, found.tracks
    known = trajectory.registered
    count = int(known.sum())
    lines = [f"{count} of {len(trajectory)} frames have a pose, by {trajectory.source}"]
    lost = [name for name, there in zip(trajectory.names, known, strict=True) if not there]
    if lost:
        lines.append(f"without a pose are {abbreviate(lost, 20)}")
    places = trajectory.world_from_camera.translation[known]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    span = np.linalg.norm(np.ptp(places, axis=0))
    lines.append(f"the camera went {steps.sum():.2f} m, within {span:.2f} m")
    if trajectory.agreement is not None:
        lines.append(f"{100 * trajectory.agreement:.0f} % of the measured depths agree with it")
    if tracks.count:
        lines.append(
            f"{tracks.count} points were recognised in several frames; by the median they lie {found.off:.2f} pixels "
            f"off and their depth {1000 * found.depth_off:.1f} mm from the measured one"
        )
    return lines + list(found.notes)
