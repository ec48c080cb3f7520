"""Models of a capture: the depth of all frames fused, the support and the background removed, an object each."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ipjax.capture.models.finishing import close_bottom, drop_loose, frame_model, stand
from ipjax.capture.models.frames import PosedFrame, lift
from ipjax.capture.models.separation import Hint, find_frame, separate
from ipjax.capture.models.splitting import Seams
from ipjax.capture.models.support import Support, find_support, find_support_at
from ipjax.capture.models.surfaces import count_views, cut, extract
from ipjax.capture.models.symmetries import Symmetries, find_symmetries
from ipjax.capture.models.volume import choose_blocks, fuse
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import Mesh
from ipjax.transforms import Similarity

_STEP = 6  # of the pixels that the support is fitted to
_WORKING = 3_000_000  # points at most that decide where the volume is


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Settings of `make_models`; metres."""

    voxel: float = 0.002
    # That a frame speaks of behind what it sees; None = 2.5 voxels, or four times what depth is off on the support.
    reach: float | None = None
    cut: float = 0.003  # above the support, below which the surface is the support's
    tallest: float = 0.5  # above the support, of an object
    least_area: float = 1e-3  # metres², of an object's measured surface
    least_height: float = 0.012
    seams: Seams = dataclasses.field(default_factory=Seams)
    alone: bool = True  # divide what touches without being told
    close: bool = False  # close the bottoms
    colour_symmetries: bool = True  # a turn that the colours contradict is no symmetry
    scene_voxel: float = 0.004  # of the model of the whole scene
    scene_around: float = 0.7  # of the objects' middle, which the model of the scene covers


@dataclasses.dataclass(frozen=True)
class ObjectModel:
    """A model and where it stands."""

    name: str
    mesh: Mesh  # in its own frame, metres; `seen` is 0 where it was not measured
    world_from_model: Similarity[np.ndarray]  # rigid
    symmetries: Symmetries = dataclasses.field(default_factory=Symmetries)


@dataclasses.dataclass(frozen=True)
class FusedScene:
    """All frames in one surface, nothing told apart yet."""

    surface: Mesh  # of what is on and near the support, in fine voxels; world
    scene: Mesh  # everything around, in world
    support: Support
    gains: Float[np.ndarray, "v 3"]  # by which the frames' colours were multiplied


@dataclasses.dataclass(frozen=True)
class SceneModels:
    """What `make_models` found."""

    objects: tuple[ObjectModel, ...]
    scene: Mesh  # everything around, in world
    support: Support
    notes: tuple[str, ...]


