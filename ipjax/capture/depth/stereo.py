"""Stereo between the colour images of a capture: depth that owes nothing to the depth camera."""

import dataclasses
from collections.abc import Callable

import numpy as np
from ipjax_kernels.depth.sweep import sweep
from jaxtyping import Bool, Float
from scipy import ndimage

from ipjax.cameras import resize, unproject
from ipjax.capture.records import Capture, CaptureFrame, Trajectory
from ipjax.transforms import Similarity

WIDTH = 320  # pixels: images are swept at this width, or their own if that is less
NEIGHBOURS = 4
PLANES = 128  # of a sweep through all of the scene
RADIUS = 3  # of the windows, pixels
LOCAL = 17  # planes of a sweep about a surface
LOCAL_REACH = 0.02  # of 1 / depth, to either side of that surface
_BEST = (4.0, 25.0)  # degrees between the views of a pair: less says little of depth, more looks different
_LEAST_SCORE, _LEAST_LEAD = 0.8, 0.1  # correlation of what counts as sure, and its lead over the runner-up


@dataclasses.dataclass(frozen=True)
class Views:
    """The frames of a capture whose poses are known, small and grey, for the sweeps."""

    indices: tuple[int, ...]  # into the capture's names
    grey: Float[np.ndarray, "n h w"]  # [0, 1]
    usable: Bool[np.ndarray, "n h w"]
    K: Float[np.ndarray, "3 3"]  # of these images
    world_from_camera: Similarity[np.ndarray]  # [n]
    nearest: float  # metres: the range of depth that is swept
    farthest: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.grey.shape[2], self.grey.shape[1]

    def pose(self, place: int) -> Similarity[np.ndarray]:
        """world_from_camera of one of the views."""
        poses = self.world_from_camera
        return poses.take(place)

    def lift(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
        """A point for every pixel of one of these images, in its camera."""
        height, width = depth.shape
        rows, columns = np.mgrid[:height, :width]
        pixels = np.stack([columns, rows], -1).reshape(-1, 2).astype(np.float64)
        return unproject(self.K, pixels, depth.reshape(-1).astype(np.float64)).reshape(height, width, 3)


@dataclasses.dataclass(frozen=True)
class StereoDepth:
    """Depth of one view by stereo."""

    depth: Float[np.ndarray, "h w"]  # metres along z, of the view's small image; 0 = unknown
    sure: Bool[np.ndarray, "h w"]  # textured, unambiguous, and with a patch of such pixels around it
    deviation: Float[np.ndarray, "h w"]  # standard, metres, by how sharp the correlation's peak is; inf = unknown
    score: Float[np.ndarray, "h w"]  # correlation of the windows, in [−1, 1]


def shrink_views(
    capture: Capture,
    trajectory: Trajectory,
    *,
    width: int = WIDTH,
    read: Callable[[int], CaptureFrame] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Views:
    """Read every frame that has a pose, and keep it small and grey.

    Args:
      read: instead of the capture's own way to read a frame.
    """
    import cv2

    read = read or capture.read_frame
    small = min(width, capture.size[0])
    size = (small, max(round(capture.size[1] * small / capture.size[0]), 1))
    indices = tuple(int(index) for index in np.flatnonzero(trajectory.registered))
    grey, usable, depths = [], [], []
    for done, index in enumerate(indices):
        frame = read(index)
        image = cv2.resize(
            cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255, size, None, 0, 0, cv2.INTER_AREA
        )
        use = cv2.resize(frame.usable.astype(np.float32), size, None, 0, 0, cv2.INTER_AREA) > 0.99
        # What moves with the camera has no texture here, so that nothing is found in it.
        grey.append(np.where(use, image, image[use].mean() if use.any() else 0.5).astype(np.float32))
        usable.append(use)
        depth = frame.raw_depth if frame.raw_depth is not None else frame.depth
        if depth is not None and (depth > 0).any():
            depths.append(np.percentile(depth[depth > 0], [1, 98]))
        if progress is not None:
            progress(done + 1, len(indices))
    reach = np.array(depths) if depths else np.array([[0.3, 3.0]])
    poses = trajectory.world_from_camera
    kept = list(indices)
    return Views(
        indices,
        np.stack(grey),
        np.stack(usable),
        resize(capture.camera.to_matrix(), capture.size, size),
        Similarity(poses.rotation[kept], poses.translation[kept], np.ones(len(kept))),
        nearest=0.92 * float(reach[:, 0].min()),
        farthest=1.08 * float(np.median(reach[:, 1])),
    )


def choose_neighbours(views: Views, place: int, count: int = NEIGHBOURS) -> tuple[list[int], list[float]]:
    """The views that stereo pairs with one of them, the best first, and the angle (degrees) at which they meet.

    The angle is the one at a point in the middle of the image, at the middle of the range.
    """
    poses = views.world_from_camera
    middle = 2 / (1 / views.nearest + 1 / views.farthest)
    target = poses.translation[place] + middle * poses.rotation[place][:, 2]
    rays = target - poses.translation
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    angles = np.rad2deg(np.arccos(np.clip(rays @ rays[place], -1, 1)))
    ahead = (rays * poses.rotation[:, :, 2]).sum(1) > np.cos(np.deg2rad(30))
    order = np.argsort(np.maximum(_BEST[0] - angles, 0) * 5 + np.maximum(angles, _BEST[0]), kind="stable")
    chosen = [int(k) for k in order if k != place and ahead[k] and 0.5 < angles[k] < 60][:count]
    return chosen, [float(angles[k]) for k in chosen]


def sweep_view(
    views: Views, place: int, *, base: Float[np.ndarray, "h w"] | None = None, radius: int = RADIUS
) -> StereoDepth:
    """Depth of one view by a plane sweep against its neighbours.

    Args:
      base: depth (metres, 0 = unknown) about which is searched, a fiftieth to either side, with windows that lie along
        it; None = all of the range, with planes that face the camera.
    """
    chosen, _ = choose_neighbours(views, place)
    height, width = views.grey.shape[1:]
    if not chosen:
        nothing = np.zeros((height, width))
        return StereoDepth(nothing, nothing > 0, nothing + np.inf, nothing - 1)
    padded = (chosen + [place] * NEIGHBOURS)[:NEIGHBOURS]
    K, inverse_K = views.K, np.linalg.inv(views.K)
    relative = [views.pose(k).inverse() @ views.pose(place) for k in padded]
    if base is None:
        offsets = np.linspace(1 / views.farthest, 1 / views.nearest, PLANES)
        start = np.zeros((height, width))
    else:
        known = base > 0
        start = np.where(known, 1 / np.where(known, base, 1), 0)
        middle = np.median(start[known]) if known.any() else 1.0
        offsets = middle * np.linspace(-LOCAL_REACH, LOCAL_REACH, LOCAL)
    found = sweep(
        views.grey[place],
        views.grey[padded],
        np.stack([K @ r.rotation @ inverse_K for r in relative]).astype(np.float32),
        np.stack([K @ r.translation for r in relative]).astype(np.float32),
        start.astype(np.float32),
        offsets.astype(np.float32),
        np.arange(NEIGHBOURS) < len(chosen),
        radius=radius,
        keep=2,
    )
    inverse, score, runner_up, curvature = (np.asarray(x, np.float64) for x in found)
    if base is not None:
        inverse = np.where(start > 0, inverse, 0)
    depth = np.where(inverse > 0, 1 / np.maximum(inverse, 1e-6), 0)
    # Of a peak 1 − ½ c d² whose height is uncertain by 1 − score over a window, the place is uncertain by this.
    planes = np.sqrt(np.maximum(1 - score, 0.01) / (np.maximum(curvature, 1e-6) * (2 * radius + 1)))
    deviation = np.where(depth > 0, planes * (offsets[1] - offsets[0]) * depth**2, np.inf)
    sure = (score > _LEAST_SCORE) & (depth > 0) & views.usable[place]
    if base is None:
        sure &= score - runner_up > _LEAST_LEAD
    return StereoDepth(depth, _keep_patches(depth, sure, radius), deviation, score)


def _keep_patches(depth, sure, radius):
    """Sure pixels whose window is as sure and on the same surface: a window that reaches across a border tells the
    depth of the nearer side also beyond it.
    """
    share = ndimage.uniform_filter(sure.astype(float), 2 * radius + 1)
    high = ndimage.maximum_filter(np.where(sure, depth, 0), 2 * radius + 1)
    low = ndimage.minimum_filter(np.where(sure, depth, np.inf), 2 * radius + 1)
    return sure & (share > 0.8) & (high - low < 0.06 * depth)
