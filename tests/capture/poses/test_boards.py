"""Boards: what a word describes, and the pose of a camera that sees one, drawn at a known pose."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from ipjax.capture.poses.boards import find_by_board, parse_board
from ipjax.capture.records import Capture, CaptureError, CaptureFrame
from ipjax.records import Camera
from ipjax.transforms import Similarity, rotation_from_vector

K = np.array([[420.0, 0, 321], [0, 421, 238], [0, 0, 1]])
WORDS = "charuco:7x5:0.04:0.03:DICT_4X4_50", "aruco:5x4:0.04:0.01:DICT_4X4_50"
FINE = 4  # drawn larger by so much, then averaged


def draw(word: str, world_from_camera: Similarity[np.ndarray]) -> CaptureFrame:
    """A board on grey, as a camera sees it: its plane maps to the image by a homography."""
    board = parse_board(word)
    made, unit = board.make(), 4000  # pixels per metre of the drawing
    across = (
        np.array([board.columns, board.rows]) * board.length
        if board.kind == "charuco"
        else np.array([board.columns, board.rows]) * (board.length + board.other) - board.other
    )
    image = made.generateImage(tuple(round(x) for x in across * unit))
    pose = world_from_camera.inverse()
    plane = np.stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation], axis=1)
    # The board begins at the border of its first pixel; so do the enlarged image's pixels.
    drawn = np.array([[1 / unit, 0, 0.5 / unit], [0, 1 / unit, 0.5 / unit], [0, 0, 1]])
    fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1]])
    size = 640 * FINE, 480 * FINE
    large = cv2.warpPerspective(image, fine @ K @ plane @ drawn, size, borderValue=160, flags=cv2.INTER_AREA)
    grey = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)
    return CaptureFrame("a", np.repeat(grey[..., None], 3, 2), None, None, np.ones((480, 640), bool))


def look(word: str, count: int = 3) -> Similarity[np.ndarray]:
    rng = np.random.default_rng(2)
    rotation = rotation_from_vector(rng.normal(0, [0.3, 0.3, 0.5], (count, 3)))
    aim = np.array([0.13, 0.1, 0]) + rng.normal(0, 0.01, (count, 3))
    return Similarity(rotation, aim - 0.5 * rotation[:, :, 2], np.ones(count))


# Corners of squares are found ten times more exactly than those of markers.
@pytest.mark.parametrize(("word", "within"), [*zip(WORDS, (0.0007, 0.004), strict=True)])
def test_finds_the_camera(word, within):
    poses = look(word)
    one = lambda i: poses.take(i)
    frames = [draw(word, one(i)) for i in range(3)]
    frames.append(CaptureFrame("d", np.full((480, 640, 3), 160, np.uint8), None, None, np.ones((480, 640), bool)))
    capture = Capture(Path("c"), "frames", tuple("abcd"), Camera.from_matrix(K), (640, 480), frames.__getitem__)
    found = find_by_board(capture, parse_board(word))
    assert found.registered.tolist() == [True, True, True, False] and found.source == "board"
    off = found.world_from_camera.translation[:3] - poses.translation
    assert np.abs(off).max() < within
    turned = np.swapaxes(poses.rotation, 1, 2) @ found.world_from_camera.rotation[:3]
    assert np.degrees(np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2)).max() < 100 * within
    with pytest.raises(CaptureError, match=r"found in 0 of 4 frames, not in a, b, c, d"):
        find_by_board(capture, parse_board("charuco:9x7:0.04:0.03:DICT_7X7_100"))


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("charuco:7x5:0.04", "describes no board: write KIND"),
        ("charuco:7x5:0.04:0.03:DICT_4X4", "knows no dictionary"),
        ("charuco:7x5:40:30:DICT_4X4_50", "lengths are in metres"),
        ("charuco:7x5:0.03:0.04:DICT_4X4_50", "smaller than its square"),
        ("charuco:30x30:0.04:0.03:DICT_4X4_50", "has 50 markers, and the board takes 450"),
    ],
)
def test_a_word_that_describes_none_is_refused(word, said):
    with pytest.raises(CaptureError, match=said):
        parse_board(word)
