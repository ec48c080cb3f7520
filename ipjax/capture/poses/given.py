"""Poses that were given (a robot, motion capture, another program): checked against the images before they are trusted.

Files of poses are easy to misread: turned around (camera_from_world), in millimetres, of other frames, with other axes.
Each shows in the tracks: their rays do not meet, or meet at depths that were not measured.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ipjax.capture.poses.scale import LEAST_SHARE, vote
from ipjax.capture.poses.tracks import reproject, triangulate
from ipjax.capture.records import Capture, CaptureError, Tracks, Trajectory
from ipjax.transforms import Similarity

WITHIN = 0.05  # of the depth: robots and motion capture are off by millimetres, which short baselines enlarge
FEWEST = 50  # tracks with measured depth that a judgement takes
_AXES = np.diag([1.0, -1, -1])  # from OpenGL's camera axes to OpenCV's, and back


def read_given(capture: Capture) -> Trajectory:
    """The poses that the capture has, of all of its frames.

    Raises:
      CaptureError: there are none, they are not finite, or the camera never moves.
    """
    poses = capture.world_from_camera
    if poses is None:
        raise CaptureError(f"{capture.folder}: no poses are given there (poses.json)")
    if not all(np.isfinite(part).all() for part in (poses.rotation, poses.translation, poses.scale)):
        raise CaptureError(f"{capture.folder}: poses that are not finite are given")
    if len(capture) > 1 and np.ptp(poses.translation, axis=0).max() < 1e-4:
        raise CaptureError(f"{capture.folder}: by the poses that are given the camera never moves, not by 0.1 mm")
    return Trajectory(capture.names, poses.to_numpy(), np.ones(len(capture), bool), "given")


def check_given(trajectory: Trajectory, tracks: Tracks, K: Float[np.ndarray, "3 3"]) -> Trajectory:
    """The same with the depth's agreement; it is as it was given, whatever its scale.

    Raises:
      CaptureError: the poses do not belong to the images, or not in this form; says in which they would.
    """
    found = _judge(trajectory, tracks, K)
    if found is None:
        return trajectory  # too few tracks to judge by
    share, scale = found
    if share >= LEAST_SHARE:
        if abs(scale - 1) > WITHIN:
            raise CaptureError(
                f"the poses that are given are not in metres: by the depth, their unit is {scale:.4g} m (or the "
                "depth's unit is wrong: see depth_scale)"
            )
        return Trajectory(trajectory.names, trajectory.world_from_camera, trajectory.registered, trajectory.source,
                          trajectory.covariance, 1.0, share)  # fmt: skip
    for text, changed in misreadings(trajectory):
        other = _judge(changed, tracks, K)
        if other is not None and other[0] >= max(LEAST_SHARE, 2 * share):
            raise CaptureError(f"the poses that are given fit the images only read as {text}: give world_from_camera")
    raise CaptureError(
        f"the poses that are given do not fit the images: of the depths they imply only {100 * share:.0f} % were "
        "measured; are they of these frames, in this order, with OpenCV's camera axes (x right, y down, z ahead)?"
    )


def _judge(trajectory: Trajectory, tracks: Tracks, K: Float[np.ndarray, "3 3"]) -> tuple[float, float] | None:
    """The share of measured depths that agree on a scale of the poses' depths, and that scale; None = too few."""
    poses = trajectory.world_from_camera
    points, told = triangulate(tracks, poses, K, trajectory.registered)
    _, own = reproject(tracks, points, poses, K)
    asked = told[tracks.track] & (tracks.depth > 0) & trajectory.registered[tracks.frame]
    if asked.sum() < FEWEST:
        return None
    found = vote(np.where(asked, tracks.depth, 0), own, WITHIN)
    if found is None:
        return 0.0, 1.0
    return float(found.agreeing.sum() / asked.sum()), found.value  # a point behind its camera does not agree


def misreadings(trajectory: Trajectory) -> Sequence[tuple[str, Trajectory]]:
    """In words, and as they would be meant."""
    poses = trajectory.world_from_camera
    turned = poses.inverse()
    flip = Similarity(_AXES, np.zeros(3), np.ones(()))
    forms = [
        ("camera_from_world, turned around", turned),
        ("OpenGL's camera axes (y up, z back)", poses @ flip),
        ("camera_from_world in OpenGL's camera axes (y up, z back)", (flip @ poses).inverse()),
    ]
    return [(text, Trajectory(trajectory.names, form, trajectory.registered, "given")) for text, form in forms]
