"""Where a camera sees a printed board: its corners in an image, and its pose by them, through OpenCV."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from ipjax.cameras import project
from ipjax.capture.poses.boards import Board
from ipjax.capture.records import Capture, CaptureError, CaptureFrame, Trajectory
from ipjax.files.wording import abbreviate
from ipjax.transforms import Similarity, retract, rotation_from_vector

FEWEST = 6  # corners of the board that a frame needs
WITHIN = 2.0  # pixels, root mean square, that they may be off
_CLEARER = 1.5  # times that the second pose of a plane must fit worse, for the first to be sure
_STEP = 1e-6  # rad and m, of the numeric derivatives
# From a grey image to points of the board (n × 3, metres) and their pixels (n × 2); None of both where there are none.
FindCorners = Callable[[UInt8[np.ndarray, "h w"]], tuple[Any, Any]]


@dataclasses.dataclass(frozen=True)
class Sighting:
    """A board as an image shows it."""

    points: Float[np.ndarray, "n 3"]  # corners that were found, in the board's frame, metres
    pixels: Float[np.ndarray, "n 2"]  # where they are in the image, without distortion
    camera_from_board: Similarity[np.ndarray]  # rigid, metres
    off: float  # pixels, root mean square, between the corners and where the pose has them

    def spread(self, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "6 6"]:
        """The covariance of the pose where corners are off by one pixel along each axis.

        Of rotation (rad) and translation (m) about the board's origin, as `ipjax.transforms.difference` has them.
        """
        steps = _STEP * np.concatenate([np.eye(6), -np.eye(6)])
        many = Similarity[np.ndarray].stack([self.camera_from_board] * 12)
        drawn = project(K, retract(many, steps) @ self.points).reshape(12, -1)
        slope = (drawn[:6] - drawn[6:]) / (2 * _STEP)
        return np.linalg.inv(slope @ slope.T)


def find_by_board(capture: Capture, board: Board, progress: Any = None) -> Trajectory:
    """The poses of all frames that see the board well; the board is the world.

    Raises:
      CaptureError: fewer than half of the frames do.
    """
    K = capture.camera.to_matrix()
    find_corners = make_detector(board)
    count = len(capture)
    rotation, translation, registered = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, bool)
    for index in range(count):
        pose = locate(capture.read_frame(index), find_corners, K)
        if pose is not None:
            rotation[index], translation[index], registered[index] = pose.rotation, pose.translation, True
        if progress is not None:
            progress(index + 1, count)
    if registered.sum() < max(2, count / 2):
        lost = [name for name, known in zip(capture.names, registered, strict=True) if not known]
        raise CaptureError(
            f"the board was found in {int(registered.sum())} of {count} frames, not in {abbreviate(lost, 8)}: are its "
            "kind, squares and dictionary as they were given?"
        )
    return Trajectory(capture.names, Similarity(rotation, translation, np.ones(count)), registered, "board")


def locate(
    frame: CaptureFrame, find_corners: FindCorners, K: Float[np.ndarray, "3 3"]
) -> Similarity[np.ndarray] | None:
    """``world_from_camera`` of a frame; None where the board is not seen, or either of a plane's two poses may be."""
    try:
        return find_board(to_grey(frame.rgb), find_corners, K).camera_from_board.inverse()
    except CaptureError:
        return None


