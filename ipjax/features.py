"""From a view to its patches: a feature and a 3-D point each (the paper's F, and Eq. 6 before matching)."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ipjax.cameras import point_map
from ipjax.config import DescribeConfig
from ipjax.types import Patches, Query, View


def describe(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    view: View,
    config: DescribeConfig = DescribeConfig(),
) -> Patches:
    """Encode a view and lift its patches.

    Args:
      encoder: any callable pytree from an image ``[h w 3]`` in [0, 1] to unit-norm features ``[h/patch w/patch c]``.
      view: one image, its depth (0 = unknown), mask and camera.

    Returns:
      ``p = gh·gw`` patches in row-major order; points in the view's camera frame, in the unit of its depth.

    Raises:
      ValueError: the image is not a whole number of patches on either side.
    """
    features = encoder(view.rgb)
    rows, columns, channels = features.shape
    height, width = view.depth.shape
    if height % rows or width % columns:
        raise ValueError(f"the encoder made {rows}×{columns} patches of an image of {height}×{width} pixels")
    points, cover = lift(view, rows, columns, config.spread)
    grid = jnp.stack(jnp.meshgrid(jnp.arange(columns), jnp.arange(rows)), axis=-1).astype(jnp.float32)
    return Patches(
        features=features.reshape(-1, channels),
        points=points,
        grid=grid.reshape(-1, 2),
        valid=cover >= config.cover,
    )


def observe(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    view: View,
    config: DescribeConfig = DescribeConfig(),
) -> Query:
    """``describe`` a crop of the scene and keep the crop beside its patches, as ``estimate`` takes it.

    Args and errors: as :func:`describe`; depth in metres.
    """
    return Query(describe(encoder, view, config), view)


def centre(
    patches: Patches,
) -> tuple[Patches, Float[Array, "c"], Float[Array, "v p"]]:
    """Take the mean of an object's features out of every one of them, and make what is left unit vectors again.

    All patches of one object share most of their feature; what tells them apart is the rest.

    Args:
      patches: of all templates, ``v p``; the mean is over the valid ones.

    Returns:
      The patches, the mean, and the norm of each remainder: raw feature = norm · feature + mean.
    """
    raw = patches.features.astype(jnp.float32)
    share = patches.valid.astype(raw.dtype)[..., None]
    mean = jnp.sum(raw * share, axis=(0, 1)) / jnp.maximum(jnp.sum(share), 1)
    features, norm = centre_on(raw, mean)
    return Patches(features.astype(patches.features.dtype), patches.points, patches.grid, patches.valid), mean, norm


def centre_on(
    features: Float[Array, "*b c"], mean: Float[Array, "c"]
) -> tuple[Float[Array, "*b c"], Float[Array, "*b"]]:
    """Unit vectors of what is left of features without ``mean``, and its norms; nothing left gives zeros."""
    rest = features - mean
    norm = jnp.sqrt(jnp.sum(rest * rest, axis=-1))
    return rest / jnp.maximum(norm, 1e-9)[..., None], norm


def lift(
    view: View, rows: int, columns: int, spread: float | Float[Array, ""]
) -> tuple[Float[Array, "p 3"], Float[Array, "p"]]:
    """One 3-D point for each patch, and the share of its pixels that support it.

    The point is the mean over the patch's object pixels whose depth is within ``spread`` of their median: at a fold
    or silhouette, the mean of all of them would lie on neither surface.
    """

    def patches(image):
        height, width = image.shape[:2]
        cut = image.reshape(rows, height // rows, columns, width // columns, *image.shape[2:])
        return jnp.moveaxis(cut, 2, 1).reshape(rows * columns, -1, *image.shape[2:])

    depth = patches(view.depth)
    points = patches(point_map(view.camera, view.depth))
    usable = patches(view.mask) & (depth > 0)
    median = _masked_median(depth, usable)
    usable = usable & (jnp.abs(depth - median[:, None]) <= spread * median[:, None])
    count = jnp.sum(usable, axis=1)
    total = jnp.sum(jnp.where(usable[..., None], points, 0), axis=1)
    return total / jnp.maximum(count, 1)[:, None].astype(total.dtype), count / depth.shape[1]


def _masked_median(values: Float[Array, "p n"], mask: Bool[Array, "p n"]) -> Float[Array, "p"]:
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf), axis=1)
    middle = jnp.maximum(jnp.sum(mask, axis=1) - 1, 0) // 2
    median = jnp.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]
    return jnp.where(jnp.isfinite(median), median, 0)
