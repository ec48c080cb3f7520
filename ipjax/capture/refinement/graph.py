"""The graph of poses: equations of pairs become those of all frames, are solved, and tell how well each is known.

In NumPy's doubles on the host. 6 n unknowns are solved densely: 600 for 100 frames take a few hundredths of a second,
and memory grows with n², time with n³; 1000 frames would take a minute a step, and a capture of so many is thinned.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from ipjax_kernels.trajectory import PairEquations
from jaxtyping import Float, Int

from ipjax.transforms import Similarity


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Which frames are compared, both ways."""

    source: Int[np.ndarray, " p"]
    target: Int[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.source)


@dataclasses.dataclass(frozen=True)
class PairSums:
    """`ipjax_kernels.trajectory.PairEquations` in NumPy's doubles."""

    hessian: Float[np.ndarray, "p 6 6"]
    slope: Float[np.ndarray, "p 6"]
    shared: Float[np.ndarray, "p 6 6"]
    loss: Float[np.ndarray, " p"]
    compared: Float[np.ndarray, " p"]
    near: Float[np.ndarray, " p"]
    spread: Float[np.ndarray, " p"]

    @staticmethod
    def join(parts: Sequence[PairEquations], count: int) -> "PairSums":
        """Of several calls of the kernel, one after the other, the first ``count`` pairs."""
        whole = [
            np.concatenate([np.asarray(part, np.float64) for part in each])[:count] for each in zip(*parts, strict=True)
        ]
        return PairSums(*whole)


def relate(world_from_camera: Similarity[np.ndarray], pairs: Pairs) -> Similarity[np.ndarray]:
    """``target_from_source`` of every pair."""
    return world_from_camera.take(pairs.target).inverse() @ world_from_camera.take(pairs.source)


def lever(target_from_source: Similarity[np.ndarray]) -> Float[np.ndarray, "*b 6 6"]:
    """From a small motion (turn, shift) in the source's axes to the same in the target's: the adjoint."""
    rotation, (x, y, z) = target_from_source.rotation, np.moveaxis(target_from_source.translation, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([np.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], -2)
    both = np.zeros((*x.shape, 6, 6))
    both[..., :3, :3] = both[..., 3:, 3:] = rotation
    both[..., 3:, :3] = cross @ rotation
    return both


def assemble(
    hessian: Float[np.ndarray, "p 6 6"],
    slope: Float[np.ndarray, "p 6"],
    target_from_source: Similarity[np.ndarray],
    pairs: Pairs,
    count: int,
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """The equations of all ``count`` frames, k = 6 count: of small motions of each camera along its own axes.

    ``world_from_camera`` becomes ``world_from_camera @ exp(ξ)``; a pair's motion in the target's axes is
    Ad(target_from_source) ξ_source − ξ_target.
    """
    adjoint = lever(target_from_source)
    across = np.swapaxes(adjoint, -1, -2) @ hessian
    whole, right = np.zeros((count, count, 6, 6)), np.zeros((count, 6))
    np.add.at(whole, (pairs.source, pairs.source), across @ adjoint)
    np.add.at(whole, (pairs.target, pairs.target), hessian)
    np.add.at(whole, (pairs.source, pairs.target), -across)
    np.add.at(whole, (pairs.target, pairs.source), -np.swapaxes(across, -1, -2))
    np.add.at(right, pairs.source, (np.swapaxes(adjoint, -1, -2) @ slope[..., None])[..., 0])
    np.add.at(right, pairs.target, -slope)
    return whole.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count), right.reshape(-1)


def gauge(world_from_camera: Similarity[np.ndarray]) -> Float[np.ndarray, "k 6"]:
    """What no picture can tell: the small motions of all cameras together, in each one's own axes."""
    return lever(world_from_camera.inverse()).reshape(-1, 6)


def move(world_from_camera: Similarity[np.ndarray], step: Float[np.ndarray, " k"]) -> Similarity[np.ndarray]:
    """Every camera moved along its own axes."""
    return world_from_camera @ Similarity[np.ndarray].exp(step.reshape(-1, 6))
