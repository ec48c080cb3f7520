"""Poses by a printed board, whose frame is the world: ChArUco, or a grid of ArUco markers, through OpenCV.

A board is written in one word, as ``KIND:COLUMNSxROWS:LENGTH:LENGTH:DICTIONARY``, lengths in metres::

    charuco:7x5:0.04:0.03:DICT_4X4_50      squares of 40 mm, markers of 30 mm
    aruco:5x7:0.04:0.01:DICT_6X6_250       markers of 40 mm, 10 mm apart

The world's origin is a corner of the board, x and y lie in it, z goes into it, as OpenCV has them.
"""

import dataclasses
import re
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.capture.records import Capture, CaptureError, CaptureFrame, Trajectory
from ipjax.files.wording import abbreviate
from ipjax.transforms import Similarity, rotation_from_vector

FEWEST = 6  # corners of the board that a frame needs
WITHIN = 2.0  # pixels, root mean square, that they may be off
_CLEARER = 1.5  # times that the second pose of a plane must fit worse, for the first to be sure
FORM = "KIND:COLUMNSxROWS:LENGTH:LENGTH:DICTIONARY, for instance charuco:7x5:0.04:0.03:DICT_4X4_50"


@dataclasses.dataclass(frozen=True)
class Board:
    """A printed board."""

    kind: str  # "charuco" or "aruco"
    columns: int  # of squares (charuco) or of markers (aruco)
    rows: int
    length: float  # of a square (charuco) or of a marker (aruco), metres
    other: float  # of a marker (charuco), or between markers (aruco), metres
    dictionary: str  # by OpenCV's name

    def make(self) -> Any:
        """The board as OpenCV describes it."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        kind = cv2.aruco.CharucoBoard if self.kind == "charuco" else cv2.aruco.GridBoard
        return kind((self.columns, self.rows), self.length, self.other, dictionary)


def parse_board(text: str) -> Board:
    """The board that a word describes.

    Raises:
      CaptureError: it describes none; says how one is written.
    """
    import cv2

    number = r"(\d*\.?\d+)"
    found = re.fullmatch(rf"(charuco|aruco):(\d+)x(\d+):{number}:{number}:(\w+)", text)
    if found is None:
        raise CaptureError(f"{text!r} describes no board: write {FORM}")
    kind, columns, rows, length, other, dictionary = found.groups()
    if not dictionary.startswith("DICT_") or not hasattr(cv2.aruco, dictionary):
        raise CaptureError(f"OpenCV knows no dictionary of markers {dictionary!r}, but DICT_4X4_50, DICT_6X6_250 …")
    board = Board(kind, int(columns), int(rows), float(length), float(other), dictionary)
    if not 0 < board.length < 2 or board.other <= 0 or (kind == "charuco" and board.other >= board.length):
        raise CaptureError(f"{text!r}: lengths are in metres, and a marker is smaller than its square")
    needed = board.columns * board.rows // (2 if kind == "charuco" else 1)
    there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)
    if needed > there:
        raise CaptureError(f"{text!r}: the dictionary has {there} markers, and the board takes {needed}")
    if min(board.columns, board.rows) < 2:
        raise CaptureError(f"{text!r}: a board has two rows and two columns or more")
    return board


def find_by_board(capture: Capture, board: Board, progress: Any = None) -> Trajectory:
    """The poses of all frames that see the board well.

    Raises:
      CaptureError: fewer than half of the frames do.
    """
    K = capture.camera.to_matrix()
    detector = _make_detector(board)
    count = len(capture)
    rotation, translation, registered = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, bool)
    for index in range(count):
        pose = locate(capture.read_frame(index), detector, K)
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


def _make_detector(board: Board) -> Any:
    """A function from a grey image to points of the board (n × 3) and their pixels (n × 2)."""
    import cv2

    made = board.make()
    if board.kind == "charuco":
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


def locate(frame: CaptureFrame, detector: Any, K: Float[np.ndarray, "3 3"]) -> Similarity[np.ndarray] | None:
    """``world_from_camera`` of a frame; None where the board is not seen, or either of a plane's two poses may be."""
    import cv2

    points, pixels = detector(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY))
    if points is None or len(points) < FEWEST:
        return None
    points, pixels = points.reshape(-1, 3).astype(np.float64), pixels.reshape(-1, 2).astype(np.float64)
    count, turns, shifts, errors = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    if not count or not np.isfinite(errors).all():
        return None
    turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, turns[0], shifts[0])
    drawn = cv2.projectPoints(points, turn, shift, K, None)[0].reshape(-1, 2)
    off = np.sqrt(((drawn - pixels) ** 2).sum(1).mean())
    if off > WITHIN or (count > 1 and errors[1].item() < _CLEARER * errors[0].item() and off > 0.3):
        return None
    camera_from_world = Similarity(rotation_from_vector(turn.reshape(3)), shift.reshape(3), np.ones(()))
    return camera_from_world.inverse()
