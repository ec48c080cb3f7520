"""Damped Gauss–Newton over all poses, at one level and one width of the kernel."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.trajectory import Gates, PairEquations, compare_pairs
from jaxtyping import Float

from ipjax.capture.refinement.graph import Pairs, as_doubles, assemble, move, relate
from ipjax.capture.refinement.surfaces import Level
from ipjax.transforms import Similarity


@dataclasses.dataclass(frozen=True)
class Prior:
    """Where the cameras were said to be: each frame is drawn there by ½ δᵀ information δ, and no harder."""

    world_from_camera: Similarity[np.ndarray]
    information: Float[np.ndarray, "n 6"]  # of turn and shift along the camera's axes: 1/rad², 1/m²
    temper: float  # by how much fewer than its points the independent measurements of a pair are


def evaluate(poses, level: Level, pairs: Pairs, gates: Gates, colours: bool = False) -> PairEquations:
    relative = relate(poses, pairs)
    return as_doubles(
        compare_pairs(
            level.samples,
            level.images,
            jnp.asarray(pairs.source, jnp.int32),
            jnp.asarray(pairs.target, jnp.int32),
            jnp.asarray(relative.rotation, jnp.float32),
            jnp.asarray(relative.translation, jnp.float32),
            gates,
            colours=colours,
        )
    )


def _away(poses, prior: Prior):
    step = (prior.world_from_camera.inverse() @ poses).log()[..., :6]
    return step, prior.temper * prior.information * step


def descend(poses, level, pairs, gates, prior: Prior, *, steps: int, colours=False, tolerance=2e-6):
    count = len(poses.scale)
    equations = evaluate(poses, level, pairs, gates, colours)
    for _ in range(steps):
        whole, right = assemble(equations.hessian, equations.slope, relate(poses, pairs), pairs, count)
        _, pull = _away(poses, prior)
        whole[np.diag_indices(6 * count)] += (prior.temper * prior.information).reshape(-1)
        motion = -np.linalg.solve(whole, right + pull.reshape(-1))
        longest = np.abs(motion.reshape(count, 2, 3)).max()
        poses = move(poses, motion * min(1, 0.1 / max(longest, 1e-12)))
        equations = evaluate(poses, level, pairs, gates, colours)
        if longest < tolerance:
            break
    return poses, equations
