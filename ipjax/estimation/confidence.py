"""How sure an answer is: a calibrated probability, a covariance, and the axis about which it may be turned.

The few numbers that turn evidence into probability were fitted on scenes made in code (``benchmarks.calibration``).
"""

import jax.numpy as jnp
from ipjax_kernels.positive import invert_positive, principal_axis, root
from jaxtyping import Array, Bool, Float

from ipjax.config import ConfidenceConfig
from ipjax.metrics.poses import turn_angle
from ipjax.records import Agreement, Pairs, Similarity


def probability(agreement: Agreement, weights: Float[Array, "7"]) -> Float[Array, ""]:
    """The probability that a pose is right, by logistic regression on its agreement with the query.

    Right means that the mean distance between the object's surface points at the estimate and at the truth (to the
    nearest point, for objects with symmetries) is below a tenth of the diameter: ADD(-S) < 0.1 d. By the weights of
    objects from a photo without depth, right means turned by less than 15°.

    Args:
      weights: of 1, the logarithms of the agreement in depth, features and drawing, the colours, how much of the
        surface was seen, and the rival.
    """
    part = lambda x: jnp.log(jnp.clip(x, 1e-3, 1))
    known = [jnp.ones_like(agreement.depth), part(agreement.depth), part(agreement.features), part(agreement.drawn)]
    logit = jnp.sum(weights * jnp.stack([*known, agreement.colour, agreement.seen, agreement.rival]))
    return 1 / (1 + jnp.exp(-jnp.clip(logit, -30, 30)))


_APART = 0.5, 0.1  # rad, or diameters: poses that differ by more are rivals, not variants of one


def find_rival(poses: Similarity, score: Float[Array, "h"]) -> Float[Array, ""]:
    """The best score among the poses that differ from the first, as a share of the first's; in [0, 1].

    Args:
      poses: best first.
    """
    angle, _ = _turn_from_first(poses)
    moved = root(jnp.sum((poses.translation - poses.translation[0]) ** 2, axis=-1))
    other = (angle > _APART[0]) | (moved > _APART[1] * poses.scale[0])
    return jnp.clip(jnp.max(jnp.where(other, score, 0)) / jnp.maximum(score[0], 1e-9), 0, 1)


def pair_information(pose: Similarity, pairs: Pairs, used: Bool[Array, "k"]) -> Float[Array, "7 7"]:
    """The information in 3-D pairs about a pose: JᵀJ of their offsets (diameters) over their mean square.

    Tangent: rotation (rad) about the object's centre in camera axes, translation (diameters), log scale.
    """
    arm = jnp.sum(pose.rotation[None] * pairs.object[:, None, :], axis=-1)
    offset = (pose @ pairs.object - pairs.camera) / pose.scale
    share = used.astype(offset.dtype)
    variance = jnp.sum(share * jnp.sum(offset**2, axis=-1)) / jnp.maximum(3 * jnp.sum(share), 1)
    x, y, z = arm.T
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = jnp.stack(  # of −[arm]×, I and arm
        [
            jnp.stack([zero, z, -y, one, zero, zero, x], axis=-1),
            jnp.stack([-z, zero, x, zero, one, zero, y], axis=-1),
            jnp.stack([y, -x, zero, zero, zero, one, z], axis=-1),
        ]
    )
    products = jnp.sum(rows[..., :, None] * rows[..., None, :], axis=0)
    return jnp.sum(share[:, None, None] * products, axis=0) / jnp.maximum(variance, 1e-4)


def covariance(
    depth: tuple[Float[Array, "7 7"], Float[Array, ""]],
    pairs: Float[Array, "7 7"],
    scale: Float[Array, ""],
    config: ConfidenceConfig,
    *,
    scale_known: bool,
) -> tuple[Float[Array, "6 6"], Float[Array, ""]]:
    """The covariance of rotation (rad) and translation (metres), and the standard deviation of the scale (metres).

    Gauss and Newton's. Neighbouring residuals are correlated; how many are independent was fitted. The covariance is
    that of one minimum and says nothing of other poses that look alike.

    Args:
      depth: JᵀJ of the residuals of refinement at the pose, and their sum of squares; each of its terms averages.
      pairs: of `pair_information`.
      scale: of the pose, metres.
    """
    matrix, cost = depth
    information = matrix * (config.independent / jnp.maximum(cost, 1e-3)) + pairs * config.pair_share
    # Bounds the standard deviations where nothing determines the pose: a radian, half a diameter, half the size.
    information = information + jnp.diag(jnp.array([1, 1, 1, 4, 4, 4, 4], matrix.dtype))
    size = 6 if scale_known else 7
    inverse = invert_positive(information[:size, :size])
    unit = jnp.concatenate([jnp.ones(3, matrix.dtype), jnp.full(3, scale, matrix.dtype)])
    spread = jnp.zeros((), matrix.dtype) if scale_known else scale * root(inverse[6, 6])
    return inverse[:6, :6] * unit[:, None] * unit[None, :], spread


def rotation_ambiguity(
    poses: Similarity, score: Float[Array, "h"], turned: Float[Array, "3 3"], config: ConfidenceConfig
) -> Float[Array, "3"]:
    """The object's axis about which the rotation is least certain; its length is the standard deviation in rad.

    The spread of the alternatives, weighted by how close their scores come to the first's, is added to the covariance
    of the first.

    Args:
      poses: best first.
      score: of each; negative = absent.
      turned: covariance of the first's rotation, camera axes.
    """
    behind = 1 - jnp.clip(score / jnp.maximum(score[0], 1e-9), 0, 1)
    weight = jnp.where(score > 0, jnp.exp(-behind / config.tie), 0)
    angle, twist = _turn_from_first(poses)
    # For a turn by θ about a: the symmetric part is cos θ I + (1 − cos θ) a aᵀ, which has no sign to lose.
    cosine = jnp.cos(angle)
    even = (twist + jnp.swapaxes(twist, -1, -2)) / 2 - cosine[:, None, None] * jnp.eye(3, dtype=twist.dtype)
    outer = even * jnp.where(angle > 1e-2, angle**2 / jnp.maximum(1 - cosine, 1e-5), 2.0)[:, None, None]
    moment = jnp.sum(weight[:, None, None] * outer, axis=0) / jnp.maximum(jnp.sum(weight), 1e-9)
    rotation = poses.rotation[0]
    own = jnp.sum(rotation[:, :, None] * jnp.sum(turned[:, :, None] * rotation[None], axis=1)[:, None, :], axis=0)
    axis, variance = principal_axis(moment + own)
    return axis * root(variance)


def _turn_from_first(poses: Similarity) -> tuple[Float[Array, "h"], Float[Array, "h 3 3"]]:
    """The angle (rad) between the first pose and each, and the turn itself in the object's frame."""
    twist = jnp.sum(poses.rotation[0][None, :, :, None] * poses.rotation[:, :, None, :], axis=1)
    trace = jnp.trace(twist, axis1=-2, axis2=-1)
    return turn_angle(trace), twist
