"""Masks of every frame: the models drawn where they stand, and what the frame itself says of their borders."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from ipjax.cameras import crop, project, unproject
from ipjax.capture.labels.borders import snap
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.files.images.masks import box_of
from ipjax.records import Camera
from ipjax.rendering.render import render_each, render_frames
from ipjax.transforms import Similarity

_HIDES = 0.015  # metres by which what is measured must be nearer than the model to hide it
_BATCH = 240  # images that are drawn at once
_EXACT = 0.002  # metres by which depth of a model's own surface may be outside of its hull
_BEHIND = 0.02  # … or farther for the model not to be there


@dataclasses.dataclass(frozen=True)
class FrameLabels:
    """What is known of one frame, an entry for every model."""

    camera_from_model: tuple[Similarity[np.ndarray], ...]
    whole: Bool[np.ndarray, "n h w"]  # the model drawn alone, and what is visible beyond it
    visible: Bool[np.ndarray, "n h w"]
    drawn: tuple[int, ...]  # pixels of the whole silhouette, those outside the image included
    box: tuple[tuple[int, int, int, int], ...]  # x, y, width, height of the whole silhouette; −1 where there is none

    @property
    def shares(self) -> Float[np.ndarray, " n"]:
        """Visible share of every silhouette."""
        return self.visible.sum((1, 2)) / np.maximum(self.drawn, 1)

    @property
    def visible_boxes(self) -> list[tuple[int, int, int, int]]:
        """Tight boxes of what is visible: x, y, width, height; −1 where nothing is."""
        return [find_box(mask) for mask in self.visible]


def label_frames(
    models: Sequence[ObjectModel],
    frames: Sequence[PosedFrame],
    *,
    exact: bool = False,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> list[FrameLabels]:
    """Masks and boxes of all models in all frames.

    Args:
      exact: the frames are renderings of these very models, and nothing else hides them: they are not asked.

    Raises:
      ValueError: no models.
      RenderError: nothing can draw, with a given `backend`.
    """
    if not models:
        raise ValueError("there is nothing to label: no models")
    batch = max(_BATCH // len(models), 1)
    found = []
    for start in range(0, len(frames), batch):
        found += _label_batch(models, frames[start : start + batch], exact, backend)
        if progress is not None:
            progress(len(found), len(frames))
    return found


def label_nothing(frame: PosedFrame) -> FrameLabels:
    """The labels of a frame of which no object is known."""
    none = np.zeros((0, *frame.depth.shape), bool)
    return FrameLabels((), none, none, (), ())


def _label_batch(
    models: Sequence[ObjectModel], frames: Sequence[PosedFrame], exact: bool, backend: str
) -> list[FrameLabels]:
    """As `label_frames`, of frames few enough to be drawn at once."""
    first = frames[0]
    width, height = first.size
    camera_from_world = [frame.camera_from_world for frame in frames]
    poses = [[pose @ model.world_from_model for model in models] for pose in camera_from_world]
    # A silhouette that leaves the image is drawn whole on a larger canvas, up to three times the image.
    most = np.max([_find_overhang(frame, row, models) for frame, row in zip(frames, poses, strict=True)], axis=0)
    rim = np.minimum(most, (width, height)).astype(int).tolist()
    camera = Camera.from_matrix(first.camera)
    wide = Camera.from_matrix(crop(first.camera, (-rim[0], -rim[1])))
    together = render_frames(
        [(model.mesh, Similarity[np.ndarray].stack([row[k] for row in poses])) for k, model in enumerate(models)],
        camera,
        height,
        width,
        oversample=1,
        backend=backend,
    )
    alone = render_each(
        [model.mesh for model in models],
        list(range(len(models))) * len(frames),
        Similarity[np.ndarray].stack([pose for row in poses for pose in row]).to_jax(),
        wide,
        height + 2 * rim[1],
        width + 2 * rim[0],
        backend=backend,
    )
    assert together.ids is not None
    found = []
    for number, frame in enumerate(frames):
        silhouettes = alone.depth[number * len(models) : (number + 1) * len(models)] > 0
        whole = silhouettes[:, rim[1] : rim[1] + height, rim[0] : rim[0] + width]
        ids, drawn = together.ids[number], together.depth[number]
        if not exact:
            heard = settle(ids, drawn, frame, models, poses[number])
            ids = snap(frame.rgb, heard, len(models), frame.usable)
        visible = np.stack([ids == k for k in range(len(models))])
        whole, silhouettes = whole | visible, silhouettes.copy()
        silhouettes[:, rim[1] : rim[1] + height, rim[0] : rim[0] + width] |= visible
        boxes = []
        for mask in silhouettes:
            x, y, w, h = find_box(mask)
            boxes.append((x - rim[0], y - rim[1], w, h) if w > 0 else (-1, -1, -1, -1))
        found.append(
            FrameLabels(
                tuple(poses[number]),
                whole,
                visible,
                tuple(int(v) for v in silhouettes.sum((1, 2))),
                tuple(boxes),
            )
        )
    return found


def settle(
    ids: np.ndarray,
    drawn: Float[np.ndarray, "h w"],
    frame: PosedFrame,
    models: Sequence[ObjectModel],
    camera_from_model: Sequence[Similarity[np.ndarray]],
) -> np.ndarray:
    """Which model each pixel shows, −1 = none, where the frame has been heard: what is measured in front hides, what is
    measured far behind shows that the model is not there.

    What is measured in front, but inside the model's hull, is a part of it that the model lacks: through the hole its
    far side is drawn.
    """
    import cv2

    known = (frame.depth > 0) & (ids >= 0)
    kernel = np.ones((3, 3), np.uint8)
    before = known & (frame.depth < drawn - _HIDES)
    for index, (model, pose) in enumerate(zip(models, camera_from_model, strict=True)):
        rows, columns = np.nonzero(before & (ids == index))
        if len(rows):
            pixels = np.stack([columns, rows], axis=-1).astype(float)
            points = unproject(frame.camera, pixels, frame.depth[rows, columns].astype(float))
            before[rows, columns] = ~_is_inside(model.mesh.vertices, pose.inverse() @ points)
    # Single pixels are noise, and those beside an edge may have the depth of either side.
    hidden = cv2.morphologyEx(before.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    absent = cv2.morphologyEx((known & (frame.depth > drawn + _BEHIND)).astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    return np.where(hidden | absent | ~frame.usable, -1, ids)


def _is_inside(vertices: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, " m"]:
    """Whether points are in the convex hull, or as near to it as depth is exact."""
    planes = ConvexHull(vertices).equations
    return np.asarray((points @ planes[:, :3].T + planes[:, 3] <= _EXACT).all(axis=1))


def find_box(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """The tight box of a mask: x, y, width, height; −1 four times where it is empty."""
    return box_of(mask) or (-1, -1, -1, -1)


def _find_overhang(
    frame: PosedFrame, poses: Sequence[Similarity[np.ndarray]], models: Sequence[ObjectModel]
) -> Float[np.ndarray, "2"]:
    """Pixels by which the models' vertices leave the image, in x and in y."""
    size = np.array(frame.size)
    most = np.zeros(2)
    for pose, model in zip(poses, models, strict=True):
        points = pose @ model.mesh.vertices
        points = points[points[:, 2] > 0.05]
        if len(points):
            pixels = project(frame.camera, points)
            most = np.maximum(most, np.maximum(-0.5 - pixels.min(0), pixels.max(0) - size + 0.5))
    return np.ceil(most)
