"""Which frames a view is drawn from: those that look at the same things from about the same side and distance."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ipjax.cameras import project
from ipjax.capture.models.frames import PosedFrame, lift
from ipjax.transforms import Similarity

_STEP = 12  # of the pixels that stand for what a frame sees
_POINTS = 400  # that stand for the scene
_DISTANCE = 0.35  # rad that a distance e times as large counts
_UNSEEN = 1.2  # rad that a point counts which a frame does not see


def sample_scene(frames: Sequence[PosedFrame], seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Points in world that stand for what the frames saw, as many of each frame; empty where none has depth."""
    rng = np.random.default_rng(seed)
    each = max(_POINTS // max(len(frames), 1), 8)
    chosen = []
    for frame in frames:
        points = lift(frame, _STEP)[0]
        chosen.append(points[rng.permutation(len(points))[:each]])
    return np.concatenate(chosen) if chosen else np.zeros((0, 3))


def find_middle(frames: Sequence[PosedFrame]) -> Float[np.ndarray, "3"]:
    """The middle of what the frames look at: the median of what each sees in the middle of its image, in world.

    Raises:
      ValueError: no frame has depth there.
    """
    seen = []
    for frame in frames:
        width, height = frame.size
        part = np.s_[height * 2 // 5 : height * 3 // 5, width * 2 // 5 : width * 3 // 5]
        depth = frame.depth[part][(frame.depth[part] > 0) & frame.usable[part]]
        if len(depth):
            K = frame.camera
            x, y = (width - 1) / 2, (height - 1) / 2
            ray = np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
            seen.append((frame.world_from_camera @ (float(np.median(depth)) * ray)[None])[0])
    if not seen:
        raise ValueError("no frame has depth in the middle of its image")
    return np.median(seen, axis=0)


def choose_frames(
    view: Similarity[np.ndarray],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    captured: Similarity[np.ndarray],
    captured_K: Float[np.ndarray, "3 3"],
    captured_size: tuple[int, int],
    points: Float[np.ndarray, "n 3"],
    count: int,
) -> tuple[Int[np.ndarray, " count"], Float[np.ndarray, " count"]]:
    """The frames that are nearest to a view, best first, and how far each is: radians, and what stands for them.

    At every point of the scene that the view may see, the angle between the rays of view and frame counts, and how
    much farther or nearer the frame is; a point that the frame does not see counts as 70°.

    Args:
      view: ``world_from_camera``; `K` and `size` (width, height) of its image.
      captured: of the frames, [n].
      points: of the scene, in world.
    """
    inside = _sees(view.inverse(), K, size, points)
    if inside.sum() >= 8:
        points = points[inside]
    to_view = view.translation - points
    near = np.linalg.norm(to_view, axis=-1)
    costs = []
    for index in range(len(captured.scale)):
        frame = captured.take(index)
        to_frame = frame.translation - points
        away = np.linalg.norm(to_frame, axis=-1)
        angle = np.arccos(np.clip((to_view * to_frame).sum(-1) / np.maximum(near * away, 1e-12), -1, 1))
        cost = angle + _DISTANCE * np.abs(np.log(np.maximum(away, 1e-6) / np.maximum(near, 1e-6)))
        seen = _sees(frame.inverse(), captured_K, captured_size, points)
        costs.append(np.where(seen, np.minimum(cost, _UNSEEN), _UNSEEN).mean() if len(points) else 0.0)
    order = np.argsort(costs, kind="stable")[:count]
    return order, np.asarray(costs)[order]


def _sees(
    camera_from_world: Similarity[np.ndarray],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    points: Float[np.ndarray, "n 3"],
) -> np.ndarray:
    moved = camera_from_world @ points
    x, y = project(K, moved).T
    return (moved[:, 2] > 0.05) & (x > -0.5) & (y > -0.5) & (x < size[0] - 0.5) & (y < size[1] - 0.5)
