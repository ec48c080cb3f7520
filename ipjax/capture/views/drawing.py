"""A captured scene from where no camera stood: the nearest frames, carried into the view and blended."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.views import Drawn, Rules, Sources, draw_view
from jaxtyping import Float

from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import balance
from ipjax.capture.views.choosing import choose_frames, find_middle, sample_scene
from ipjax.transforms import Similarity

_KEPT = 48  # frames that are kept in memory


@dataclasses.dataclass(frozen=True)
class ViewConfig:
    """Settings of `draw_views`."""

    near: int = 4  # frames that a view is drawn from first
    far: int = 4  # more, for what these do not know
    far_weight: float = 0.01  # what a word of theirs counts beside one of the near ones
    tolerance: float = 0.012  # of depth, relative to it, up to which two depths are of one surface
    turn: float = 0.15  # rad between two rays at which a source counts a quarter
    edge: float = 0.05  # what colours count that lie beside a jump in depth
    expose: bool = True  # bring all frames to one exposure and white balance
    batch: int = 2  # views that are drawn at once


def draw_views(
    frames: Sequence[PosedFrame],
    views: Similarity[np.ndarray],
    config: ViewConfig | None = None,
    *,
    K: Float[np.ndarray, "3 3"] | None = None,
    size: tuple[int, int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[PosedFrame]:
    """What cameras at ``views`` would see of a captured scene: colours, depth, and, as ``usable``, what is known of it.

    Args:
      frames: with their poses and depth, all of one size and camera.
      views: ``world_from_camera``, rigid, [v].
      K: of the virtual cameras; the frames' by default.
      size: of their images: width, height.
      progress: called as ``progress(done, total)``.

    Raises:
      ValueError: there are no two frames, or they have no depth.
    """
    config = config or ViewConfig()
    if len(frames) < 2:
        raise ValueError(f"new views need two frames or more, not {len(frames)}")
    read = lru_cache(_KEPT)(frames.__getitem__)
    first = read(0)
    if K is None:
        K = first.camera
    if size is None:
        size = first.size
    points = sample_scene(frames)
    if not len(points):
        raise ValueError("no frame has depth: there is nothing to draw")
    captured = Similarity[np.ndarray].stack([frame.world_from_camera for frame in frames])
    gains = np.ones((len(frames), 3))
    if config.expose:
        middle = find_middle(frames)
        gains = balance(frames, Similarity(np.eye(3), -middle, np.ones(())))
    count = min(config.near + config.far, len(frames))
    total, done = len(views.scale), 0
    found: list[PosedFrame] = []
    while done < total:
        # The last batch is as large as the others: another size would be compiled anew.
        numbers = [min(done + i, total - 1) for i in range(config.batch)]
        batch = []
        for number in numbers:
            view = views.take(number)
            chosen, apart = choose_frames(view, K, size, captured, first.camera, first.size, points, count)
            weights = weigh(apart, config)
            batch.append(_collect([read(int(i)) for i in chosen], gains[chosen], weights, view))
        drawn = _draw(
            jax.tree.map(lambda *parts: jnp.stack(parts), *batch),
            Rules(config.tolerance, config.turn, config.edge),
            jnp.asarray(np.diag(K)[:2], jnp.float32),
            jnp.asarray(K[:2, 2], jnp.float32),
            size,
        )
        for place, number in enumerate(dict.fromkeys(numbers)):
            pose = views.take(number)
            found.append(_describe(f"{number:06d}", jax.tree.map(lambda x, i=place: np.asarray(x[i]), drawn), K, pose))
        done += config.batch
        if progress is not None:
            progress(min(done, total), total)
    return found


def weigh(apart: Float[np.ndarray, " k"], config: ViewConfig) -> Float[np.ndarray, " k"]:
    """What each of the frames, nearest first, has to say. A near one's weight vanishes as it becomes a far one, so that
    along a path no frame appears or disappears at once.
    """
    limit = apart[config.near] if len(apart) > config.near else apart[-1] * 1.5 + 1e-6
    near = np.clip(1 - apart / max(limit, 1e-9), 0, 1)
    return np.maximum(near / max(near.max(), 1e-9), config.far_weight)


@partial(jax.jit, static_argnames="size")
def _draw(sources: Sources, rules: Rules, focal: jax.Array, centre: jax.Array, size: tuple[int, int]) -> Drawn:
    scaled = sources._replace(colours=sources.colours.astype(jnp.float32))
    return jax.vmap(lambda one: draw_view(one, rules, focal, centre, size[1], size[0]))(scaled)


def _collect(
    frames: Sequence[PosedFrame],
    gains: Float[np.ndarray, "k 3"],
    weights: Float[np.ndarray, " k"],
    view: Similarity[np.ndarray],
) -> Sources:
    colours = np.stack([frame.rgb * gain.astype(np.float32) for frame, gain in zip(frames, gains, strict=True)])
    depth = np.stack([np.where(frame.usable, frame.depth, 0) for frame in frames])
    source_from_view = [frame.camera_from_world @ view for frame in frames]
    f = lambda x: jnp.asarray(x, jnp.float32)
    K = frames[0].camera
    return Sources(
        f(colours),
        f(depth),
        f(np.stack([pose.rotation for pose in source_from_view])),
        f(np.stack([pose.translation for pose in source_from_view])),
        f(weights),
        f(np.diag(K)[:2]),
        f(K[:2, 2]),
    )


def _describe(name: str, drawn: Drawn, K: np.ndarray, pose: Similarity[np.ndarray]) -> PosedFrame:
    rgb = np.clip(np.round(drawn.colours), 0, 255).astype(np.uint8)
    return PosedFrame(name, rgb, np.asarray(drawn.depth), np.asarray(drawn.depth) > 0, K, pose)
