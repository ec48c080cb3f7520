"""Images of a board: where its corners are in each, and the poses they tell; an image without one says why."""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from ipjax.capture.poses.boards import Board, parse_board
from ipjax.capture.poses.sightings import Sighting, find_board, make_detector, to_grey
from ipjax.capture.reading.files import COLOURS
from ipjax.capture.records import CaptureError
from ipjax.files.cameras.intrinsics import Intrinsics, list_misfits
from ipjax.files.images.opening import read_rgb
from ipjax.files.wording import abbreviate
from ipjax.inference.cutting import undistort_pixels
from ipjax.robot.hand_eye.records import HandEyeError

LEAST_OFF = 0.05  # pixels: no printed board, focused lens and calibrated camera agree better
_TRIED = 3  # images in which other boards are looked for, where none has the one that was told


@dataclasses.dataclass(frozen=True)
class Observation:
    """An image, and the board in it."""

    path: Path
    sighting: Sighting | None
    reason: str = ""  # why there is none, a sentence without the image's name

    @property
    def name(self) -> str:
        """Of the image, without its ending."""
        return self.path.stem


def list_images(given: Sequence[Path]) -> list[Path]:
    """The images of folders, and images themselves, in the order of the numbers in their names (2 before 10).

    Raises:
      HandEyeError: there are none, one is missing, or two have one name.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            inside = [p for p in path.iterdir() if p.suffix.lower() in COLOURS and not p.name.startswith(".")]
            if not inside:
                raise HandEyeError(f"{path}: there are no images in this folder ({', '.join(COLOURS)})")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise HandEyeError(f"{path}: no such image or folder")
    found.sort(key=lambda path: [int(w) if i % 2 else w for i, w in enumerate(re.split(r"(\d+)", path.stem))])
    names = [path.stem for path in found]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise HandEyeError(f"two images are called {twice}; give one of them")
    return found


def observe(
    images: Sequence[Path],
    intrinsics: Intrinsics,
    board: Board,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[list[Observation], list[str]]:
    """The board in every image, and doubts about the camera, a sentence each.

    Raises:
      HandEyeError: an image is broken or of another size than the camera's, or the board is in none of them; the
        message says which board is there instead, if another is found.
    """
    find_corners, observations, doubts = make_detector(board), [], []
    for number, path in enumerate(images):
        try:
            rgb = read_rgb(path)
        except ValueError as error:
            raise HandEyeError(str(error)) from None
        size = rgb.shape[1], rgb.shape[0]
        if intrinsics.size is not None and intrinsics.size != size:
            wide, high = intrinsics.size
            raise HandEyeError(f"{path}: {size[0]} × {size[1]} pixels, but the camera is of {wide} × {high}")
        if number == 0:
            doubts = list_misfits(intrinsics, *size)
        try:
            seen = find_board(to_grey(rgb), find_corners, intrinsics.matrix, lambda p: undistort_pixels(p, intrinsics))
            observations.append(Observation(path, seen))
        except CaptureError as error:
            observations.append(Observation(path, None, str(error)))
        if progress is not None:
            progress("looking for the board", number + 1, len(images))
    if not any(one.sighting for one in observations):
        hint = _find_others(images[:_TRIED], board)
        reasons = abbreviate(sorted({one.reason for one in observations}), 2)
        raise HandEyeError(f"{board.word} is seen well enough in none of {len(images)} images: {reasons}{hint}")
    return observations, doubts


def spreads(observations: Sequence[Observation], intrinsics: Intrinsics) -> tuple[Float[np.ndarray, "n 6 6"], float]:
    """The covariances of the boards' poses, by how well the corners of all images fit them; and that, in pixels."""
    seen = [one.sighting for one in observations if one.sighting is not None]
    squares = sum(len(s.points) * s.off**2 for s in seen)
    free = sum(2 * len(s.points) - 6 for s in seen)
    off = max(float(np.sqrt(squares / free)), LEAST_OFF)
    return off**2 * np.stack([s.spread(intrinsics.matrix) for s in seen]), off


def _find_others(images: Sequence[Path], board: Board) -> str:
    """What else the images show, as the end of a sentence; "" where nothing is recognised."""
    import cv2

    greys = [to_grey(read_rgb(path)) for path in images]
    for word in _list_similar(board):
        find = make_detector(parse_board(word))
        if any(_has_board(grey, find) for grey in greys):
            return f"; but {word} is seen there"
    if board.dictionary:
        counts = {}
        names = [name for name in dir(cv2.aruco) if re.fullmatch(r"DICT_\dX\d_\d+", name)]
        for name in sorted(names, key=lambda name: int(name.split("_")[-1])):
            detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)))
            counts[name] = sum(len(detector.detectMarkers(grey)[0]) for grey in greys)
        best = max(counts, key=lambda name: counts[name])  # of equal ones the first, that with fewest markers
        if counts[best] >= 4 and best != board.dictionary and counts[best] > 2 * counts.get(board.dictionary, 0):
            return f"; markers of {best} are seen there"
    return ""


def _list_similar(board: Board) -> list[str]:
    """Boards that people take for one another."""
    turned = dataclasses.replace(board, columns=board.rows, rows=board.columns)
    near = [turned]
    if board.kind in ("charuco", "charuco-legacy"):
        other = "charuco-legacy" if board.kind == "charuco" else "charuco"
        near += [dataclasses.replace(one, kind=other) for one in (board, turned)]
    if board.kind == "chessboard":  # whose inner corners were counted
        near += [dataclasses.replace(one, columns=one.columns + 1, rows=one.rows + 1) for one in (board, turned)]
    return [one.word for one in near]


def _has_board(grey: UInt8[np.ndarray, "h w"], find: Callable) -> bool:
    points, _ = find(grey)
    return points is not None and len(points) >= 6
