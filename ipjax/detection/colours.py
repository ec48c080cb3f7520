"""Histograms of colour in CIE L*a*b*, of a crop and of an object as its templates see it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ipjax.records import Templates, View

BINS = (4, 12, 12)  # of L*, a*, b*
CHROMA = 90.0  # a* and b* beyond it, either way, are in the last bin
POINTS = 8192  # of an object's coloured surface that are counted in each template
# Linear sRGB to X, Y, Z of D65 as shares of white: IEC 61966-2-1.
_WHITE = np.array([0.95047, 1.0, 1.08883])
_XYZ = (
    np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
    / _WHITE[:, None]
)


def to_lab(rgb: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """CIE L*a*b* of sRGB in [0, 1]."""
    linear = jnp.where(rgb <= 0.04045, rgb / 12.92, ((jnp.maximum(rgb, 0.04045) + 0.055) / 1.055) ** 2.4)
    shares = jnp.matmul(linear, jnp.asarray(_XYZ.T, rgb.dtype), precision="highest")
    small = (6 / 29) ** 3
    curve = jnp.where(shares > small, jnp.cbrt(jnp.maximum(shares, small)), shares / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = curve[..., 0], curve[..., 1], curve[..., 2]
    return jnp.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def bin_of(rgb: Float[Array, "*b 3"]) -> Int[Array, "*b"]:
    """The number of the bin that a colour falls into."""
    lab = to_lab(rgb)
    share = jnp.stack([lab[..., 0] / 100, *(0.5 + 0.5 * lab[..., i] / CHROMA for i in (1, 2))], axis=-1)
    bins = jnp.asarray(BINS, share.dtype)
    place = jnp.clip(jnp.floor(share * bins), 0, bins - 1).astype(jnp.int32)
    return (place[..., 0] * BINS[1] + place[..., 1]) * BINS[2] + place[..., 2]


def histogram(bins: Int[Array, "n"], weight: Float[Array, "n"]) -> Float[Array, "k"]:
    """Square roots of the shares of all bins: the product of two is Bhattacharyya's coefficient; zeros of nothing."""
    count = jnp.zeros(int(np.prod(BINS)), weight.dtype).at[bins].add(weight)
    return jnp.sqrt(count / jnp.maximum(jnp.sum(count), 1e-9))


def crop_histogram(view: View) -> Float[Array, "k"]:
    """Of the object's pixels in a crop."""
    return _histogram_of_image(view.rgb, view.mask)


def _histogram_of_image(rgb: Float[Array, "h w 3"], mask: Bool[Array, "h w"]) -> Float[Array, "k"]:
    return histogram(bin_of(rgb).reshape(-1), mask.reshape(-1).astype(rgb.dtype))


def template_histograms(templates: Templates) -> Float[Array, "v k"]:
    """Of each template: of the coloured surface that faces its camera, by the area it has there.

    An object from a photo has the photo's colours in all of its templates; one without colours has zeros.
    """
    views = templates.norm.shape[0]
    if templates.reference is not None:
        view = templates.reference.view
        return jnp.broadcast_to(_histogram_of_image(view.rgb, view.mask), (views, int(np.prod(BINS))))
    if templates.appearance is None:
        return jnp.zeros((views, int(np.prod(BINS))), jnp.float32)
    step = max(templates.appearance.points.shape[0] // POINTS, 1)
    points, normals, colours = (
        jnp.asarray(x[::step], jnp.float32)
        for x in (templates.appearance.points, templates.appearance.normals, templates.appearance.colours)
    )
    bins = bin_of(colours)

    def one(pose):
        placed = pose @ points
        facing = -jnp.sum(jnp.einsum("ij,nj->ni", pose.rotation, normals, precision="highest") * placed, axis=-1)
        return histogram(bins, jnp.maximum(facing, 0) / jnp.maximum(jnp.sum(placed * placed, axis=-1), 1e-9) ** 1.5)

    return lax.map(one, jax.tree.map(jnp.asarray, templates.camera_from_object))
