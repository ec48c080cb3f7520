"""The plane that the objects of a capture stand on: found in single frames, judged and fitted over all of them."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ipjax.cameras import unproject
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.records import CaptureError
from ipjax.detection.proposals.planes import find_planes
from ipjax.detection.proposals.surfaces import make_surfaces
from ipjax.transforms import Similarity

_FRAMES = 8  # in which planes are sought
_WIDTH = 160  # of the images that they are sought in
_TOLERANCE = 0.006  # metres at 1 m
_LEAST = 0.08  # of a frame that a support covers
_NEAR = 0.005  # metres of a plane within which a point votes for it
_CLICKED = 0.02  # of the image's width, on every side of a clicked pixel, that lies on the clicked plane
_CELL = 0.01  # metres: of the map of what the plane covers


@dataclasses.dataclass(frozen=True)
class Support:
    """A plane, and the part of it that was seen: ``support`` has its origin on the plane, z up."""

    support_from_world: Similarity[np.ndarray]
    low: Float[np.ndarray, "2"]  # of the map, metres in x and y of the support
    covered: Bool[np.ndarray, "cx cy"]  # cells of ``_CELL`` metres that lie on the support, its hull filled
    share: float  # of the points of all frames that lie on the plane
    spread: float  # metres: median distance of these from it

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """The support's axes in world, as columns."""
        return self.support_from_world.rotation.T

    def heights(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Metres above the plane, of points in world."""
        return (self.support_from_world @ points)[:, 2]

    def covers(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether points in world are over or under what was seen of the plane."""
        x, y = np.floor(((self.support_from_world @ points)[:, :2] - self.low) / _CELL).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < self.covered.shape[0]) & (y < self.covered.shape[1])
        inside[inside] = self.covered[x[inside], y[inside]]
        return inside


def find_support(frames: Sequence[PosedFrame], points: Float[np.ndarray, "n 3"], seed: int = 0) -> Support:
    """The plane that most of what the frames look at stands on.

    Args:
      frames: with depth.
      points: of all frames in world, as `lift` makes them of every few pixels.

    Raises:
      CaptureError: no frame shows a plane large enough.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_FRAMES, len(frames))).round().astype(int))
    eyes = np.stack([frames[int(i)].world_from_camera.translation for i in chosen])
    middle = np.median(points, axis=0)
    judged = points[:: max(len(points) // 40000, 1)]
    # What is looked at counts: a floor behind the table may fill as much of the images.
    nearness = 1 / (0.3 + np.linalg.norm(judged - middle, axis=-1)) ** 2
    best, best_score = None, 0.0
    for number in chosen:
        frame = frames[int(number)]
        width, height = frame.size
        small = make_surfaces(
            frame.rgb, np.where(frame.usable, frame.depth, 0), frame.camera, _WIDTH, round(_WIDTH * height / width)
        )
        for plane in find_planes(small, 3, _TOLERANCE, _LEAST, seed):
            normal = frame.world_from_camera.rotation @ plane[:3]
            offset = plane[3] - normal @ frame.world_from_camera.translation
            off = judged @ normal + offset
            # Things stand on it, and nothing is below it but what lies farther out.
            score = (nearness * (np.abs(off) < _NEAR)).sum() - (nearness * (off < -4 * _NEAR)).sum()
            if score > best_score:
                best, best_score = np.append(normal, offset), score
    if best is None:
        raise CaptureError(
            "no plane was found that the objects stand on; the frames must show the table around them, with depth"
        )
    plane = _fit(best, points)
    if np.median(eyes @ plane[:3] + plane[3]) < 0:
        plane = -plane
    return _describe(plane, points)


def find_support_at(frame: PosedFrame, x: float | int, y: float | int, points: Float[np.ndarray, "n 3"]) -> Support:
    """The plane that a person clicked, in a frame.

    Args:
      x, y: pixels.
      points: of all frames in world, to which it is fitted.

    Raises:
      CaptureError: there is no depth about the pixel, or no plane.
    """
    width, height = frame.size
    reach = max(round(_CLICKED * width), 3)
    column, row = round(x), round(y)
    if not (0 <= column < width and 0 <= row < height):
        raise CaptureError(f"the click ({x:g}, {y:g}) on the support is outside of {width} × {height} pixels")
    rows, columns = np.mgrid[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    inside = (rows < height) & (columns < width)
    rows, columns = rows[inside], columns[inside]
    known = (frame.depth[rows, columns] > 0) & frame.usable[rows, columns]
    rows, columns = rows[known], columns[known]
    if len(rows) < 20:
        raise CaptureError(f"frame {frame.name} has no depth about ({x:g}, {y:g}), where the support was clicked")
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    near = frame.world_from_camera @ unproject(frame.camera, pixels, frame.depth[rows, columns].astype(np.float64))
    middle = np.median(near, axis=0)
    _, vectors = np.linalg.eigh((near - middle).T @ (near - middle))
    normal = vectors[:, 0]
    # What is farther away is asked only once the plane is known well enough to reach there.
    plane = np.append(normal, -normal @ middle)
    for share in (0.1, 0.2, 0.4):
        plane = _fit(plane, points[np.linalg.norm(points - middle, axis=-1) < share])
    plane = _fit(plane, points)
    if frame.world_from_camera.translation @ plane[:3] + plane[3] < 0:
        plane = -plane
    if (np.abs(points @ plane[:3] + plane[3]) < _NEAR).sum() < 100:
        raise CaptureError(f"there is no plane about ({x:g}, {y:g}) in frame {frame.name}")
    return _describe(plane, points)


def _fit(plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Total least squares among what is near it, and nearer each time."""
    for near in (2 * _NEAR, _NEAR, 0.7 * _NEAR):
        inside = points[np.abs(points @ plane[:3] + plane[3]) < near]
        if len(inside) < 100:
            break
        middle = inside.mean(0)
        _, vectors = np.linalg.eigh((inside - middle).T @ (inside - middle))
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ plane[:3])
        plane = np.append(normal, -normal @ middle)
    return plane


def _describe(plane: np.ndarray, points: np.ndarray) -> Support:
    normal = plane[:3]
    off = points @ normal + plane[3]
    on = np.abs(off) < _NEAR
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    turn = np.stack([first, np.cross(normal, first), normal])
    middle = np.median(points[on], axis=0)
    middle = middle - normal * (middle @ normal + plane[3])
    support_from_world = Similarity(turn, -turn @ middle, np.ones(()))
    flat = (support_from_world @ points[on])[:, :2]
    low = flat.min(0) - 2 * _CELL
    shape = tuple(np.ceil((flat.max(0) + 2 * _CELL - low) / _CELL).astype(int))
    cells = np.floor((flat - low) / _CELL).astype(int)
    count = np.zeros(shape, np.int64)
    np.add.at(count, tuple(cells.T), 1)
    seen = cv2.morphologyEx((count >= 3).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    pieces, labels, stats, _ = cv2.connectedComponentsWithStats(seen)
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()) if pieces > 1 else 0
    outline, _ = cv2.findContours((labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(seen)
    cv2.fillConvexPoly(filled, cv2.convexHull(np.concatenate(outline)), 1)
    return Support(support_from_world, low, filled > 0, float(on.mean()), float(np.median(np.abs(off[on]))))
