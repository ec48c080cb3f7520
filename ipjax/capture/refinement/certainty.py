"""How well each pose is known: covariances from the Hessian, and directions that the scene does not tell.

Two things make a Hessian of point-to-plane distances look surer than it is. Normals are noisy, so that even a plane
seems to hold what slides along it: each point is therefore counted with the normals of both frames, whose noises are
independent (`PairEquations.shared`). And neighbouring pixels, and all pixels of a camera that is not quite calibrated,
err together: the covariance is scaled by how far pairs pull apart at the solution, each against what its own residuals
promise.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ipjax.capture.refinement.graph import Pairs, gauge
from ipjax.capture.refinement.solving import Equations, State, join
from ipjax.transforms import Similarity

TURN = np.deg2rad(0.5)  # standard deviation from which on a direction counts as not determined
SHIFT = 0.01  # metres, likewise
LEAST_SHARE = 0.3  # of its points that a frame must agree on with some other frame
_UNTOLD = 1e3  # standard deviations of direction that nothing tells, in multiples of `TURN` and `SHIFT`


@dataclasses.dataclass(frozen=True)
class Certainty:
    """How well the poses are known, and in words what is not."""

    covariance: Float[np.ndarray, "n 6 6"]  # rotation (rad), translation (m) about the camera, along its axes
    sure: Bool[np.ndarray, " n"]
    remarks: tuple[str, ...]  # of each frame; "" = it is sure
    spread: float  # by how much pairs disagree more than independent residuals would (a variance's factor)


def judge(state: State, equations: Equations, pairs: Pairs) -> Certainty:
    """Covariances of the poses, relative to the frames that are sure; and which are."""
    count = len(state.world_from_camera.scale)
    found = equations.pairs
    spread = measure_spread(equations, pairs, count)
    whole, _ = join(equations, state, pairs, found.shared, spread)
    if equations.tracks is not None:
        whole = _eliminate(whole, 6 * count)
    unit = np.tile([TURN] * 3 + [SHIFT] * 3, count)
    scaled = unit[:, None] * whole * unit
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    told = (vectors * np.maximum(values, _UNTOLD**-2)) @ vectors.T
    share = np.zeros(count)
    with np.errstate(invalid="ignore", divide="ignore"):
        agreeing = np.where(found.compared > 0, found.near / np.maximum(found.compared, 1), 0)
    np.maximum.at(share, pairs.source, np.where(found.compared > 100, agreeing, 0))
    motions = gauge(state.world_from_camera) / unit[:, None]
    motions /= np.linalg.norm(motions, axis=0)
    reference = np.ones(count, bool)
    blocks, sure = _judge_against(reference, told, motions, share)
    for _ in range(3):
        # Where none is, those that are sure relative to the best known one; that itself is no more than where to begin.
        fresh = sure if sure.any() else np.arange(count) == np.argmin(np.linalg.eigvalsh(blocks)[:, -1])
        if (fresh == reference).all():
            break
        reference = fresh
        blocks, sure = _judge_against(reference, told, motions, share)
    if sure.sum() < 2:  # a frame is sure relative to others
        blocks, _ = _judge_against(np.ones(count, bool), told, motions, share)
        sure = np.zeros(count, bool)
    remarks = tuple("" if sure[k] else _describe(blocks[k], share[k]) for k in range(count))
    scale = unit[:6]
    return Certainty(blocks * scale[:, None] * scale, sure, remarks, spread)


def _judge_against(
    reference: Bool[np.ndarray, " n"],
    told: Float[np.ndarray, "k k"],
    motions: Float[np.ndarray, "k 6"],
    share: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 6 6"], Bool[np.ndarray, " n"]]:
    """Covariances where the reference frames together stay, in multiples of the limits; and which keep to these."""
    covariance = _relative_to(told, motions, reference)
    blocks = np.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(reference))])
    return blocks, (np.linalg.eigvalsh(blocks)[:, -1] < 1) & (share > LEAST_SHARE)


def measure_spread(equations: Equations, pairs: Pairs, count: int) -> float:
    """By how much more than independent residuals of unit variance would the poses vary: a factor of their variance.

    That is how far pairs pull apart at the solution (the median over pairs of gᵀ H⁻¹ g, over what it is for six squares
    of unit normals, with the degrees of freedom that the poses took given back), times the pairs of a frame, because
    the frame's own errors are the same in all of them.
    """
    found = equations.pairs
    enough = found.near > 100
    if not enough.any():
        return 1.0
    hessian, slope = found.hessian[enough], found.slope[enough]
    scale = np.sqrt(np.maximum(np.einsum("pii->pi", hessian), 1e-12))
    even = hessian / scale[:, :, None] / scale[:, None, :] + 1e-6 * np.eye(6)
    part = slope / scale
    pulls = np.einsum("pi,pi->p", part, np.linalg.solve(even, part[..., None])[..., 0])
    free = max(1 - count / max(enough.sum() / 2, 1), 0.2)
    pairwise = max(np.median(pulls) / 5.35 / free, np.mean(found.spread[enough]) ** 2)
    return float(pairwise * max(len(pairs) / count, 1))


def _eliminate(whole: Float[np.ndarray, "k k"], first: int) -> Float[np.ndarray, "j j"]:
    """Without the unknowns from ``first`` on, whatever they are."""
    rest = whole[first:, first:]
    rest = rest + np.diag(1e-9 * np.diag(rest) + 1e-6)
    return whole[:first, :first] - whole[:first, first:] @ np.linalg.solve(rest, whole[first:, :first])


def _relative_to(
    told: Float[np.ndarray, "k k"], motions: Float[np.ndarray, "k 6"], reference: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "k k"]:
    """The covariance where the reference frames together do not move."""
    held = motions * np.repeat(reference, 6)[:, None]
    held, _ = np.linalg.qr(held)
    free, _ = np.linalg.qr(motions)
    # S covariance Sᵀ with S = 1 − motions (heldᵀ motions)⁻¹ heldᵀ brings any gauge to this one.
    values, vectors = np.linalg.eigh(told + 1e6 * free @ free.T)
    inside = (vectors / values) @ vectors.T
    shift = np.eye(len(told)) - motions @ np.linalg.solve(held.T @ motions, held.T)
    return shift @ inside @ shift.T


_NAMES = np.array(["to its right", "down", "ahead"])


def _describe(block: Float[np.ndarray, "6 6"], share: float) -> str:
    """What is not determined of a frame, in words; ``block`` in multiples of `TURN` and `SHIFT`."""
    said: list[str] = []
    values, vectors = np.linalg.eigh(block)
    if values[0] > (0.1 * _UNTOLD) ** 2:
        return "not determined: nothing ties it to the other frames"
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        size = np.sqrt(max(value, 0))
        if size < 1:
            break
        turn, shift = np.linalg.norm(vector[:3]), np.linalg.norm(vector[3:])
        slides = shift >= turn
        axis = vector[3:] / shift if slides else vector[:3] / turn
        axis = axis * np.sign(axis[np.abs(axis).argmax()])
        amount = f"± {1000 * SHIFT * size * shift:.0f} mm" if slides else f"± {np.rad2deg(TURN) * size * turn:.1f}°"
        if size > 0.5 * _UNTOLD:
            amount = "nothing tells it"
        near = _NAMES[np.abs(axis).argmax()] if np.abs(axis).max() > 0.9 else ""
        where = "(" + ", ".join(f"{x:.2f}" for x in axis) + ") of the camera" + (f", {near}" if near else "")
        said.append(f"{'sliding along' if slides else 'turning about'} {where}: {amount}")
    if share <= LEAST_SHARE:
        said.append(f"it agrees with no other frame: in {100 * share:.0f} % of its points at best")
    return "not determined: " + "; ".join(said)


def off_by(found: Similarity[np.ndarray], true: Similarity[np.ndarray]) -> Float[np.ndarray, "n 6"]:
    """Of each pose what it is off by (rotation, rad; translation, m; along the camera's axes), worlds laid together.

    The one motion of the world that is solved makes the squares smallest, a degree counting as much as 10 mm.
    """
    weight = np.tile([1.0] * 3 + [np.deg2rad(1) / 0.01] * 3, len(found.scale))
    world = Similarity(np.eye(3), np.zeros(3), np.ones(()))
    error = np.zeros((len(found.scale), 6))
    for _ in range(10):
        moved = world @ found
        error = (true.inverse() @ moved).log()[:, :6]
        step = np.linalg.lstsq(gauge(moved) * weight[:, None], error.reshape(-1) * weight, rcond=None)[0]
        world = Similarity[np.ndarray].exp(-step) @ world
    return error