def to_grey(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """As detectors want it."""
    import cv2

    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


def make_detector(board: Board) -> FindCorners:
    """The function that finds a board's corners."""
    import cv2

    if board.kind == "chessboard":
        return lambda grey: _find_chessboard(grey, board)
    made = board.make()
    if board.kind != "aruco":
        detector = cv2.aruco.CharucoDetector(made)

        def find(grey: np.ndarray) -> tuple[Any, Any]:
            corners, numbers, *_ = detector.detectBoard(grey)
            return made.matchImagePoints(corners, numbers) if numbers is not None and len(numbers) else (None, None)

        return find
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers = cv2.aruco.ArucoDetector(made.getDictionary(), parameters)

    def find_markers(grey: np.ndarray) -> tuple[Any, Any]:
        corners, numbers, _ = markers.detectMarkers(grey)
        return made.matchImagePoints(corners, numbers) if numbers is not None and len(numbers) else (None, None)

    return find_markers


def find_board(
    grey: UInt8[np.ndarray, "h w"],
    find_corners: FindCorners,
    K: Float[np.ndarray, "3 3"],
    undistort: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]] | None = None,
) -> Sighting:
    """The board in an image, and its pose.

    Args:
      grey: as the camera gave it.
      find_corners: of `make_detector`.
      K: of the camera, pixels.
      undistort: from the image's pixels to those of a pinhole with K; None = the image is one of a pinhole.

    Raises:
      CaptureError: it is not seen, or not well enough, or either of a plane's two poses may be the right one.
    """
    import cv2

    points, pixels = find_corners(grey)
    if points is None:
        raise CaptureError("the board is not found")
    if len(points) < FEWEST:
        raise CaptureError(f"only {len(points)} corners of the board are found, and {FEWEST} are needed")
    points, pixels = points.reshape(-1, 3).astype(np.float64), pixels.reshape(-1, 2).astype(np.float64)
    pixels = pixels if undistort is None else undistort(pixels)
    count, turns, shifts, errors = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    if not count or not np.isfinite(errors).all():
        raise CaptureError("the corners of the board that are found are no plane's: is the camera the image's?")
    turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, turns[0], shifts[0])
    pose = Similarity(rotation_from_vector(turn.reshape(3)), shift.reshape(3), np.ones(()))
    off = float(np.sqrt(np.square(project(K, pose @ points) - pixels).sum(1).mean()))
    if off > WITHIN:
        raise CaptureError(f"the board is off by {off:.1f} pixels: are camera, lens and the board's sizes right?")
    if count > 1 and errors[1].item() < _CLEARER * errors[0].item() and off > 0.3:
        raise CaptureError("the board may be tilted either way: come nearer, or look at it from more aside")
    return Sighting(points, pixels, pose, off)


def _find_chessboard(grey: np.ndarray, board: Board) -> tuple[Any, Any]:
    """The inner corners, counted from the dark corner of the board that x and y lead away from."""
    import cv2

    across, down = board.columns - 1, board.rows - 1
    found, corners = cv2.findChessboardCornersSB(grey, (across, down), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None, None
    grid = corners.reshape(down, across, 2)
    apart = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    window = int(np.clip(0.2 * apart, 2, 10))  # of one corner's surroundings; with it, corners are twice as exact
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-4)
    corners = cv2.cornerSubPix(grey, corners.copy(), (window, window), (-1, -1), until)
    grid = corners.reshape(down, across, 2).astype(np.float64)
    right, below = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * below[1] < right[1] * below[0]:  # as in a mirror
        grid = grid[::-1]
    if _corner_square(grey, grid) > _corner_square(grey, grid[::-1, ::-1]):
        grid = grid[::-1, ::-1]
    x, y = np.meshgrid(np.arange(1, across + 1), np.arange(1, down + 1))
    points = board.length * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    return points.astype(np.float32), grid.reshape(-1, 2).astype(np.float32)


def _corner_square(grey: np.ndarray, grid: np.ndarray) -> float:
    """How bright the first square within the corners is: as dark as the board's first, to which it is diagonal."""
    quad = np.rint([grid[0, 0], grid[0, 1], grid[1, 1], grid[1, 0]]).astype(int)
    middle, half = quad.mean(0), 0.25 * np.ptp(quad, axis=0)
    x0, y0, x1, y1 = (int(v) for v in (*np.maximum(middle - half, 0), *(middle + half + 1)))
    return float(grey[y0:y1, x0:x1].mean())
