"""Other poses that the object may have, as the estimate tells, and how much its uncertainty moves it along an axis."""

import jax
import jax.numpy as jnp
from ipjax_kernels.positive import root
from jaxtyping import Array, Float, PRNGKeyArray

from ipjax.config import ConfidenceConfig
from ipjax.records import PoseEstimate
from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation

_TIE = ConfidenceConfig().tie


def sample_poses(estimate: PoseEstimate, key: PRNGKeyArray, *, count: int) -> Similarity:
    """Where the object may be instead: ``object_from_truth``, in metric object frames.

    Each is one of the estimate's alternatives, the more often the closer its score comes to the best, moved by a draw
    from the covariance. Where the estimate's ambiguity is larger than these explain, the rest is a turn about its axis,
    too. What the size may be off is drawn with its deviation.

    Returns:
      Leading axis ``count``; the scale is by how much the object is larger than estimated.
    """
    first, second = jax.random.split(key)
    pose = estimate.camera_from_object
    dtype = pose.translation.dtype
    score = estimate.hypotheses.score
    behind = 1 - jnp.clip(score / jnp.maximum(score[0], 1e-9), 0, 1)
    others = estimate.hypotheses.camera_from_object
    finite = jnp.all(jnp.isfinite(others.rotation), axis=(-1, -2)) & jnp.isfinite(others.scale)
    weight = jnp.where((score > 0) & finite, jnp.exp(-behind / _TIE), 0)
    weight = weight.at[0].set(1)  # the answer itself
    chosen = jax.random.categorical(first, jnp.log(jnp.maximum(weight, 1e-12)), shape=(count,))
    object_from_other = _relative(pose, others)
    object_from_other = jax.tree.map(lambda one, same: one.at[0].set(same), object_from_other,
                                     Similarity.identity((), dtype))  # fmt: skip
    # What is left of the ambiguity: the part that neither covariance nor alternatives explain.
    length = root(jnp.sum(estimate.ambiguity**2))
    axis = estimate.ambiguity / jnp.maximum(length, 1e-9)
    towards = jnp.sum(pose.rotation * axis, axis=-1)  # in camera axes
    own = jnp.sum(towards * jnp.sum(estimate.covariance[:3, :3] * towards, axis=-1))
    about = jnp.sum(vector_from_rotation(object_from_other.rotation) * axis, axis=-1)
    explained = jnp.sum(weight * about**2) / jnp.sum(weight)
    left = root(jnp.maximum(length**2 - own - explained, 0))
    noise = jax.random.normal(second, (count, 8), dtype)
    step = jnp.sum(_lower(estimate.covariance) * noise[:, None, :6], axis=-1)
    # Camera axes to the object's.
    turned, moved = (jnp.sum(step[:, part, None] * pose.rotation, axis=1) for part in (slice(0, 3), slice(3, 6)))
    turned = turned + axis * (left * noise[:, 6])[:, None]
    growth = jnp.exp(noise[:, 7] * estimate.scale_std / jnp.maximum(estimate.diameter, 1e-6))
    return Similarity(rotation_from_vector(turned), moved, growth) @ object_from_other.take(chosen)


def deviation_along(
    estimate: PoseEstimate, place: Float[Array, "*g 3"], axis: Float[Array, "*g 3"], width: Float[Array, "*g"]
) -> Float[Array, "*g"]:
    """By how much (m, standard deviation) a pad's distance to the surface is uncertain, by the covariance and the size.

    Args:
      place: of the grasp, metric object frame.
      axis: along which it closes, unit.
      width: of what it closes on, m.
    """
    turn = estimate.camera_from_object.rotation
    arm = jnp.cross(place, axis)
    rows = jnp.concatenate([jnp.sum(turn * arm[..., None, :], -1), jnp.sum(turn * axis[..., None, :], -1)], axis=-1)
    squared = jnp.sum(rows * jnp.sum(estimate.covariance * rows[..., None, :], axis=-1), axis=-1)
    size = estimate.scale_std / jnp.maximum(estimate.diameter, 1e-6)
    half = jnp.abs(jnp.sum(place * axis, axis=-1)) + width / 2
    return root(jnp.maximum(squared, 0) + (size * half) ** 2)


def _relative(pose: Similarity, others: Similarity) -> Similarity:
    """``object_from_other`` in metric frames; its scale is by how much the other is larger."""
    rigid = Similarity(pose.rotation, pose.translation, jnp.ones_like(pose.scale)).inverse()
    one = Similarity(*(x[None] for x in (rigid.rotation, rigid.translation, rigid.scale)))
    grown = Similarity(others.rotation, others.translation, others.scale / jnp.maximum(pose.scale, 1e-9))
    return one @ grown


def _lower(covariance: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """The lower triangle of Cholesky; a covariance of zeros gives zeros. Unrolled: six columns, no call to LAPACK."""
    size = covariance.shape[0]
    lower = jnp.zeros_like(covariance)
    rows = jnp.arange(size)
    for k in range(size):
        rest = covariance[:, k] - jnp.sum(lower * lower[k], axis=-1)
        pivot = root(jnp.maximum(rest[k], 0))
        column = jnp.where(pivot > 1e-9, rest / jnp.maximum(pivot, 1e-9), 0)
        lower = lower.at[:, k].set(jnp.where(rows >= k, column, 0))
    return lower
