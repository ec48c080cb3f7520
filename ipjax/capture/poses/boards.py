"""Printed boards: ChArUco, a grid of ArUco markers, or a chessboard, as OpenCV describes them.

A board is written in one word, as ``KIND:COLUMNSxROWS:LENGTH:LENGTH:DICTIONARY``, lengths in metres::

    charuco:7x5:0.04:0.03:DICT_4X4_50      squares of 40 mm, markers of 30 mm
    charuco-legacy:8x6:0.04:0.03:…         the pattern that OpenCV printed before 4.6, where rows are even
    aruco:5x7:0.04:0.01:DICT_6X6_250       markers of 40 mm, 10 mm apart
    chessboard:10x7:0.025                  squares of 25 mm, the outer ones counted

The board's origin is a corner of it, x and y lie in it, z goes into it, as OpenCV has them.
"""

import dataclasses
import re
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ipjax.capture.records import CaptureError

FORM = (
    "KIND:COLUMNSxROWS:LENGTH:LENGTH:DICTIONARY, for instance charuco:7x5:0.04:0.03:DICT_4X4_50, or "
    "chessboard:COLUMNSxROWS:LENGTH"
)
_CHARUCO = ("charuco", "charuco-legacy")


@dataclasses.dataclass(frozen=True)
class Board:
    """A printed board."""

    kind: str  # "charuco", "charuco-legacy", "aruco" or "chessboard"
    columns: int  # of squares (charuco, chessboard) or of markers (aruco)
    rows: int
    length: float  # of a square (charuco, chessboard) or of a marker (aruco), metres
    other: float = 0.0  # of a marker (charuco), or between markers (aruco), metres
    dictionary: str = ""  # by OpenCV's name

    @property
    def word(self) -> str:
        """As `parse_board` reads it."""
        sizes = f"{self.kind}:{self.columns}x{self.rows}:{self.length:g}"
        return sizes if self.kind == "chessboard" else f"{sizes}:{self.other:g}:{self.dictionary}"

    @property
    def span(self) -> tuple[float, float]:
        """Width and height of the printed pattern, metres."""
        if self.kind != "aruco":
            return self.columns * self.length, self.rows * self.length
        step = self.length + self.other
        return self.columns * step - self.other, self.rows * step - self.other

    def make(self) -> Any:
        """The board as OpenCV describes it; a chessboard is none of its boards."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        kind = cv2.aruco.CharucoBoard if self.kind in _CHARUCO else cv2.aruco.GridBoard
        made: Any = kind((self.columns, self.rows), self.length, self.other, dictionary)
        if self.kind == "charuco-legacy":
            made.setLegacyPattern(True)
        return made

    def draw(self, scale: float | int) -> UInt8[np.ndarray, "h w"]:
        """The pattern, with so many pixels per metre; its first pixel begins where the board does.

        Sizes are exact where a square's (and a marker's) length is a whole number of pixels.
        """
        width, height = (round(side * scale) for side in self.span)
        if self.kind != "chessboard":
            return self.make().generateImage((width, height))
        rows, columns = (((np.arange(n) + 0.5) / (scale * self.length)).astype(int) for n in (height, width))
        return np.where((rows[:, None] + columns) % 2 == 1, np.uint8(255), np.uint8(0))


def parse_board(text: str) -> Board:
    """The board that a word describes.

    Raises:
      CaptureError: it describes none; says how one is written.
    """
    import cv2

    number = r"(\d*\.?\d+)"
    plain = re.fullmatch(rf"chessboard:(\d+)x(\d+):{number}", text)
    found = re.fullmatch(rf"(charuco|charuco-legacy|aruco):(\d+)x(\d+):{number}:{number}:(\w+)", text)
    if plain is not None:
        board = Board("chessboard", int(plain[1]), int(plain[2]), float(plain[3]))
    elif found is not None:
        kind, columns, rows, length, other, dictionary = found.groups()
        board = Board(kind, int(columns), int(rows), float(length), float(other), dictionary)
    else:
        raise CaptureError(f"{text!r} describes no board: write {FORM}")
    if board.dictionary and not (board.dictionary.startswith("DICT_") and hasattr(cv2.aruco, board.dictionary)):
        known = "DICT_4X4_50, DICT_6X6_250 …"
        raise CaptureError(f"OpenCV knows no dictionary of markers {board.dictionary!r}, but {known}")
    if not 0 < board.length < 2 or (board.dictionary and board.other <= 0):
        raise CaptureError(f"{text!r}: lengths are in metres, and more than nothing")
    if board.kind in _CHARUCO and board.other >= board.length:
        raise CaptureError(f"{text!r}: lengths are in metres, and a marker is smaller than its square")
    if board.kind == "chessboard":
        if min(board.columns, board.rows) < 4:
            raise CaptureError(f"{text!r}: a chessboard has four rows and four columns of squares or more")
        if (board.columns + board.rows) % 2 == 0:
            raise CaptureError(
                f"{text!r}: with {board.columns} × {board.rows} squares it looks the same upside down; of columns and "
                "rows one must be odd and the other even (squares are counted, the outer ones too, not inner corners)"
            )
        return board
    if min(board.columns, board.rows) < 2:
        raise CaptureError(f"{text!r}: a board has two rows and two columns or more")
    needed = board.columns * board.rows // (2 if board.kind in _CHARUCO else 1)
    there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)).bytesList)
    if needed > there:
        raise CaptureError(f"{text!r}: the dictionary has {there} markers, and the board takes {needed}")
    return board