def make_models(
    frames: Sequence[PosedFrame],
    hints: Sequence[Hint] = (),
    config: ModelConfig | None = None,
    *,
    support_at: Hint | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> SceneModels:
    """Models of the objects of a capture and of the whole scene.

    Args:
      frames: with their poses and depth.
      hints: which objects there are, as far as a person says so.
      support_at: a pixel of what the objects stand on; None = the largest plane that things stand on.
      progress: called as ``progress(part, done, total)``.

    Raises:
      CaptureError: no support is found, or nothing that stands on it, or a hint is wrong.
    """
    fused = fuse_scene(frames, config, support_at=support_at, progress=progress)
    return make_objects(fused, frames, hints, config, progress=progress)


def fuse_scene(
    frames: Sequence[PosedFrame],
    config: ModelConfig | None = None,
    *,
    support_at: Hint | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> FusedScene:
    """The first part of `make_models`: the support, and everything in one surface.

    Raises:
      CaptureError: no support is found, or nothing is above it.
    """
    config = config or ModelConfig()

    def tell(part: str) -> Callable[[int, int], None]:
        return lambda done, total: None if progress is None else progress(part, done, total)

    points = np.concatenate([lift(frame, _STEP)[0] for frame in frames])
    if support_at is None:
        support = find_support(frames, points)
    else:
        support = find_support_at(find_frame(frames, support_at), support_at.x, support_at.y, points)
    gains = balance(frames, support.support_from_world)
    above = _lift_above(frames, support, config)
    blocks = choose_blocks(above, config.voxel, support.axes)
    # Less leaves holes where frames disagree by more; more makes edges and thin things thicker.
    reach = config.reach or max(2.5 * config.voxel, 4 * support.spread)
    volume = fuse(frames, blocks, config.voxel, support.axes, reach=reach, gains=gains, progress=tell("fusing objects"))
    middle = np.median(above, axis=0)
    near = points[np.linalg.norm(points - middle, axis=-1) < config.scene_around]
    wide = choose_blocks(near, config.scene_voxel, support.axes)
    scene = fuse(frames, wide, config.scene_voxel, support.axes, gains=gains, progress=tell("fusing the scene"))
    surface = extract(volume)
    # What no two frames saw from its front is where the space behind edges ends, no surface.
    seen = count_views(surface, frames, near=0.8 * reach) >= min(2, len(frames))
    keep = np.asarray(seen[surface.faces].all(1))
    if not keep.any():
        raise CaptureError("no surface was found: the frames do not agree on any")
    surface = cut(surface, keep)
    return FusedScene(surface, drop_loose(extract(scene), 0.002), support, gains)


def make_objects(
    fused: FusedScene,
    frames: Sequence[PosedFrame],
    hints: Sequence[Hint] = (),
    config: ModelConfig | None = None,
    *,
    progress: Callable[[str, int, int], None] | None = None,
) -> SceneModels:
    """The second part of `make_models`: objects told apart, each a model.

    Raises:
      CaptureError: nothing stands on the support, or a hint is wrong.
    """
    config = config or ModelConfig()
    names = [hint.name for hint in hints]
    if len(set(names)) < len(names):
        raise CaptureError(f"two hints have the name {max(names, key=names.count)}; every object has one")
    support = fused.support
    parts = separate(
        fused.surface,
        support,
        frames,
        hints,
        cut_at=config.cut,
        least_area=config.least_area,
        least_height=config.least_height,
        seams=config.seams,
        alone=config.alone,
    )
    foot = config.cut + 3 * config.voxel
    objects = []
    for number, part in enumerate(parts):
        mesh = stand(drop_loose(part.mesh), support, foot)
        if config.close:
            mesh = close_bottom(mesh, support, config.cut / 2)
        mesh, world_from_model = frame_model(mesh, support)
        symmetries = find_symmetries(mesh, colour=12.0 if config.colour_symmetries else None)
        objects.append(ObjectModel(part.name, mesh, world_from_model, symmetries))
        if progress is not None:
            progress("finishing", number + 1, len(parts))
    return SceneModels(tuple(objects), fused.scene, support, _note(objects, support))


def balance(
    frames: Sequence[PosedFrame], grid_from_world: Similarity[np.ndarray], cell: float = 0.01
) -> Float[np.ndarray, "v 3"]:
    """By what every frame's colours are multiplied so that all have one exposure and white balance.

    The same place is compared where several frames see it, in cells of a grid of which the scene is in the middle; the
    mean of all gains is 1.
    """
    from scipy import sparse

    rows, columns, values = [], [], []
    for number, frame in enumerate(frames):
        points, rgb = lift(frame, 5)
        place = grid_from_world @ points
        key = np.floor(place / cell).astype(np.int64)
        good = (np.abs(key) < 200).all(1) & (rgb.min(1) > 8) & (rgb.max(1) < 247)
        code = ((key[good] + 200) * np.array([160801, 401, 1])).sum(1)
        found, inverse, count = np.unique(code, return_inverse=True, return_counts=True)
        logs = np.log(rgb[good].astype(np.float64))
        mean = np.stack([np.bincount(inverse, logs[:, k]) / count for k in range(3)], -1)
        rows.append(np.full(len(found), number))
        columns.append(found)
        values.append(mean)
    frame_of, code, logs = np.concatenate(rows), np.concatenate(columns), np.concatenate(values)
    _, place = np.unique(code, return_inverse=True)
    gain = np.zeros((len(frames), 3))
    if not len(place):
        return np.ones_like(gain)
    seen = sparse.coo_matrix((np.ones(len(place)), (place, frame_of)), (place.max() + 1, len(frames))).tocsr()
    many = np.maximum(np.asarray(seen.sum(1)), 1)
    for _ in range(12):  # alternately: the places' colours, the frames' gains
        level = logs + gain[frame_of]
        mean = np.stack([np.bincount(place, level[:, k]) for k in range(3)], -1) / many
        off = mean[place] - level
        for number in range(len(frames)):
            mine = frame_of == number
            if mine.sum() > 30:
                gain[number] += np.median(off[mine], axis=0)
        gain -= gain.mean(0)
    return np.exp(gain)


def _lift_above(frames: Sequence[PosedFrame], support: Support, config: ModelConfig) -> Float[np.ndarray, "n 3"]:
    """Points of all frames that are surely above the support and over it."""
    pixels = sum(frame.depth.size for frame in frames[:1]) * len(frames)
    step = max(round(np.sqrt(pixels / _WORKING)), 1)
    above = config.cut + max(2 * support.spread, 0.001)
    found = []
    for frame in frames:
        points, _ = lift(frame, step)
        height = support.heights(points)
        points = points[(height > above) & (height < config.tallest)]
        found.append(points[support.covers(points)])
    return np.concatenate(found)


def _note(objects: Sequence[ObjectModel], support: Support) -> tuple[str, ...]:
    notes = [
        f"the support covers {100 * support.share:.0f} % of what was measured; points lie "
        f"{1000 * support.spread:.1f} mm from it (median)"
    ]
    for item in objects:
        size = np.ptp(item.mesh.vertices, axis=0) * 1000
        turns = len(item.symmetries.discrete) + len(item.symmetries.continuous)
        notes.append(
            f"{item.name}: {size[0]:.0f} × {size[1]:.0f} × {size[2]:.0f} mm"
            + (f", {turns} {'symmetry' if turns == 1 else 'symmetries'}" if turns else "")
        )
    return tuple(notes)
