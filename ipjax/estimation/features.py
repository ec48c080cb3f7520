"""From a view to its patches: a feature and a 3-D point each (the paper's F, and Eq. 6 before matching)."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from jaxtyping import Array, Bool, Float

from ipjax.cameras import point_map
from ipjax.config import DescribeConfig
from ipjax.estimation.validity import finite_patches, finite_view
from ipjax.records import UNNAMED, Patches, Query, Templates, View


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
      ``p = gh·gw`` patches in row-major order; points in the view's camera frame, in the unit of its depth. What rests
      on numbers that are not finite is not valid (``ipjax.estimation.validity``).

    Raises:
      ValueError: the image is not a whole number of patches on either side.
    """
    view, has_camera = finite_view(view)
    features = encoder(view.rgb)
    rows, columns, channels = features.shape
    height, width = view.depth.shape
    if height % rows or width % columns:
        raise ValueError(f"the encoder made {rows}×{columns} patches of an image of {height}×{width} pixels")
    points, cover = lift(view, rows, columns, config.spread)
    grid = jnp.stack(jnp.meshgrid(jnp.arange(columns), jnp.arange(rows)), axis=-1).astype(jnp.float32)
    patches = Patches(
        features=features.reshape(-1, channels),
        points=points,
        grid=grid.reshape(-1, 2),
        valid=(cover >= config.cover) & has_camera,
        encoder=identity_of(encoder),
    )
    return finite_patches(patches)


def identity_of(encoder: object) -> str | None:
    """The ``identity`` of an encoder, by which its features are known from those of others; None where it has none.

    Encoders of your own may have one, too: any text that changes with their weights and settings.
    """
    identity = getattr(encoder, "identity", None)
    return identity if isinstance(identity, str) and identity not in ("", UNNAMED) else None


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
    """Subtract the mean of an object's features from each of them, and normalise the remainders.

    All patches of one object have most of their feature in common; the remainder is what distinguishes them.

    Args:
      patches: of all templates, ``v p``; the mean is over the valid ones.

    Returns:
      The patches, the mean, and the norm of each remainder: raw feature = norm · feature + mean.
    """
    raw = patches.features.astype(jnp.float32)
    share = patches.valid.astype(raw.dtype)[..., None]
    mean = jnp.sum(raw * share, axis=(0, 1)) / jnp.maximum(jnp.sum(share), 1)
    features, norm = centre_on(raw, mean)
    return dataclasses.replace(patches, features=features.astype(patches.features.dtype)), mean, norm


def principal_basis(patches: Patches, count: int) -> Float[np.ndarray, "f c"]:
    """The ``count`` strongest principal directions of an object's centred features (of its valid patches), as rows.

    On the host, once per object. The largest entry of each row is positive, so that the same features give the same
    basis everywhere.

    Raises:
      ValueError: ``count`` is not between 1 and the number of channels.
    """
    check_cut(patches.features.shape[-1], count)
    features = np.asarray(patches.features, np.float64)[np.asarray(patches.valid)]
    _, vectors = np.linalg.eigh(features.T @ features)
    basis = vectors[:, ::-1][:, :count].T
    sign = np.sign(basis[np.arange(count), np.abs(basis).argmax(axis=1)])
    return (basis * sign[:, None]).astype(np.float32)


def check_cut(channels: int, count: int) -> None:
    """Raise ValueError unless features of so many channels can be cut to ``count``."""
    if not 1 <= count <= channels:
        raise ValueError(f"features of {channels} channels cannot be cut to {count}")


def cut(features: Float[Array, "*b c"], basis: Float[Array, "f c"]) -> tuple[Float[Array, "*b f"], Float[Array, "*b"]]:
    """Unit vectors of the components of features along the rows of a basis, and their norms."""
    short = jnp.matmul(features.astype(basis.dtype), basis.T, precision="highest")
    norm = root(jnp.sum(short * short, axis=-1))
    return short / jnp.maximum(norm, 1e-9)[..., None], norm


def object_features(features: Float[Array, "*b c"], templates: Templates) -> Float[Array, "*b f"]:
    """An encoder's raw features as the templates hold theirs: without the object's mean, cut to its basis."""
    rest = centre_on(features, templates.mean)[0]
    return rest if templates.basis is None else cut(rest, templates.basis)[0]


def centre_on(
    features: Float[Array, "*b c"], mean: Float[Array, "c"]
) -> tuple[Float[Array, "*b c"], Float[Array, "*b"]]:
    """Features less ``mean``, as unit vectors, and the norms of the remainders; a remainder of zero stays zero."""
    rest = features - mean
    norm = root(jnp.sum(rest * rest, axis=-1))
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
    count = jnp.sum(usable, axis=1, dtype=depth.dtype)
    total = jnp.sum(jnp.where(usable[..., None], points, 0), axis=1)
    return total / jnp.maximum(count, 1)[:, None], count / depth.shape[1]


def _masked_median(values: Float[Array, "p n"], mask: Bool[Array, "p n"]) -> Float[Array, "p"]:
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf), axis=1)
    middle = jnp.maximum(jnp.sum(mask, axis=1) - 1, 0) // 2
    median = jnp.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]
    return jnp.where(jnp.isfinite(median), median, 0)
