"""Boards to print: the pattern at its true size, with a bar of 100 mm to measure on the paper."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ipjax.capture.poses.boards import Board
from ipjax.files.storage.writing import writing

PAPERS = {"A4": (0.210, 0.297), "A3": (0.297, 0.420), "A2": (0.420, 0.594), "A1": (0.594, 0.841), "A0": (0.841, 1.189)}
SUFFIXES = (".pdf", ".png")
_RIM = 0.012  # metres of white around everything
_FOOT = 0.022  # metres under the board, for the bar and the words
_BAR = 0.1  # metres
_COARSEST, _FINEST = 12e3, 20e3  # pixels per metre: 300 to 500 dots per inch


def write_board(path: Path, board: Board) -> tuple[Path, str]:
    """Write a board as PDF or PNG, by the name's ending, and tell the size of its paper in words.

    Raises:
      OSError: it cannot be written.
    """
    from PIL import Image

    sheet, scale, words = draw_sheet(board)
    image = Image.fromarray(sheet).convert("1", dither=Image.Dither.NONE)
    dots = scale * 0.0254
    with writing(path) as temporary:
        if path.suffix.lower() == ".pdf":
            image.save(temporary, "PDF", resolution=dots)
        else:
            image.save(temporary, "PNG", dpi=(dots, dots))
    return path, words


def draw_sheet(board: Board) -> tuple[UInt8[np.ndarray, "h w"], float, str]:
    """A sheet with a board and a bar, its pixels per metre, and its size in words."""
    import cv2

    scale = _choose_scale(board)
    pattern = board.draw(scale)
    needed = pattern.shape[1] / scale + 2 * _RIM, pattern.shape[0] / scale + 2 * _RIM + _FOOT
    width, height, words = _choose_paper(*needed)
    sheet = np.full((round(height * scale), round(width * scale)), 255, np.uint8)
    top = round((height - _FOOT) * scale / 2 - pattern.shape[0] / 2)
    left = (sheet.shape[1] - pattern.shape[1]) // 2
    sheet[top : top + pattern.shape[0], left : left + pattern.shape[1]] = pattern
    at = lambda metres: round(metres * scale)
    base, begin = sheet.shape[0] - at(_RIM), at(_RIM)
    bar = at(_BAR)
    sheet[base - at(0.0015) : base, begin : begin + bar] = 0
    for tenth in range(11):
        x = begin + round(tenth * bar / 10)
        x = min(x, begin + bar - at(0.0003))
        sheet[base - at(0.005 if tenth in (0, 5, 10) else 0.003) : base, x : x + at(0.0003)] = 0
    size = 0.003 * scale / 22  # of letters: 3 mm, of which OpenCV's own are 22 pixels high
    lines = f"{board.word}   {words}", "100 mm: print at 100 %, not fitted to the page, and measure this bar"
    for number, line in enumerate(lines):
        place = begin, base - at(0.007 + 0.005 * (1 - number))
        cv2.putText(sheet, line, place, cv2.FONT_HERSHEY_SIMPLEX, size, 0, max(1, round(1.6 * size)), cv2.LINE_AA)
    return sheet, scale, words


def _choose_scale(board: Board) -> float:
    """Pixels per metre at which a square is a whole number of pixels, and a marker, too, if that can be."""
    counts = np.arange(np.ceil(_COARSEST * board.length), np.floor(_FINEST * board.length) + 1)
    other = counts * board.other / board.length
    rest = np.abs(other - np.round(other))
    return float(counts[np.flatnonzero(rest <= rest.min() + 1e-6)[0]] / board.length)


def _choose_paper(width: float, height: float) -> tuple[float, float, str]:
    """The smallest usual paper that holds so much, either way up, or one of that size; metres."""
    for name, (short, long) in PAPERS.items():
        for wide, high, way in ((short, long, "portrait"), (long, short, "landscape")):
            if width <= wide and height <= high:
                return wide, high, f"{name} {way}"
    return width, height, f"{1000 * width:.0f} x {1000 * height:.0f} mm"
