"""The photo's camera moved until the query's measured colours look like the photo, pixel by pixel: finer than patches.

Where light and exposure differ between the two, contrasts do not: colours are compared relative to their
surroundings, in units of how much they vary there.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.direct import Alignment, Picture, Points, Prior, align_directly, make_picture
from ipjax_kernels.perspective import Resection
from ipjax_kernels.positive import root
from ipjax_kernels.rigid import carry
from jaxtyping import Array, Bool, Float

from ipjax.cameras import point_map
from ipjax.config import ResectConfig
from ipjax.estimation.photo.drawing import measured_surface, splat_query
from ipjax.estimation.photo.resection import Sight, grid_normals
from ipjax.records import Query, ReferenceView
from ipjax.transforms import rotation_from_vector

STRIDE = 4  # pixels of the query between the points that are compared
BLURS = (0.0134, 0.0067)  # standard deviations, of the image's side: from coarse to fine
AROUND = 3.0  # of the surroundings, relative to them
CLEARLY = 0.9  # share of the loss below which a pose is clearly more alike
CONTRAST = 0.02  # colours that vary less than this tell little


class Comparison(eqx.Module):
    """Both images at each blur, ready to be compared."""

    photo: tuple[Picture, ...]
    query: tuple[Points, ...]  # metres, the query's camera
    middle: Float[Array, "3"]  # of the points


def prepare_comparison(reference: ReferenceView, query: Query) -> Comparison:
    """The contrasts of photo and query at each of `BLURS`, and the query's points, every `STRIDE`-th pixel."""
    view, known = query.view, measured_surface(query)
    points = point_map(view.camera, view.depth)
    places, normals = _thin(points), _thin(grid_normals(points, view.depth > 0))
    weight = _thin(known).astype(places.dtype)
    photo, lens = reference.view, reference.view.camera
    pictures, levels = [], []
    for blur in BLURS:
        picture = contrast(photo.rgb, photo.mask, blur)
        pictures.append(make_picture(picture, photo.mask, lens.focal, lens.centre))
        levels.append(Points(places, normals, _thin(contrast(view.rgb, known, blur)), weight))
    middle = jnp.sum(weight[:, None] * places, axis=0) / jnp.maximum(jnp.sum(weight), 1)
    return Comparison(tuple(pictures), tuple(levels), middle)


def unlikeness(
    comparison: Comparison, rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
) -> Float[Array, ""]:
    """How unlike the photo the query's fine contrasts are from a camera, in [0, 1]; 1 where nothing is to be seen."""
    return align_directly(rotation, translation, comparison.query[-1], comparison.photo[-1], steps=0).loss


