"""The similarity that best maps one point set onto another (Umeyama 1991), for thousands of small sets at once.

Batched by nature: the batch axis is laid out last, so that every step is an element-wise operation over all sets. Code
for one set under ``vmap`` was five to forty times slower on a CPU. No LAPACK or cuSOLVER call: the 3 × 3 singular value
decomposition is a one-sided Jacobi iteration (Hestenes 1958), accurate to rounding in either precision.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Rounding may turn the rotation by at most about 1 / _MARGIN radians before ``success`` denies it.
_MARGIN = 128.0


@partial(jax.jit, static_argnames="with_scale")
def umeyama(
    source: Float[Array, "*b n 3"],
    target: Float[Array, "*b n 3"],
    weight: Float[Array, "*b n"],
    *,
    with_scale: bool = True,
) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3"], Float[Array, "*b"], Bool[Array, "*b"]]:
    """Rotation, translation, scale minimising ``sum w |target - (scale * rotation @ source + translation)|²``.

    Points are rows. Weights are relative, not negative; a point of weight 0, or with a coordinate that is not finite,
    is absent. The rotation is always proper (V D Uᵀ, and tr(S·D) for the scale), so mirrored and planar sets come out
    right. Returns ``(rotation, translation, scale, success)``; scale in target units per source unit (1 without
    ``with_scale``). ``success`` is false where the rotation is not determined: coincident or collinear points, fewer
    than three, mirror images that are ambiguous. The numbers are finite all the same: the best proper rotation among
    equals, scale 1 for coincident points.

    Differentiable in both modes, also where singular values repeat; at degenerate sets the rotation's derivative is 0.

    Raises ValueError at trace time if the shapes differ.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13(4), 1991,
    Eq. 34-43.
    """
    if source.shape != target.shape or source.shape[-1:] != (3,) or weight.shape != source.shape[:-1]:
        raise ValueError(
            "umeyama needs source and target of one shape (..., n, 3) and weight (..., n); "
            f"got {source.shape}, {target.shape} and {weight.shape}"
        )
    batch, count = source.shape[:-2], source.shape[-2]
    present = (weight > 0) & jnp.all(jnp.isfinite(source) & jnp.isfinite(target), axis=-1)
    weight = jnp.where(present, weight, 0)
    source = jnp.where(present[..., None], source, 0)
    target = jnp.where(present[..., None], target, 0)
    rotation, translation, scale, _, success = fit_batch_last(
        jnp.moveaxis(source.reshape(-1, count, 3), 0, -1),
        jnp.moveaxis(target.reshape(-1, count, 3), 0, -1),
        jnp.moveaxis(weight.reshape(-1, count), 0, -1),
        with_scale=with_scale,
    )
    return (
        jnp.moveaxis(rotation, -1, 0).reshape(*batch, 3, 3),
        jnp.moveaxis(translation, -1, 0).reshape(*batch, 3),
        scale.reshape(batch),
        success.reshape(batch),
    )


def fit_batch_last(
    source: Float[Array, "n 3 #m"],
    target: Float[Array, "n 3 #m"],
    weight: Float[Array, "n m"],
    *,
    with_scale: bool = True,
) -> tuple[Float[Array, "3 3 m"], Float[Array, "3 m"], Float[Array, "m"], Float[Array, "m"], Bool[Array, "m"]]:
    """``umeyama`` with the batch axis last, for finite points; a point set of batch 1 is shared by all weights.

    Returns ``(rotation, translation, scale, spread, success)``. ``spread`` in [0, 1] is how well the points pin the
    rotation about their longest axis: the sum of the second and third signed singular values over twice the first;
    0 for collinear points.
    """
    eps = jnp.finfo(source.dtype).eps
    total = jnp.sum(weight, axis=0)
    share = weight / jnp.where(total > 0, total, 1)
    source_mean = jnp.sum(share[:, None] * source, axis=0)
    target_mean = jnp.sum(share[:, None] * target, axis=0)
    # Centred before the product: a centroid a hundred units away would otherwise eat every digit of float32.
    source_arm, target_arm = source - source_mean, target - target_mean
    weighted_arm = share[:, None] * target_arm
    covariance = jnp.sum(weighted_arm[:, :, None] * source_arm[:, None, :], axis=0)
    variance = jnp.sum(share * jnp.sum(source_arm**2, axis=1), axis=0)
    rotation, trace, singular = _polar(covariance)

    # All rounding errors are relative to the distance from the frame's origin, not to the size of the set.
    source_size = jnp.sqrt(jax.lax.stop_gradient(variance))
    target_size = jnp.sqrt(jnp.sum(share * jnp.sum(jax.lax.stop_gradient(target_arm) ** 2, axis=1), axis=0))
    source_far = jnp.max(jnp.abs(jax.lax.stop_gradient(source_mean)), axis=0)
    target_far = jnp.max(jnp.abs(jax.lax.stop_gradient(target_mean)), axis=0)
    apart = (source_size > 8 * eps * source_far) & (target_size > 8 * eps * target_far)
    noise = _MARGIN * eps * (1 + _ratio(source_far, source_size) + _ratio(target_far, target_size))
    pinned = singular[1] + singular[2]
    success = apart & (pinned > noise * singular[0]) & (singular[0] > _MARGIN * eps * source_size * target_size)
    spread = _ratio(pinned, 2 * singular[0])

    if with_scale:
        spread_out = variance > jnp.square(8 * eps * source_far)
        scale = jnp.where(spread_out, trace / jnp.where(spread_out, variance, 1), 1)
    else:
        scale = jnp.ones_like(trace)
    translation = target_mean - scale * jnp.sum(rotation * source_mean, axis=1)
    return rotation, translation, scale, spread, success


def _ratio(numerator, denominator):
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1), 0)


@jax.custom_jvp
def _polar(matrix: Float[Array, "3 3 m"]) -> tuple[Float[Array, "3 3 m"], Float[Array, "m"], Float[Array, "3 m"]]:
    """The proper rotation R that maximises tr(Rᵀ M), that maximum, and the signed singular values of M.

    No derivative is defined for the third.
    """
    largest = jnp.max(jnp.abs(matrix), axis=(0, 1))
    largest = jnp.where(largest > 0, largest, 1)
    rotation, singular = _decompose(matrix / largest)
    singular = singular * largest
    return rotation, jnp.sum(singular, axis=0), singular


@_polar.defjvp
def _polar_jvp(primals, tangents):
    # M = R P with P symmetric; R' = R [w]× with (tr(P) I - P) w = vee(Rᵀ M' - M'ᵀ R). The matrix on the left has the
    # eigenvalues p_i + p_j: repeated singular values do no harm, only an undetermined rotation does.
    (matrix,), (change,) = primals, tangents
    rotation, trace, singular = _polar(matrix)
    scale = jnp.where(singular[0] > 0, singular[0], 1)
    symmetric = jnp.sum(rotation[:, :, None] * (matrix / scale)[:, None, :], axis=0)
    symmetric = 0.5 * (symmetric + jnp.swapaxes(symmetric, 0, 1))
    turn = jnp.sum(rotation[:, :, None] * (change / scale)[:, None, :], axis=0)
    vee = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    trace_part = symmetric[0, 0] + symmetric[1, 1] + symmetric[2, 2]
    system = trace_part * jnp.eye(3, dtype=matrix.dtype)[:, :, None] - symmetric
    adjugate = jnp.stack([_cross(system[1], system[2]), _cross(system[2], system[0]), _cross(system[0], system[1])])
    determinant = jnp.sum(system[0] * adjugate[0], axis=0)
    known = determinant > _MARGIN * jnp.finfo(matrix.dtype).eps
    solution = jnp.sum(adjugate * vee[:, None], axis=0) / jnp.where(known, determinant, 1)
    solution = jnp.where(known, solution, 0)
    columns = jnp.swapaxes(rotation, 0, 1)
    rotation_change = jnp.stack(
        [
            columns[1] * solution[2] - columns[2] * solution[1],
            columns[2] * solution[0] - columns[0] * solution[2],
            columns[0] * solution[1] - columns[1] * solution[0],
        ],
        axis=1,
    )
    trace_change = jnp.sum(rotation * change, axis=(0, 1))
    return (rotation, trace, singular), (rotation_change, trace_change, jnp.zeros_like(singular))


@jax.custom_batching.custom_vmap
def _decompose(matrix: Float[Array, "3 3 m"]) -> tuple[Float[Array, "3 3 m"], Float[Array, "3 m"]]:
    """Nearest proper rotations and signed singular values of matrices whose largest entry is 1 or 0."""
    iterations = 12 if jnp.finfo(matrix.dtype).bits <= 32 else 18  # three pairs a sweep
    tiny = jnp.finfo(matrix.dtype).tiny
    identity = jnp.broadcast_to(jnp.eye(3, dtype=matrix.dtype)[:, :, None], matrix.shape)

    def rotate(_, state):
        # One pair of columns a step, then the columns move up by one: three different pairs in three steps. All
        # three unrolled in one step would be duplicated many times over by the fusion pass of the CPU compiler.
        (a, b, c), (u, v, w) = state
        gap = jnp.sum(b * b, axis=0) - jnp.sum(a * a, axis=0)
        twice = 2 * jnp.sum(a * b, axis=0)
        reach = jnp.abs(gap) + jnp.sqrt(gap * gap + twice * twice)
        tangent = jnp.where(gap < 0, -twice, twice) / jnp.maximum(reach, tiny)
        cosine = jax.lax.rsqrt(1 + tangent * tangent)
        sine = cosine * tangent
        return (sine * a + cosine * b, c, cosine * a - sine * b), (sine * u + cosine * v, w, cosine * u - sine * v)

    start = tuple(matrix[:, i] for i in range(3)), tuple(identity[:, i] for i in range(3))
    columns, basis = jax.lax.fori_loop(0, iterations, rotate, start)
    norms = [jnp.sum(column * column, axis=0) for column in columns]
    basis = list(basis)
    for i, j in ((0, 1), (1, 2), (0, 1)):
        swap = norms[j] > norms[i]
        norms[i], norms[j] = jnp.where(swap, norms[j], norms[i]), jnp.where(swap, norms[i], norms[j])
        basis[i], basis[j] = jnp.where(swap, basis[j], basis[i]), jnp.where(swap, basis[i], basis[j])

    right_1 = _normalise(basis[0])
    right_2 = _normalise(basis[1] - right_1 * jnp.sum(right_1 * basis[1], axis=0))
    right_3 = _cross(right_1, right_2)
    image_1, image_2, image_3 = (jnp.sum(matrix * right, axis=1) for right in (right_1, right_2, right_3))
    norm_1 = jnp.sqrt(jnp.sum(image_1 * image_1, axis=0))
    left_1 = jnp.where(norm_1 > 0, image_1 / jnp.where(norm_1 > 0, norm_1, 1), right_1)
    image_2 = image_2 - left_1 * jnp.sum(left_1 * image_2, axis=0)
    norm_2 = jnp.sqrt(jnp.sum(image_2 * image_2, axis=0))
    known = norm_2 > jnp.finfo(matrix.dtype).eps * 0.5
    # Rank one or none: any direction across the first will do; for the zero matrix it is the identity's own.
    across = right_2 - left_1 * jnp.sum(left_1 * right_2, axis=0)
    other = right_3 - left_1 * jnp.sum(left_1 * right_3, axis=0)
    across = jnp.where(jnp.sum(across * across, axis=0) > 0.25, across, other)
    across = jnp.where(jnp.sum(across * across, axis=0) > 0.25, across, right_1)
    left_2 = _normalise(jnp.where(known, image_2, across))
    left_2 = _normalise(left_2 - left_1 * jnp.sum(left_1 * left_2, axis=0))
    left_3 = _cross(left_1, left_2)
    rotation = (
        left_1[:, None] * right_1[None, :] + left_2[:, None] * right_2[None, :] + left_3[:, None] * right_3[None, :]
    )
    # The third values' sign is what a mirror image leaves: this is tr(S·D) term by term.
    singular = jnp.stack([norm_1, jnp.where(known, norm_2, 0), jnp.sum(left_3 * image_3, axis=0)])
    return rotation, singular


@_decompose.def_vmap
def _decompose_vmap(size, batched, matrix):
    # One more batch axis is folded into the last one; as a leading axis it would undo the layout.
    del batched
    flat = jnp.moveaxis(matrix, 0, 2).reshape(3, 3, -1)
    rotation, singular = _decompose(flat)
    rotation = jnp.moveaxis(rotation.reshape(3, 3, size, -1), 2, 0)
    singular = jnp.moveaxis(singular.reshape(3, size, -1), 1, 0)
    return (rotation, singular), (True, True)


def _normalise(vector):
    square = jnp.sum(vector * vector, axis=0)
    return vector * jnp.where(square > 0, jax.lax.rsqrt(jnp.where(square > 0, square, 1)), 0)


def _cross(a, b):
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
