"""Boards: what a word describes, and the pose of a camera that sees one, drawn at a known pose."""

from pathlib import Path

import numpy as np
import pytest

from ipjax.capture.poses.boards import parse_board
from ipjax.capture.poses.sightings import find_board, find_by_board, make_detector, to_grey
from ipjax.capture.records import Capture, CaptureError, CaptureFrame
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.inference.cutting import undistort_pixels
from ipjax.records import Camera
from ipjax.synthetic.boards import look_at_board, photograph
from ipjax.transforms import Similarity, difference

K = np.array([[420.0, 0, 321], [0, 421, 238], [0, 0, 1]])
SIZE = 640, 480
SCALE = 4000  # pixels per metre of a board's drawing
# Corners of squares are found ten times more exactly than those of markers.
WORDS = {
    "charuco:7x5:0.04:0.03:DICT_4X4_50": 0.0005,
    "charuco-legacy:8x6:0.03:0.02:DICT_5X5_100": 0.0005,
    "aruco:5x4:0.04:0.01:DICT_4X4_50": 0.003,
    "chessboard:8x5:0.03": 0.0005,
}


def draw(word: str, board_from_camera: Similarity[np.ndarray], camera: Intrinsics) -> np.ndarray:
    return photograph(parse_board(word).draw(SCALE), SCALE, board_from_camera.inverse(), camera, noise=2.0)


@pytest.mark.parametrize(("word", "within"), WORDS.items())
def test_finds_the_camera(word, within):
    poses = look_at_board(parse_board(word).span, 3, seed=2, distance=0.45)
    images = [draw(word, poses.take(i), Intrinsics(K, size=SIZE)) for i in range(3)]
    images.append(np.full((480, 640, 3), 160, np.uint8))
    usable = np.ones((480, 640), bool)
    frames = [CaptureFrame(name, image, None, None, usable) for name, image in zip("abcd", images, strict=True)]
    capture = Capture(Path("c"), "frames", tuple("abcd"), Camera.from_matrix(K), SIZE, frames.__getitem__)
    found = find_by_board(capture, parse_board(word))
    assert found.registered.tolist() == [True, True, True, False] and found.source == "board"
    off = difference(poses, found.world_from_camera.take(slice(3)))
    assert np.abs(off[:, 3:6]).max() < within
    assert np.degrees(np.linalg.norm(off[:, :3], axis=1)).max() < 200 * within
    if word.startswith("charuco:"):
        with pytest.raises(CaptureError, match=r"found in 0 of 4 frames, not in a, b, c and 1 more|not in a, b, c, d"):
            find_by_board(capture, parse_board("charuco:9x7:0.04:0.03:DICT_7X7_100"))


@pytest.mark.parametrize(
    ("lens", "coefficients"), [("plumb_bob", (-0.25, 0.08, 0.001, -0.0005)), ("equidistant", (0.02, 0.01, 0.0, 0.0))]
)
def test_a_lens_is_undone_where_the_corners_are(lens, coefficients):
    """The photo is bent; with the lens told the pose is right, without it it is not."""
    word, camera = "charuco:7x5:0.04:0.03:DICT_4X4_50", Intrinsics(K, coefficients, lens, SIZE)
    pose = look_at_board(parse_board(word).span, 1, seed=3, distance=0.4).take(0)
    grey, find = to_grey(draw(word, pose, camera)), make_detector(parse_board(word))
    seen = find_board(grey, find, K, lambda pixels: undistort_pixels(pixels, camera))
    off = difference(pose.inverse(), seen.camera_from_board)
    assert np.linalg.norm(off[:3]) < 0.002 and np.linalg.norm(off[3:6]) < 0.0005 and seen.off < 0.15
    try:
        assert find_board(grey, find, K).off > 3 * seen.off
    except CaptureError as error:
        assert "are camera, lens and the board's sizes right" in str(error)


def test_a_chessboard_has_one_origin_however_it_is_turned():
    word = "chessboard:8x5:0.03"
    upright = look_at_board(parse_board(word).span, 1, seed=4).take(0)
    find = make_detector(parse_board(word))
    for quarter in (0, 1, 2):
        pose = upright @ Similarity[np.ndarray].exp(np.array([0, 0, quarter * np.pi / 2, 0, 0, 0]))
        seen = find_board(to_grey(draw(word, pose, Intrinsics(K, size=SIZE))), find, K)
        assert np.abs(difference(pose.inverse(), seen.camera_from_board)).max() < 0.004


def test_the_spread_of_a_pose_is_that_of_noisy_corners():
    """By many draws of noise on the corners, of one pixel: covariances as told, and no bias beyond chance."""
    word = "charuco:7x5:0.04:0.03:DICT_4X4_50"
    pose = look_at_board(parse_board(word).span, 1, seed=5).take(0)
    seen = find_board(to_grey(draw(word, pose, Intrinsics(K, size=SIZE))), make_detector(parse_board(word)), K)
    rng, blank = np.random.default_rng(0), np.zeros((2, 2), np.uint8)
    steps = []
    for _ in range(300):
        noisy = seen.points, seen.pixels + rng.normal(0, 0.2, seen.pixels.shape)
        again = find_board(blank, lambda _, noisy=noisy: noisy, K)
        steps.append(difference(seen.camera_from_board, again.camera_from_board)[:6])
    steps = np.array(steps) / 0.2
    root = np.linalg.cholesky(np.linalg.inv(seen.spread(K)))
    whitened = steps @ root
    assert np.abs(whitened.mean(0)).max() < 4 / np.sqrt(300)
    assert np.abs(np.cov(whitened.T) - np.eye(6)).max() < 0.35


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("charuco:7x5:0.04", "describes no board: write KIND"),
        ("charuco:7x5:0.04:0.03:DICT_4X4", "knows no dictionary"),
        ("charuco:7x5:40:30:DICT_4X4_50", "lengths are in metres"),
        ("charuco:7x5:0.03:0.04:DICT_4X4_50", "smaller than its square"),
        ("charuco:30x30:0.04:0.03:DICT_4X4_50", "has 50 markers, and the board takes 450"),
        ("chessboard:9x7:0.03", "looks the same upside down"),
        ("chessboard:9x2:0.03", "four rows and four columns"),
        ("chessboard:8x5", "describes no board"),
    ],
)
def test_a_word_that_describes_none_is_refused(word, said):
    with pytest.raises(CaptureError, match=said):
        parse_board(word)


def test_words_and_boards_are_the_same():
    for word in WORDS:
        assert parse_board(word).word == word
