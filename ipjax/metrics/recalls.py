"""From errors to figures: recalls at thresholds, and areas under the curves of recalls."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

THRESHOLDS = 0.05 * np.arange(1, 11)  # of the diameter: MSSD's and VSD's, and VSD's tolerances tau
PIXEL_THRESHOLDS = 5.0 * np.arange(1, 11)  # MSPD, for images 640 pixels wide
SIZE_TOLERANCES = np.array([0.02, 0.05, 0.1])  # of the true size: what counts as the right size
ADD_LIMIT = 0.1  # metres: where the area under the accuracy-threshold curve of the YCB-V papers ends


def recall(errors: Float[Array, "*b n"], thresholds: Float[Array, "t"]) -> Float[Array, "*b t"]:
    """Share of errors strictly below each threshold; NaN and infinity are misses. 0 for no errors at all."""
    errors = jnp.asarray(errors)
    below = errors[..., None, :] < thresholds[:, None]
    return jnp.sum(below, axis=-1).astype(errors.dtype) / max(errors.shape[-1], 1)


def average_recall(errors: Float[Array, "*b n"], thresholds: Float[Array, "t"] | None = None) -> Float[Array, "*b"]:
    """Mean of the recalls at several thresholds (BOP's ten, in diameters, when None), in [0, 1]."""
    errors = jnp.asarray(errors)
    chosen = jnp.asarray(THRESHOLDS if thresholds is None else thresholds, errors.dtype)
    return jnp.mean(recall(errors, chosen), axis=-1)


def area_under_accuracy(errors: Float[Array, "n"], limit: float = ADD_LIMIT) -> Float[Array, ""]:
    """Area under the accuracy-threshold curve from 0 to ``limit``, in [0, 1]: the AUC of ADD and ADD-S.

    Errors beyond the limit, and infinite ones, are misses. As in PoseCNN's toolbox (Xiang et al. 2018), the curve
    takes its higher value between two errors. Same unit for errors and limit; 0 for no errors at all.
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
