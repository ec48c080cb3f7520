"""A camera as its file describes it: matrix, lens, image size, unit of depth; and whether it fits an image."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipjax.files.cameras.lenses import check_lens
from ipjax.records import Camera


@dataclass(frozen=True)
class Intrinsics:
    """A camera as its file describes it.

    Args:
        matrix: K, 3 × 3, pixels; the first pixel's centre is (0, 0). Skew is refused.
        distortion: coefficients in OpenCV's order; empty or all zero = a pinhole, except for "equidistant", whose
            projection is another even then. Zeros behind those that a model has are dropped.
        lens: "opencv", "plumb_bob", "rational_polynomial" or "equidistant" (OpenCV's fisheye, Kannala–Brandt), or one
            of their names elsewhere.
        size: (width, height) in pixels of the images it belongs to; None where the file has none.
        depth_scale: metres per unit of the depth image; None where the file has none.

    Raises:
        ValueError: not a usable camera, in words.
    """

    matrix: np.ndarray
    distortion: tuple[float, ...] = ()
    lens: str = "opencv"
    size: tuple[int, int] | None = None
    depth_scale: float | None = None

    def __post_init__(self):
        matrix = np.asarray(self.matrix, np.float64)
        if matrix.shape != (3, 3):
            raise ValueError(f"the camera matrix must be 3 × 3, not {' × '.join(map(str, matrix.shape)) or 'a number'}")
        if not np.isfinite(matrix).all():
            raise ValueError("the camera matrix has entries that are not finite")
        if not np.allclose(matrix[2], (0, 0, 1)) or matrix[1, 0] != 0:
            raise ValueError("the camera matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], row by row")
        fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        if not (fx > 0 and fy > 0):
            raise ValueError(f"the camera matrix is singular or mirrored: fx = {fx:g}, fy = {fy:g}")
        if abs(matrix[0, 1]) > 1e-3 * fx:
            raise ValueError(f"the camera matrix has a skew of {matrix[0, 1]:g}, which is not supported")
        if not 0.1 < fx / fy < 10:
            raise ValueError(f"the focal lengths differ too much: fx = {fx:g}, fy = {fy:g}")
        if max(fx, fy) < 10 and max(abs(cx), abs(cy)) <= 2:
            raise ValueError(
                f"fx = {fx:g}, cx = {cx:g}: these look like shares of the image's width and height; give pixels"
            )
        if cx == 0 and cy == 0:
            raise ValueError("the principal point is (0, 0), the image's corner: cx and cy are missing")
        lens, distortion = check_lens(self.lens, self.distortion)
        if self.depth_scale is not None:
            check_depth_scale(self.depth_scale, "the depth scale")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "lens", lens)
        object.__setattr__(self, "distortion", distortion)

    @property
    def camera(self) -> Camera:
        """The pinhole, as a record of arrays; distortion is not part of it."""
        return Camera.from_matrix(self.matrix)


def check_depth_scale(scale: Any, what: str = "depth_scale") -> float:
    """Metres per unit of a depth image, as a float; ``what`` begins the message.

    Raises:
        ValueError: no positive number, for instance the name of a unit; the message gives its number.
    """
    try:
        value = float(scale)
    except (TypeError, ValueError):
        value = math.nan
    if math.isfinite(value) and value > 0:
        return value
    units = {"m": 1, "metre": 1, "meter": 1, "mm": 0.001, "millimetre": 0.001, "millimeter": 0.001, "cm": 0.01}
    number = units.get(scale.strip().lower().rstrip("s")) if isinstance(scale, str) else None
    hint = "0.001 for millimetres, 1 for metres" if number is None else f"{number:g} for {scale}"
    raise ValueError(f"{what} must be a positive number of metres per depth unit ({hint}), not {scale!r}")


def list_misfits(intrinsics: Intrinsics, width: int, height: int) -> list[str]:
    """Reasons to doubt that a camera belongs to images of this size, a sentence each; empty where there are none.

    A principal point more than a tenth of the image away from its middle, a field of view below 10° or above 120°,
    and pixels far from square are rare in cameras and usual in a matrix of another image.
    """
    K = intrinsics.matrix
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    found = []
    shares = np.array([(cx + 0.5) / width, (cy + 0.5) / height])
    if np.abs(shares - 0.5).max() > 0.1:
        sentence = (
            f"the principal point ({cx:.1f}, {cy:.1f}) is far from the middle of the image of {width} × {height} pixels"
        )
        ratio = 2 * shares.mean()
        turned = np.array([(cy + 0.5) / width, (cx + 0.5) / height])
        if shares.min() > 0 and abs(shares[0] / shares[1] - 1) < 0.1 and abs(ratio - 1) > 0.05:
            sentence += (
                f": the camera matrix seems to belong to images of about {ratio * width:.0f} × {ratio * height:.0f}; "
                f"multiply fx, fy, cx and cy by {1 / ratio:.3g}"
            )
        elif np.abs(turned - 0.5).max() < 0.05:
            sentence += ": cx and cy look exchanged"
        else:
            sentence += ": right only where the image was cut out of a larger one"
        found.append(sentence)
    if intrinsics.lens != "equidistant":
        angles = [2 * np.degrees(np.arctan(side / 2 / f)) for side, f in ((width, fx), (height, fy))]
        if min(angles) < 10 or max(angles) > 120:
            found.append(
                f"the field of view of {angles[0]:.0f}° × {angles[1]:.0f}° (an image of {width} × {height} pixels with "
                f"fx = {fx:g}, fy = {fy:g}) is unusual: is the camera matrix of images of another size?"
            )
    if not 0.9 < fx / fy < 1.1:
        found.append(f"fx = {fx:g} and fy = {fy:g} differ: right only where the image was stretched in one direction")
    return found
