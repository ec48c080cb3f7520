"""Photos of a flat picture, such as a printed board, by a camera at a known pose, with its lens and its noise."""

import cv2
import numpy as np
from jaxtyping import UInt8

from ipjax.cameras import resize, unproject
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.inference.cutting import undistort_pixels
from ipjax.transforms import Similarity

_FINE = 3  # drawn larger by so much, then averaged
_TABLE = 120  # grey around the paper


def photograph(
    picture: UInt8[np.ndarray, "h w"],
    scale: float | int,
    camera_from_picture: Similarity[np.ndarray],
    intrinsics: Intrinsics,
    *,
    margin: float = 0.02,
    noise: float = 0.0,
    seed: int = 0,
) -> UInt8[np.ndarray, "hi wi 3"]:
    """What a camera sees of a picture on white paper, on grey.

    Args:
      picture: its first pixel begins at the origin of its frame; x to its right, y down, z away from who looks at it.
      scale: its pixels per metre.
      camera_from_picture: rigid, metres.
      intrinsics: with the image's size.
      margin: of white paper around it, metres.
      noise: standard deviation of the photo's, in grey levels of 255.
      seed: of the noise.

    Raises:
      ValueError: the camera has no size.
    """
    if intrinsics.size is None:
        raise ValueError("a photo is of a camera with a size")
    width, height = intrinsics.size
    rim = round(margin * scale)
    paper = cv2.copyMakeBorder(picture, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
    # Every pixel's ray, from the lens to the pinhole, with one more around the image; then where it meets the picture.
    columns, rows = np.meshgrid(np.arange(-1, width + 1), np.arange(-1, height + 1))
    pixels = np.stack([columns, rows], -1).reshape(-1, 2).astype(np.float64)
    rays = unproject(intrinsics.matrix, undistort_pixels(pixels, intrinsics), np.ones(len(pixels)))
    axes, origin = camera_from_picture.rotation, camera_from_picture.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = (axes[:, 2] @ origin) / (rays @ axes[:, 2])
        places = (ahead[:, None] * rays - origin) @ axes[:, :2]
    places = np.where((ahead > 0)[:, None] & np.isfinite(places), places, -1e3)
    at = (np.clip(places, -1e3, 1e3) * scale + rim - 0.5).astype(np.float32).reshape(height + 2, width + 2, 2)
    # Between pixels the way is as good as straight.
    at = cv2.resize(at, None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_LINEAR)[_FINE:-_FINE, _FINE:-_FINE]
    # Beyond what one fine pixel sees of it, the picture is averaged before it is sampled.
    seen = float(np.median(np.linalg.norm(np.diff(at, axis=1), axis=-1)))
    if seen > 1.5:
        factor = 1 / seen
        smaller = (max(1, round(paper.shape[1] * factor)), max(1, round(paper.shape[0] * factor)))
        change = resize(np.eye(3), paper.shape[::-1], smaller)
        paper = cv2.resize(paper, smaller, interpolation=cv2.INTER_AREA)
        at = (at * change[[0, 1], [0, 1]] + change[[0, 1], [2, 2]]).astype(np.float32)
    drawn = cv2.remap(
        paper, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(_TABLE,)
    )
    grey = drawn.reshape(height, _FINE, width, _FINE).mean((1, 3))
    grey = grey + np.random.default_rng(seed).normal(0, noise, grey.shape) if noise else grey
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def look_at_board(
    span: tuple[float, float], count: int, seed: int, *, distance: float = 0.5, tilt: float = 40.0, roll: float = 60.0
) -> Similarity[np.ndarray]:
    """Cameras around a board as one takes them to calibrate: ``board_from_camera`` [count], metres.

    Args:
      span: width and height of the board, metres.
      count: of the cameras.
      seed: same seed, same cameras.
      distance: from the board, metres; each is off by up to a fifth.
      tilt: of the optical axis against the board's normal: up to so many degrees, to all sides.
      roll: about the optical axis, up to so many degrees.
    """
    rng = np.random.default_rng(seed)
    middle = np.array([span[0] / 2, span[1] / 2, 0.0])
    around = 2 * np.pi * (np.arange(count) * 0.618 + rng.uniform(0, 1))  # the golden ratio leaves no side out
    lean = np.deg2rad(tilt) * np.sqrt(rng.uniform(0.1, 1, count))
    turned = np.deg2rad(rng.uniform(-roll, roll, count))
    steps = np.zeros((2, count, 6))
    steps[0, :, :2] = lean[:, None] * np.stack([np.cos(around), np.sin(around)], -1)
    steps[1, :, 2] = turned
    leaned, rolled = (Similarity[np.ndarray].exp(step) for step in steps)
    rotation = (leaned @ rolled).rotation
    aim = middle + rng.uniform(-0.15, 0.15, (count, 3)) * [span[0], span[1], 0]
    away = distance * rng.uniform(0.8, 1.2, count)
    return Similarity(rotation, aim - away[:, None] * rotation[:, :, 2], np.ones(count))
