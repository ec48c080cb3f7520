"""Gauss–Newton over all poses, at one level and one width of the kernel.

The colours' camera and the depth's may be a little apart from what the factory says. Depth images then agree best for
poses that are all off by the same motion in the camera, which recognised points in the colours show: it is solved with
the poses, once for all frames.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.trajectory import Gates, compare_pairs
from jaxtyping import Float

from ipjax.capture.records import Tracks
from ipjax.capture.refinement.graph import Pairs, PairSums, assemble, lever, move, relate
from ipjax.capture.refinement.surfaces import Level
from ipjax.capture.refinement.tracked import TrackEquations, compare_tracks
from ipjax.transforms import Similarity

LONGEST = 0.1  # rad, m: of one step
TOGETHER = 64  # pairs in one call


@dataclasses.dataclass(frozen=True)
class State:
    """What is solved for."""

    world_from_camera: Similarity[np.ndarray]  # [n]
    camera_from_depth: Similarity[np.ndarray]  # what the factory's registration is off by; rigid, near the identity
    points: Float[np.ndarray, "c 3"]  # of the tracks, in the world


@dataclasses.dataclass(frozen=True)
class Problem:
    """What tells it, and what is told before."""

    initial: Similarity[np.ndarray]  # world_from_camera [n]: each frame is drawn there, softly
    information: Float[np.ndarray, " 6"]  # of that pull, of turn and shift along the camera's axes: 1/rad², 1/m²
    offset_information: Float[np.ndarray, " 6"]  # the same of camera_from_depth, towards the identity
    temper: float  # by how much fewer than its points the independent measurements of depth are
    tracks: Tracks | None
    K: Float[np.ndarray, "3 3"]
    pixel_noise: float  # of a recognised point, pixels


@dataclasses.dataclass(frozen=True)
class Equations:
    """The normal equations of a state: the cameras' motions, then the offset's, which has rows only with tracks."""

    pairs: PairSums
    relative: Similarity[np.ndarray]  # target_from_source of the depth cameras
    tracks: TrackEquations | None


def evaluate(
    state: State, problem: Problem, level: Level, pairs: Pairs, gates: Gates, *, colours: bool, track_width: float
) -> Equations:
    """Everything that is compared at a state."""
    depth_poses = state.world_from_camera @ state.camera_from_depth
    relative = relate(depth_poses, pairs)
    found = _compare(level, pairs, relative, gates, colours)
    seen = None
    if problem.tracks is not None and track_width > 0:
        seen = compare_tracks(
            state.world_from_camera,
            state.points,
            problem.tracks,
            problem.K,
            noise=problem.pixel_noise,
            width=track_width,
        )
    return Equations(found, relative, seen)


def _compare(level: Level, pairs: Pairs, relative: Similarity[np.ndarray], gates: Gates, colours: bool) -> PairSums:
    """So many pairs at a time that one compilation serves any number of them."""
    parts = []
    for start in range(0, max(len(pairs), 1), TOGETHER):
        chosen = np.arange(start, start + TOGETHER) % max(len(pairs), 1)  # the last ones are filled up with the first
        numbers = [
            jnp.asarray(x[chosen] if len(pairs) else np.zeros((TOGETHER, *x.shape[1:])), dtype)
            for x, dtype in (
                (pairs.source, jnp.int32),
                (pairs.target, jnp.int32),
                (relative.rotation, jnp.float32),
                (relative.translation, jnp.float32),
            )
        ]
        parts.append(compare_pairs(level.samples, level.images, *numbers, gates, colours=colours))
    return PairSums.join(parts, len(pairs))


def join(
    equations: Equations, state: State, pairs: Pairs, hessian: Float[np.ndarray, "p 6 6"], temper: float
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Of all frames, k = 6 n, and of the offset, k = 6 n + 6, without what was told before."""
    count = len(state.world_from_camera.scale)
    whole, right = assemble(hessian / temper, equations.pairs.slope / temper, equations.relative, pairs, count)
    # A depth camera moves by Ad(depth_from_camera) of what its camera does, and by what the offset does.
    adjoint = lever(state.camera_from_depth.inverse())
    chain = np.kron(np.eye(count), adjoint)
    if equations.tracks is None:
        return chain.T @ whole @ chain, chain.T @ right
    chain = np.concatenate([chain, np.tile(np.eye(6), (count, 1))], axis=1)
    whole, right = chain.T @ whole @ chain, chain.T @ right
    whole[: 6 * count, : 6 * count] += equations.tracks.hessian
    right[: 6 * count] += equations.tracks.slope
    return whole, right


def descend(
    state: State,
    problem: Problem,
    level: Level,
    pairs: Pairs,
    gates: Gates,
    *,
    steps: int,
    colours: bool = False,
    track_width: float = 0.0,
    tolerance: float = 2e-6,
    told: Callable[[], None] = lambda: None,
) -> tuple[State, Equations]:
    """``steps`` of Gauss–Newton, or fewer where the last moved nothing by more than ``tolerance`` (rad, m).

    No step is refused: which points are compared changes with every step, so losses do not compare.
    """
    count = len(state.world_from_camera.scale)
    measure = lambda state: evaluate(state, problem, level, pairs, gates, colours=colours, track_width=track_width)
    equations = measure(state)
    for _ in range(steps):
        whole, right = join(equations, state, pairs, equations.pairs.hessian, problem.temper)
        away = (problem.initial.inverse() @ state.world_from_camera).log()[..., :6].reshape(-1)
        pull = np.tile(problem.information, count)
        if equations.tracks is not None:
            away = np.concatenate([away, state.camera_from_depth.log()[:6]])
            pull = np.concatenate([pull, problem.offset_information])
        motion = -np.linalg.solve(whole + np.diag(pull), right + pull * away)
        longest = np.abs(motion).max()
        motion *= min(1, LONGEST / max(longest, 1e-12))
        state = _step(state, equations, motion, count)
        equations = measure(state)
        told()
        if longest < tolerance:
            break
    return state, equations


def _step(state: State, equations: Equations, motion: Float[np.ndarray, " k"], count: int) -> State:
    poses = move(state.world_from_camera, motion[: 6 * count])
    if equations.tracks is None:
        return dataclasses.replace(state, world_from_camera=poses)
    shift = equations.tracks.offset - equations.tracks.points_from_cameras @ motion[: 6 * count]
    points = state.points + np.clip(shift.reshape(-1, 3), -LONGEST, LONGEST)
    offset = state.camera_from_depth @ Similarity[np.ndarray].exp(motion[6 * count :])
    return State(poses, offset, points)
