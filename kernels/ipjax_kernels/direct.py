"""Direct image alignment: the camera from which known, coloured points look like an image (robust Gauss–Newton).

No features are matched: each point's colour is compared with the image where the point falls, and the image's slopes
tell where to go. B. D. Lucas and T. Kanade, "An iterative image registration technique", 1981; with points in space, as
in dense visual odometry: C. Kerl, J. Sturm and D. Cremers, "Robust odometry estimation for RGB-D cameras", 2013.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ipjax_kernels.positive import root
from ipjax_kernels.rigid import descend

LONGEST = 0.15  # rad: turn of one step; an image's slopes tell little of what is farther away


class Picture(NamedTuple):
    """An image with its slopes, channels last; the last channel is 1 where there is an image."""

    values: Float[Array, "h w d"]  # colours, their slopes across and down, presence: d = 3 c + 1
    focal: Float[Array, "2"]  # pixels
    centre: Float[Array, "2"]  # pixels


class Points(NamedTuple):
    """Coloured points of a surface."""

    places: Float[Array, "k 3"]
    normals: Float[Array, "k 3"]  # towards where they were seen from; zero = unknown, such a point does not count
    colours: Float[Array, "k c"]
    weight: Float[Array, "k"]  # 0 = absent


class Prior(NamedTuple):
    """Where a camera is by other evidence: a pose, and how fast the loss grows away from it."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    information: Float[Array, "6 6"]  # of (turn about the middle, shift): the loss grows by ½ δᵀ information δ
    middle: Float[Array, "3"]  # points' unit: near their centre


class Alignment(NamedTuple):
    """The pose of a camera, and how unlike the image the points look."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]  # in the points' unit
    loss: Float[Array, ""]  # mean of the robust losses, in [0, 1]


def make_picture(
    image: Float[Array, "h w c"], inside: Bool[Array, "h w"], focal: Float[Array, "2"], centre: Float[Array, "2"]
) -> Picture:
    """The image and its slopes by central differences; zero at the image's border."""
    across = jnp.pad((image[:, 2:] - image[:, :-2]) / 2, ((0, 0), (1, 1), (0, 0)))
    down = jnp.pad((image[2:] - image[:-2]) / 2, ((1, 1), (0, 0), (0, 0)))
    there = inside[..., None].astype(image.dtype)
    return Picture(jnp.concatenate([image, across, down, there], axis=-1), focal, centre)


@partial(jax.jit, static_argnames="steps")
def align_directly(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    points: Points,
    picture: Picture,
    prior: Prior | None = None,
    *,
    steps: int = 5,
    facing: float = 0.2,
) -> Alignment:
    """A camera's pose, moved until the points look like the image: ``steps`` of damped Gauss–Newton.

    The loss of a point is Geman–McClure's ρ = r² / (r² + 1) of its distance r in colour from the image; that of a point
    which falls outside of what is shown is 1. A step that does not lower the mean is not taken, and the next one is
    damped more.

    Args:
      rotation, translation: the start, camera from points.
      prior: added to the loss that is lowered, not to the one that is returned. Where the image has no texture, it
        alone decides.
      facing: the least cosine between a point's normal and the direction to the camera, with which it counts.
    """
    share = points.weight / jnp.maximum(jnp.sum(points.weight), 1e-12)
    middle = jnp.sum(share[:, None] * points.places, axis=0) if prior is None else prior.middle
    # Turned about their centre, so that turn and shift are as independent as they can be.
    places = points.places - middle
    translation = translation + jnp.sum(rotation * middle[None], axis=1)
    channels = points.colours.shape[1]

    def evaluate(rotation, translation):
        turned = jnp.matmul(places, rotation.T, precision="highest")
        moved = turned + translation
        depth = moved[:, 2]
        ahead = depth > 1e-3 * jnp.maximum(translation[2], 1e-9)
        inverse = 1 / jnp.where(ahead, depth, 1)
        x, y = moved[:, 0] * inverse, moved[:, 1] * inverse
        seen = _sample(picture.values, picture.focal * jnp.stack([x, y], axis=-1) + picture.centre)
        normals = jnp.matmul(points.normals, rotation.T, precision="highest")
        distance = root(jnp.sum(moved**2, axis=-1))
        shown = ahead & (-jnp.sum(normals * moved, axis=-1) > facing * distance)
        counted = jnp.where(shown, points.weight, 0)
        counted = counted / jnp.maximum(jnp.sum(counted), 1e-12)
        inside = seen[:, -1] > 0.99
        offset = seen[:, :channels] - points.colours
        squared = jnp.sum(offset**2, axis=-1)
        loss = jnp.sum(counted * jnp.where(inside, squared / (1 + squared), 1))
        # Iteratively reweighted: ρ'(r²) as the weight of each square.
        each = jnp.where(inside, counted / (1 + squared) ** 2, 0)
        zero = jnp.zeros_like(x)
        by_point = [
            focal * jnp.stack(row, axis=-1)
            for focal, row in zip(
                picture.focal, ([inverse, zero, -x * inverse], [zero, inverse, -y * inverse]), strict=True
            )
        ]
        # d(ω × p) = ω · (p × ·)
        by_pose = [jnp.concatenate([jnp.cross(turned, row), row], axis=-1)[:, None] for row in by_point]
        slopes = seen[:, channels : 2 * channels, None] * by_pose[0] + seen[:, 2 * channels : -1, None] * by_pose[1]
        slopes = jnp.where(inside[:, None, None], slopes, 0)
        hessian = jnp.einsum("kca,kcb,k->ab", slopes, slopes, each, precision="highest")
        slope = jnp.einsum("kca,kc,k->a", slopes, offset, each, precision="highest")
        loss = jnp.where(jnp.any(counted > 0), loss, 1)
        if prior is None:
            return loss, hessian, slope, loss
        # The axis of a small turn, exact to its third order.
        turn = jnp.matmul(rotation, prior.rotation.T, precision="highest")
        axis = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        expected = prior.translation + jnp.sum(prior.rotation * middle[None], axis=1)
        away = jnp.concatenate([axis, translation - expected])
        pull = jnp.sum(prior.information * away[None], axis=1)
        return loss + jnp.sum(pull * away) / 2, hessian + prior.information / 2, slope + pull / 2, loss

    rotation, translation, here = descend(evaluate, rotation, translation, longest=LONGEST, steps=steps)
    return Alignment(rotation, translation - jnp.sum(rotation * middle[None], axis=1), here[3])


def _sample(image: Float[Array, "h w d"], pixels: Float[Array, "k 2"]) -> Float[Array, "k d"]:
    """Bilinear; what lies outside of the image is that of its border."""
    height, width = image.shape[:2]
    last = jnp.asarray([width - 1, height - 1], pixels.dtype)
    place = jnp.clip(pixels, 0, last)
    corner = jnp.minimum(jnp.floor(place), jnp.maximum(last - 1, 0))
    share = place - corner
    column, row = corner[:, 0].astype(jnp.int32), corner[:, 1].astype(jnp.int32)
    right, below = jnp.minimum(column + 1, width - 1), jnp.minimum(row + 1, height - 1)
    x, y = share[:, :1], share[:, 1:]
    above = image[row, column] * (1 - x) + image[row, right] * x
    return above * (1 - y) + (image[below, column] * (1 - x) + image[below, right] * x) * y
