"""The similarity that best maps one point set onto another (Umeyama 1991), for thousands of small sets at once.

Batched by nature: the batch axis is laid out last, so that every step is an element-wise operation over all sets. Code
for one set under ``vmap`` was five to forty times slower on a CPU. No LAPACK or cuSOLVER call: the 3 × 3 singular value
decomposition is a one-sided Jacobi iteration (Hestenes 1958), accurate to rounding in either precision.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Rounding may turn the rotation by at most about 1 / _MARGIN radians before ``success`` is false.
_MARGIN = 128.0
# Up to so many points are summed one by one.
_FEW = 8


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
    total = _sum(weight)
    share = weight / jnp.where(total > 0, total, 1)
    # Vectors are tuples of three arrays from here on: element-wise throughout, which is what compilers are good at.
    source_mean = tuple(_sum(share * source[:, axis]) for axis in range(3))
    target_mean = tuple(_sum(share * target[:, axis]) for axis in range(3))
    # Centred before the product: a centroid a hundred units away would otherwise eat every digit of float32.
    source_arm = tuple(source[:, axis] - source_mean[axis] for axis in range(3))
    target_arm = tuple(target[:, axis] - target_mean[axis] for axis in range(3))
    # The barriers part what the CPU compiler would otherwise compute once for each of its readers.
    share, source_arm, target_arm = _part((share, source_arm, target_arm))
    if source.shape[0] <= _FEW:
        covariance = jnp.stack([jnp.stack([_sum(share * t * s) for s in source_arm]) for t in target_arm])
    else:
        weighted_arm = jnp.stack([share * t for t in target_arm], axis=1)
        covariance = jnp.sum(weighted_arm[:, :, None] * jnp.stack(source_arm, axis=1)[:, None, :], axis=0)
    variance = _sum(share * _dot(source_arm, source_arm))
    target_variance = _sum(share * _dot(target_arm, target_arm))
    if source.shape[0] == 3:
        rotation, trace, singular = _polar_of_triangles(covariance, share, source_arm, target_arm)
    else:
        rotation, trace, singular = _polar(covariance)
    rotation, trace, singular, variance = _part((rotation, trace, singular, variance))

    # All rounding errors are relative to the distance from the frame's origin, not to the size of the set.
    source_size = jnp.sqrt(jax.lax.stop_gradient(variance))
    target_size = jnp.sqrt(jax.lax.stop_gradient(target_variance))
    source_far = _reach(jax.lax.stop_gradient(source_mean))
    target_far = _reach(jax.lax.stop_gradient(target_mean))
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
    translation = jnp.stack(
        [mean - scale * _dot(row, source_mean) for mean, row in zip(target_mean, rotation, strict=True)]
    )
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
    found = _polar(*primals)
    return found, _differentiate(found, primals[0], tangents[0])


@jax.custom_jvp
def _polar_of_triangles(matrix, share, source, target):
    """``_polar`` of the covariance of three points, in closed form; corners (of weight 0: anywhere) about their mean.

    Three points lie in a plane. Between two planes a rotation by an angle remains, once with and once without turning
    over, and the larger of the two traces wins: their sum and difference are the singular values.
    """
    del matrix  # only derivatives go through it
    present = share > 0
    corners = [[tuple(jnp.where(present[i], x[i], 0) for x in arm) for i in range(3)] for arm in (source, target)]
    (before, after) = _part(tuple(_span(list(corner)) for corner in corners))
    flat = [
        [(_dot(e1, arm), _dot(e2, arm)) for arm in corner]
        for (e1, e2), corner in zip((before, after), corners, strict=True)
    ]
    xx, xy, yx, yy = (
        _dot(share, [flat[1][i][row] * flat[0][i][column] for i in range(3)]) for row in (0, 1) for column in (0, 1)
    )
    straight, flipped = (xx + yy, yx - xy), (xx - yy, yx + xy)
    straight, flipped = _part((straight, flipped))
    # Computed once: of collinear points the two are equal up to rounding, and if each reader of the comparison had its
    # own rounding, cosine and sine could come from different ones.
    straight_trace, flipped_trace = _part(tuple(jnp.sqrt(c * c + s * s) for c, s in (straight, flipped)))
    turned = flipped_trace > straight_trace
    trace = jnp.where(turned, flipped_trace, straight_trace)
    known = trace > 0
    cosine = jnp.where(known, jnp.where(turned, flipped[0], straight[0]) / jnp.where(known, trace, 1), 1)
    sine = jnp.where(known, jnp.where(turned, flipped[1], straight[1]) / jnp.where(known, trace, 1), 0)
    sign = jnp.where(turned, -1, 1).astype(trace.dtype)
    cosine, sine, sign = _part((cosine, sine, sign))
    image_1 = tuple(cosine * a + sine * b for a, b in zip(*after, strict=True))
    image_2 = tuple(sign * (cosine * b - sine * a) for a, b in zip(*after, strict=True))
    image_1, image_2 = _part((image_1, image_2))
    rotation = _combine((image_1, image_2, _cross(image_1, image_2)), (*before, _cross(*before)))
    first, second = 0.5 * (straight_trace + flipped_trace), 0.5 * jnp.abs(straight_trace - flipped_trace)
    return rotation, trace, jnp.stack([first, second, jnp.zeros_like(first)])


@_polar_of_triangles.defjvp
def _polar_of_triangles_jvp(primals, tangents):
    found = _polar_of_triangles(*primals)
    return found, _differentiate(found, primals[0], tangents[0])


def _span(corners):
    """Two orthonormal vectors that span what three vectors of sum zero span, or more if they are collinear."""
    squares = [_dot(corner, corner) for corner in corners]
    # Readers that the compiler lets round for themselves must choose alike, or a vector gets components of two. So no
    # comparison has a tie where sets have one: equal sides, and, of equal weights, what is left of two corners.
    for i, j in ((0, 1), (0, 2)):  # the longest first, or nearly
        swap = squares[j] > 1.17 * squares[i]
        corners[i], corners[j] = _choose(swap, corners[j], corners[i]), _choose(swap, corners[i], corners[j])
        squares[i], squares[j] = jnp.where(swap, squares[j], squares[i]), jnp.where(swap, squares[i], squares[j])
    zero = jnp.zeros_like(squares[0])
    first = _choose(squares[0] > 0, _normalise(corners[0]), (zero + 1, zero, zero))
    one, other = (_reject(corner, first) for corner in corners[1:])
    second = _choose(_dot(other, other) > 5 * _dot(one, one), other, one)
    second = _reject(_normalise(_reject(second, first)), first)  # twice is enough, also of nearly parallel vectors
    x, y, z = (jnp.abs(component) for component in first)
    least = jnp.where((x <= y) & (x <= z), 0, jnp.where(y <= z, 1, 2))
    across = _reject(tuple((least == axis).astype(zero.dtype) for axis in range(3)), first)
    return first, _normalise(_choose(_dot(second, second) > 0.25, second, across))


def _differentiate(found, matrix, change):
    # M = R P with P symmetric; R' = R [w]× with (tr(P) I - P) w = vee(Rᵀ M' - M'ᵀ R). The matrix on the left has the
    # eigenvalues p_i + p_j: repeated singular values do no harm, only an undetermined rotation does.
    rotation, _, singular = found
    scale = jnp.where(singular[0] > 0, singular[0], 1)
    symmetric = jnp.sum(rotation[:, :, None] * (matrix / scale)[:, None, :], axis=0)
    symmetric = 0.5 * (symmetric + jnp.swapaxes(symmetric, 0, 1))
    turn = jnp.sum(rotation[:, :, None] * (change / scale)[:, None, :], axis=0)
    vee = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    trace_part = symmetric[0, 0] + symmetric[1, 1] + symmetric[2, 2]
    system = trace_part * jnp.eye(3, dtype=matrix.dtype)[:, :, None] - symmetric
    adjugate = jnp.stack([jnp.stack(_cross(system[i], system[j])) for i, j in ((1, 2), (2, 0), (0, 1))])
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
    return rotation_change, trace_change, jnp.zeros_like(singular)


@jax.custom_batching.custom_vmap
def _decompose(matrix: Float[Array, "3 3 m"]) -> tuple[Float[Array, "3 3 m"], Float[Array, "3 m"]]:
    """Nearest proper rotations and signed singular values of matrices whose largest entry is 1 or 0."""
    iterations = 12 if jnp.finfo(matrix.dtype).bits <= 32 else 18  # three pairs a sweep
    tiny = jnp.finfo(matrix.dtype).tiny
    zero = jnp.zeros_like(matrix[0, 0])
    identity = tuple(tuple(zero + float(row == column) for row in range(3)) for column in range(3))

    def rotate(_, state):
        # One pair of columns a step, then the columns move up by one: three different pairs in three steps. All
        # three unrolled in one step would be duplicated many times over by the fusion pass of the CPU compiler.
        (a, b, c), (u, v, w) = state
        gap = _dot(b, b) - _dot(a, a)
        twice = 2 * _dot(a, b)
        reach = jnp.abs(gap) + jnp.sqrt(gap * gap + twice * twice)
        tangent = jnp.where(gap < 0, -twice, twice) / jnp.maximum(reach, tiny)
        cosine = jax.lax.rsqrt(1 + tangent * tangent)
        sine = cosine * tangent
        turn = lambda p, q: tuple(sine * x + cosine * y for x, y in zip(p, q, strict=True))
        back = lambda p, q: tuple(cosine * x - sine * y for x, y in zip(p, q, strict=True))
        return (turn(a, b), c, back(a, b)), (turn(u, v), w, back(u, v))

    start = tuple(tuple(matrix[row, column] for row in range(3)) for column in range(3))
    columns, basis = _part(jax.lax.fori_loop(0, iterations, rotate, (start, identity)))
    norms, basis = list(_part(tuple(_dot(column, column) for column in columns))), list(basis)
    for i, j in ((0, 1), (1, 2), (0, 1)):
        swap = norms[j] > norms[i]
        norms[i], norms[j] = jnp.where(swap, norms[j], norms[i]), jnp.where(swap, norms[i], norms[j])
        basis[i], basis[j] = _choose(swap, basis[j], basis[i]), _choose(swap, basis[i], basis[j])

    right_1 = _normalise(basis[0])
    right_2 = _normalise(_reject(basis[1], right_1))
    right_1, right_2 = _part((right_1, right_2))
    right_3 = _cross(right_1, right_2)
    image_1, image_2, image_3 = (tuple(_dot(row, right) for row in matrix) for right in (right_1, right_2, right_3))
    norm_1 = jnp.sqrt(_dot(image_1, image_1))
    left_1 = _choose(norm_1 > 0, tuple(x / jnp.where(norm_1 > 0, norm_1, 1) for x in image_1), right_1)
    image_2 = _reject(image_2, left_1)
    norm_2 = jnp.sqrt(_dot(image_2, image_2))
    known = norm_2 > jnp.finfo(matrix.dtype).eps * 0.5
    left_1, image_2, norm_2, known = _part((left_1, image_2, norm_2, known))
    # Rank one or none: any direction across the first will do; for the zero matrix it is the identity's own.
    across, other = _reject(right_2, left_1), _reject(right_3, left_1)
    across = _choose(_dot(across, across) > 0.25, across, other)
    across = _choose(_dot(across, across) > 0.25, across, right_1)
    left_2 = _normalise(_choose(known, image_2, across))
    left_2 = _part(_normalise(_reject(left_2, left_1)))
    left_3 = _cross(left_1, left_2)
    rotation = _combine((left_1, left_2, left_3), (right_1, right_2, right_3))
    # The third values' sign is what a mirror image leaves: this is tr(S·D) term by term.
    return rotation, jnp.stack([norm_1, jnp.where(known, norm_2, 0), _dot(left_3, image_3)])


@_decompose.def_vmap
def _decompose_vmap(size, batched, matrix):
    # One more batch axis is folded into the last one; as a leading axis it would undo the layout.
    del batched
    flat = jnp.moveaxis(matrix, 0, 2).reshape(3, 3, -1)
    rotation, singular = _decompose(flat)
    rotation = jnp.moveaxis(rotation.reshape(3, 3, size, -1), 2, 0)
    singular = jnp.moveaxis(singular.reshape(3, size, -1), 1, 0)
    return (rotation, singular), (True, True)


def _sum(values):
    """Over the first axis; of a few values one after the other, because a short reduction does not vectorise."""
    return sum(values[1:], values[0]) if values.shape[0] <= _FEW else jnp.sum(values, axis=0)


def _part(values):
    return jax.lax.optimization_barrier(values)


# Vectors as tuples of three arrays.


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _choose(condition, a, b):
    return tuple(jnp.where(condition, x, y) for x, y in zip(a, b, strict=True))


def _reject(vector, unit):
    """What is left of a vector without its part along a unit vector."""
    along = _dot(vector, unit)
    return tuple(x - along * u for x, u in zip(vector, unit, strict=True))


def _normalise(vector):
    square = _dot(vector, vector)
    inverse = jnp.where(square > 0, jax.lax.rsqrt(jnp.where(square > 0, square, 1)), 0)
    return tuple(x * inverse for x in vector)


def _reach(vector):
    return jnp.maximum(jnp.maximum(jnp.abs(vector[0]), jnp.abs(vector[1])), jnp.abs(vector[2]))


def _combine(left, right):
    """The matrices Σ left · rightᵀ."""
    left, right = _part((left, right))
    entry = lambda row, column: sum(a[row] * b[column] for a, b in zip(left[1:], right[1:], strict=True))
    return jnp.stack(
        [jnp.stack([left[0][row] * right[0][column] + entry(row, column) for column in range(3)]) for row in range(3)]
    )
