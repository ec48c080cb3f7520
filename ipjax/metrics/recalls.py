"""From errors to figures: recalls at thresholds, and areas under the curves of recalls."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ipjax.metrics.displacements import namespace
from ipjax.transforms import A

THRESHOLDS = 0.05 * np.arange(1, 11)  # of the diameter: MSSD's and VSD's, and VSD's tolerances tau
PIXEL_THRESHOLDS = 5.0 * np.arange(1, 11)  # MSPD, for images 640 pixels wide
SIZE_TOLERANCES = np.array([0.02, 0.05, 0.1])  # of the true size: what counts as the right size
ADD_LIMIT = 0.1  # metres: where the area under the accuracy-threshold curve of the YCB-V papers ends
GRASP_LIMIT = 0.02  # metres of ADD-S that most grippers tolerate (DenseFusion, https://arxiv.org/abs/1901.04780)
TURN_LIMIT, SHIFT_LIMIT = math.radians(5), 0.05  # radians, metres: "5° 5 cm" (Shotton et al. 2013, 7-Scenes)


def recall(errors: Float[A, "*b n"], thresholds: Float[A, "t"]) -> Float[A, "*b t"]:
    """Share of errors strictly below each threshold; NaN and infinity are misses. 0 for no errors at all."""
    xp = namespace(errors, thresholds)
    errors = xp.asarray(errors)
    below = errors[..., None, :] < thresholds[:, None]
    return xp.asarray(xp.sum(below, axis=-1).astype(errors.dtype) / max(errors.shape[-1], 1))


def pose_recall(
    turns: Float[A, "*b n"], shifts: Float[A, "*b n"], turn_limit: float = TURN_LIMIT, shift_limit: float = SHIFT_LIMIT
) -> Float[A, "*b"]:
    """Share of poses whose rotation error (radians) and translation error (metres) are both strictly below the limits.

    By default "5° 5 cm". NaN and infinity are misses. 0 for no poses at all. `symmetric_errors` measures both.
    """
    xp = namespace(turns, shifts)
    within = (turns < turn_limit) & (shifts < shift_limit)
    return xp.asarray(xp.sum(within, axis=-1).astype(turns.dtype) / max(turns.shape[-1], 1))


def average_recall(errors: Float[Array, "*b n"], thresholds: Float[Array, "t"] | None = None) -> Float[Array, "*b"]:
    """Mean of the recalls at several thresholds (BOP's ten, in diameters, when None), in [0, 1]."""
    errors = jnp.asarray(errors)
    chosen = jnp.asarray(THRESHOLDS if thresholds is None else thresholds, errors.dtype)
    return jnp.mean(recall(errors, chosen), axis=-1)


def auc(errors: Float[A, "*b n"], limit: float = ADD_LIMIT) -> Float[A, "*b"]:
    """Area under the accuracy-threshold curve from 0 to ``limit``, over ``limit``, in [0, 1]: the AUC of ADD and ADD-S.

    The accuracy at a threshold is the share of errors below it (PoseCNN, https://arxiv.org/abs/1711.00199; DenseFusion,
    https://arxiv.org/abs/1901.04780). Its integral is the mean of max(0, 1 − error / limit): exact, no threshold is
    sampled. So an area over several objects is the mean of theirs, weighted by their instances. Errors beyond the
    limit, infinite ones and NaN add nothing. Same unit for errors and limit; 0 for no errors at all.
    `area_under_accuracy` is the sum in PoseCNN's toolbox, higher by up to 1 / n.
    """
    xp = namespace(errors)
    gains = xp.where(errors < limit, 1 - errors / limit, xp.zeros_like(errors))
    return xp.asarray(xp.sum(gains, axis=-1) / max(errors.shape[-1], 1))


def area_under_accuracy(errors: Float[Array, "n"], limit: float = ADD_LIMIT) -> Float[Array, ""]:
    """`auc` as PoseCNN's toolbox sums it (https://github.com/yuxng/YCB_Video_toolbox, VOCap in
    plot_accuracy_keyframe.m): between two errors the curve takes its higher value.

    One error below the limit has an area of 1, however large it is; of n errors the area is higher than the integral by
    the largest below the limit, over n · limit. Errors beyond the limit, and infinite ones, are misses. Same unit for
    errors and limit; 0 for no errors at all.
    """
    errors = jnp.asarray(errors)
    count = errors.shape[0]
    if count == 0:
        return jnp.zeros((), errors.dtype)
    found = jnp.sum(errors <= limit)
    clipped = jnp.sort(jnp.where(errors <= limit, errors, limit))
    steps = jnp.diff(clipped, prepend=jnp.zeros((1,), errors.dtype))
    accuracy = jnp.minimum(jnp.arange(1, count + 1), found).astype(errors.dtype) / count
    rest = (limit - clipped[-1]) * found.astype(errors.dtype) / count
    return (jnp.sum(steps * accuracy) + rest) / limit
