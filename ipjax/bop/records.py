"""What is read from a data set and what an estimator answers: metres, seconds, OpenCV camera axes.

The files are in millimetres; they are converted where they are read and written (`dataset`, `results`), once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.transforms import Similarity

MM = 1e-3  # metres
ROTATION_SLACK = 0.01  # how far the singular values of a rotation may be from 1


class DatasetError(ValueError):
    """A file of a data set, or of results, is missing or damaged; the message names it and says what is wrong."""


@dataclass(frozen=True)
class Frame:
    """One RGB-D image as its sensor took it."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"] | None  # metres along z, 0 = unknown; None where the data set has none
    camera: Float[np.ndarray, "3 3"]  # K, pixels; the first pixel's centre is at (0, 0)
    scene_id: int = 0
    im_id: int = 0
    name: str = ""


@dataclass(frozen=True)
class Target:
    """One instance to be found in a frame."""

    obj_id: int
    mask: Bool[np.ndarray, "h w"] | None = None  # where to look; None where no mask is given
    score: float = 1.0  # of the detection


@dataclass(frozen=True)
class Estimate:
    """A pose found for an object: x_camera = scale · rotation · x_object + translation, metres."""

    obj_id: int
    score: float
    rotation: np.ndarray  # 3 × 3
    translation_m: np.ndarray  # 3
    scale: float = 1.0  # metres per metre of the model; a BOP row cannot hold it

    @property
    def camera_from_object(self) -> Similarity[np.ndarray]:
        """Metres from metres of the model."""
        parts = (self.rotation, self.translation_m, self.scale)
        return Similarity(*(np.asarray(part, np.float64) for part in parts))


@dataclass(frozen=True)
class Truth:
    """An annotated instance."""

    obj_id: int
    index: int  # among the image's annotations; names the mask
    rotation: np.ndarray  # 3 × 3, float64
    translation: np.ndarray  # 3, metres, float64
    visible: float = 1.0  # share of the silhouette that is visible (visib_fract); −1 = unknown
    box: tuple[int, int, int, int] | None = None  # visible, x y width height
    whole: tuple[int, int, int, int] | None = None  # of the silhouette, what is hidden or outside the image included

    @property
    def camera_from_object(self) -> Similarity[np.ndarray]:
        """Metres from metres."""
        return Similarity(self.rotation, self.translation, np.ones(()))


@dataclass(frozen=True)
class TargetRow:
    """A line of the file of test targets."""

    scene_id: int
    im_id: int
    obj_id: int
    count: int = 1


@dataclass(frozen=True)
class ModelInfo:
    """What models_info.json says about an object, in metres."""

    obj_id: int
    diameter: float
    symmetries: Similarity[np.ndarray]  # leading axis s; the first is the identity


def check_rotation(rotation: Sequence[float] | np.ndarray) -> None:
    """Check that nine numbers are a rotation, row by row, up to rounding (official result files have determinants
    within 0.003 of 1). Raises ValueError, in words, for what scales, mirrors or shears.
    """
    matrix = np.asarray(rotation, np.float64).reshape(3, 3)
    stretch, det = np.linalg.svd(matrix, compute_uv=False), float(np.linalg.det(matrix))
    if np.abs(stretch - 1).max() <= ROTATION_SLACK and det > 0:
        return
    if np.ptp(stretch) <= ROTATION_SLACK * max(stretch.max(), 1) and stretch.mean() > ROTATION_SLACK:
        way = f"it scales by {stretch.mean():.4g}" if det > 0 else "it mirrors"
    else:
        way = "its rows are not at right angles and of length 1"
    raise ValueError(f"R is no rotation: {way} (det R = {det:.4g}, where 1 is expected)")