def align_drawn(
    reference: ReferenceView,
    query: Query,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    prior: Prior,
    sight: Sight,
    config: ResectConfig,
) -> Alignment:
    """The photo's camera moved until the query, as it is drawn there, looks like the photo.

    A pixel's surroundings are then the same surface in both images. Those of the query's own image are not, for it saw
    them from elsewhere, and that turns poses by some degrees.

    Args:
      rotation, translation: the photo's camera from the query's, metres; within a few degrees.
      prior: of `expect`.
    """
    image, depth = splat_query(reference, query, rotation, translation, sight)
    photo, lens = reference.view, reference.view.camera
    both = (depth > 0) & photo.mask
    places = image[..., 3:]
    placed = jnp.einsum("ij,hwj->hwi", rotation, places, precision="highest") + translation
    normals = jnp.einsum("ji,hwj->hwi", rotation, grid_normals(placed, both), precision="highest")
    picture = make_picture(contrast(photo.rgb, both, BLURS[0]), both, lens.focal, lens.centre)
    drawn = contrast(image[..., :3], both, BLURS[0])
    points = Points(_thin(places), _thin(normals), _thin(drawn), _thin(both).astype(depth.dtype))
    return align_directly(rotation, translation, points, picture, prior, steps=config.steps // 2)


def _thin(image: Array) -> Array:
    """Every `STRIDE`-th pixel of every `STRIDE`-th row, in one row."""
    return image[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].reshape(-1, *image.shape[2:])


def contrast(image: Float[Array, "h w c"], mask: Bool[Array, "h w"], blur: float) -> Float[Array, "h w c"]:
    """A blurred image less its surroundings' mean, over their standard deviation; only what the mask holds counts."""
    inside = mask[..., None].astype(image.dtype)
    side = image.shape[1]

    def mean(values, width):
        weight = jnp.maximum(_blur(inside, width * side), 1e-3)
        return _blur(values * inside, width * side) / weight

    fine = mean(image, blur)
    around = mean(fine, AROUND * blur)
    varies = root(jnp.sum(mean((fine - around) ** 2, AROUND * blur), axis=-1, keepdims=True))
    return (fine - around) / (varies + CONTRAST) * inside


def _blur(image: Float[Array, "h w c"], deviation: float) -> Float[Array, "h w c"]:
    """Gaussian; outside of the image is zero. Two products with band matrices, which are fast everywhere."""

    def band(size):
        apart = np.abs(np.arange(size)[:, None] - np.arange(size)[None])
        weight = np.exp(-0.5 * (apart / max(deviation, 0.3)) ** 2) * (apart <= max(1, round(2.5 * deviation)))
        return jnp.asarray(weight / weight[size // 2].sum(), image.dtype)

    rows, columns = band(image.shape[0]), band(image.shape[1])
    return jnp.einsum("ij,jkc,lk->ilc", rows, image, columns, precision="highest")


def expect(
    comparison: Comparison,
    fit: Resection,
    points: Float[Array, "p 3"],
    weight: Float[Array, "p"],
    config: ResectConfig,
) -> Prior:
    """What a fit of patches tells the alignment of colours: where nothing has texture, patches decide.

    Args:
      points, weight: that were fitted.
    """
    total = jnp.sum(weight)
    centre = jnp.sum(weight[:, None] * points, axis=0) / jnp.where(total > 1e-12, total, 1)
    # A turn about the comparison's middle shifts the centre of what was fitted, too.
    moved = carry(jnp.matmul(fit.rotation, centre - comparison.middle, precision="highest"))
    # Of Gauss and Newton's loss, which grows by δᵀ information δ.
    information = jnp.matmul(jnp.matmul(moved.T, fit.information, precision="highest"), moved, precision="highest")
    return Prior(fit.rotation, fit.translation, 2 * config.patches * information, comparison.middle)


def align_colours(comparison: Comparison, prior: Prior, config: ResectConfig) -> Alignment:
    """The photo's camera moved until the query's colours look like the photo, from where it is expected and beside.

    Args:
      prior: of `expect`.

    Returns:
      The most alike of ``1 + config.starts``; those beside are turned by ``config.away`` about the points' middle, and
      must be clearly more alike: between two that are equal, the nearer is the likelier.
    """
    rotation, translation = prior.rotation, prior.translation
    dtype = translation.dtype
    angle = 2 * jnp.pi * jnp.arange(config.starts, dtype=dtype) / max(config.starts, 1)
    beside = config.away * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=-1)
    beside = jnp.concatenate([jnp.zeros((1, 3), dtype), beside])

    def align(turn):
        turned = jnp.matmul(rotation_from_vector(turn), rotation, precision="highest")
        shift = translation + jnp.matmul(rotation - turned, comparison.middle, precision="highest")
        found = Alignment(turned, shift, jnp.ones((), dtype))
        for points, picture in zip(comparison.query, comparison.photo, strict=True):
            found = align_directly(found.rotation, found.translation, points, picture, prior, steps=config.steps // 2)
        return found

    found = jax.vmap(align)(beside)
    best = jnp.argmin(found.loss * jnp.where(jnp.arange(beside.shape[0]) > 0, 1 / CLEARLY, 1))
    return jax.tree.map(lambda x: x[best], found)
