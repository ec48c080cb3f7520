"""VSD of all estimates: every pose is drawn once, several objects in one child process."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float

from ipjax import metrics
from ipjax.bop.records import DatasetError
from ipjax.bop.scoring.errors import stack
from ipjax.bop.scoring.protocol import Protocol, ScoredTarget
from ipjax.cameras import crop
from ipjax.files.meshes.mesh import Mesh
from ipjax.progress import bar
from ipjax.records import Camera, Similarity

DRAWN = 48_000_000  # pixels drawn by one process; seven bytes each

_vsd = jax.jit(metrics.vsd)


def measure_discrepancies(protocol: Protocol, targets: Sequence[ScoredTarget]) -> None:
    """Fill in VSD of all estimates. Every pose is drawn once, several objects in one child process."""
    by_size: dict[tuple[int, int], list[tuple[ScoredTarget, int, int]]] = {}
    for target in targets:
        target.vsd = np.ones((len(target.estimates), len(target.truths), len(metrics.THRESHOLDS)))
        for e, g in target.pairs():
            truth, found = target.truths[g].camera_from_object, target.estimates[e].camera_from_object
            if metrics.projections_overlap(protocol.infos[target.row.obj_id].diameter, truth, found):
                size = protocol.dataset.image_size(target.row.scene_id, target.row.im_id)
                by_size.setdefault(size, []).append((target, e, g))
    for size, pairs in sorted(by_size.items()):
        pairs.sort(key=lambda pair: (pair[0].row.obj_id, pair[0].row.scene_id, pair[0].row.im_id))
        most = max(1, DRAWN // (size[0] * size[1] * 2))
        parts = [pairs[start : start + most] for start in range(0, len(pairs), most)]
        for part in bar(parts, desc="evaluating", unit=" batches", smoothing=0.1) if protocol.progress else parts:
            _measure_batch(protocol, part, size)


def _measure_batch(protocol: Protocol, pairs: list[tuple[ScoredTarget, int, int]], size: tuple[int, int]) -> None:
    # A truth that is compared with several estimates is drawn once.
    numbers = sorted({target.row.obj_id for target, _, _ in pairs})
    keys: dict[tuple, int] = {}
    which, poses, cameras, places = [], [], [], []
    for target, e, g in pairs:
        both = []
        truth, found = target.truths[g].camera_from_object, target.estimates[e].camera_from_object
        for key, pose in (((id(target), "g", g), truth), ((id(target), "e", e), found)):
            if key not in keys:
                keys[key] = len(poses)
                which.append(numbers.index(target.row.obj_id))
                poses.append(pose)
                cameras.append(target.camera)
            both.append(keys[key])
        places.append(both)
    meshes = [protocol.dataset.mesh(obj_id) for obj_id in numbers]
    depths = render_depths(meshes, poses, np.stack(cameras), size[1], size[0], which=which)
    seen_of: tuple[tuple[int, int], np.ndarray] | None = None
    for (target, e, g), (at_truth, at_estimate) in zip(pairs, places, strict=True):
        image = (target.row.scene_id, target.row.im_id)
        if seen_of is None or seen_of[0] != image:
            seen = _read_depth(protocol, *image, size)
            if seen is None:
                continue
            seen_of = (image, seen)
        target.vsd[e, g] = _vsd(
            seen_of[1],
            depths[at_truth],
            Camera.from_matrix(target.camera),
            depths[at_estimate],
            np.float32(protocol.infos[target.row.obj_id].diameter),
            np.float32(protocol.delta),
        )


def _read_depth(protocol: Protocol, scene_id: int, im_id: int, size: tuple[int, int]) -> np.ndarray | None:
    """The sensor's depth; None, and a problem, where it is damaged."""
    try:
        depth = protocol.dataset.depth(scene_id, im_id)
        if depth is None or depth.shape != (size[1], size[0]):
            got = "none" if depth is None else f"{depth.shape[1]} × {depth.shape[0]}"
            where = f"{protocol.dataset.root}, scene {scene_id}, image {im_id}"
            raise DatasetError(f"{where}: the image has {size[0]} × {size[1]} pixels, its depth {got}")
        return depth
    except DatasetError as error:
        if protocol.on_error == "raise":
            raise
        protocol.problems.append(f"{error}; its VSD counts as a miss")
        return None


def render_depths(
    mesh: Mesh | Sequence[Mesh],
    poses: Sequence[Similarity[np.ndarray]],
    cameras: np.ndarray,
    height: int,
    width: int,
    *,
    which: Sequence[int] | None = None,
    corner: float = 0.5,
) -> Float[np.ndarray, "v h w"]:
    """Depth images, metres along z, of a mesh alone at each pose, with K [v, 3, 3]; of several meshes, ``which`` says
    for each image the one that it shows.

    ``corner`` is where the centre of the first pixel lies in K's coordinates: ½ is what the renderers of BOP's toolkit
    do (OpenGL), and the default, because the benchmark's VSD is defined by them; 0 is what K means. VSD's distances
    use integer pixel coordinates in either case, as the toolkit's do.
    """
    from ipjax.rendering.render import render_each

    meshes = [mesh] if isinstance(mesh, Mesh) else list(mesh)
    which = [0] * len(poses) if which is None else which
    # Colours are of no use here, and textures take time to load.
    plain = [replace(m, texture=None, uv=None) for m in meshes]
    camera = Camera.from_matrix(crop(np.asarray(cameras, np.float64), (corner, corner)))
    drawn = render_each(plain, which, stack(poses).to_jax(), camera, height, width)
    return np.asarray(drawn.depth, np.float32)
