"""What refinement compares: inverse depths, normals and brightness of every frame, coarse to fine."""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.trajectory import Images, Samples, fit_planes
from jaxtyping import Array, Bool, Float, UInt8

from ipjax.cameras import resize, unproject
from ipjax.records import Camera

RADIUS = 2  # pixels of a level around each, through which a plane is fitted
SLANT = 4.0  # tangent of the steepest surface whose neighbouring pixels are still taken for one surface


@dataclasses.dataclass(frozen=True)
class Level:
    """All frames at one size."""

    images: Images
    samples: Samples
    jump: float  # largest relative difference of depth between neighbours of one surface


def make_levels(
    depths: Sequence[Float[np.ndarray, "h w"]],
    brightness: Sequence[Float[np.ndarray, "h w"]] | None,
    camera: Camera,
    shrinkings: Sequence[tuple[int, int]],
) -> dict[tuple[int, int], Level]:
    """Levels of all frames.

    Args:
      depths: of each frame, metres; 0 = unknown, or not to be used.
      brightness: of each frame; None = colours are not used.
      camera: of these images.
      shrinkings: of each level by how much images are smaller, and of how many of its pixels one is a sample (across
        and down).
    """
    height, width = depths[0].shape
    largest = max(shrink for shrink, _ in shrinkings)
    pad = ((0, -height % largest), (0, -width % largest))  # to the right and below: the camera is the same
    whole = (height + pad[0][1], width + pad[1][1])
    values = {}
    for shrink in sorted({shrink for shrink, _ in shrinkings}):
        size = whole[1] // shrink, whole[0] // shrink
        small = resize(camera, (whole[1], whole[0]), size) if shrink > 1 else camera
        jump = 0.01 + SLANT / float(np.asarray(small.focal).min())
        frames = []
        for k, depth in enumerate(depths):
            inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
            light = np.zeros_like(depth) if brightness is None else brightness[k]
            both = (jnp.asarray(np.pad(image, pad), jnp.float32) for image in (inverse, light))
            frames.append(_make_values(*both, small.focal, small.centre, jnp.float32(jump), shrink))
        values[shrink] = Images(jnp.stack(frames), small.focal, small.centre), jump
    return {key: Level(values[key[0]][0], _take(values[key[0]][0], key[1]), values[key[0]][1]) for key in shrinkings}


@partial(jax.jit, static_argnames=("shrink",))
def _make_values(
    inverse: Float[Array, "h w"],
    brightness: Float[Array, "h w"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    jump: Float[Array, ""],
    shrink: int,
) -> Float[Array, "a b 5"]:
    plane, normals = fit_planes(inverse, focal, centre, jump, shrink=shrink, radius=RADIUS)
    height, width = plane.shape
    brightness = jnp.mean(brightness.reshape(height, shrink, width, shrink), axis=(1, 3))
    return jnp.concatenate([plane[..., None], normals, brightness[..., None]], axis=-1)


def _take(images: Images, stride: int) -> Samples:
    """Every ``stride``-th pixel across and down, as a point of its camera."""
    count, height, width = images.values.shape[:3]
    first = stride // 2
    rows, columns = np.mgrid[first:height:stride, first:width:stride]
    chosen = images.values[:, rows.ravel(), columns.ravel()]
    pixels = jnp.asarray(np.stack([columns.ravel(), rows.ravel()], axis=-1), jnp.float32)
    there = chosen[..., 0] > 0
    depth = 1 / jnp.where(there, chosen[..., 0], 1)
    camera = Camera(focal=images.focal, centre=images.centre)
    places = unproject(camera, jnp.broadcast_to(pixels, (count, *pixels.shape)), depth)
    return Samples(places, chosen[..., 1:4], chosen[..., 4], there)


def flatten_light(rgb: UInt8[np.ndarray, "h w 3"], usable: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Brightness without what exposure and shading do to it: minus its local mean, over its local deviation.

    Where nothing is usable it is zero.
    """
    import cv2

    light = cv2.GaussianBlur(rgb.astype(np.float32).mean(-1) / 255, (0, 0), 0.02 * 0.5 * rgb.shape[1] / 6.4)
    sigma = 0.02 * rgb.shape[1]
    share = usable.astype(np.float32)
    blur = lambda image: cv2.GaussianBlur(image, (0, 0), sigma)
    weight = np.maximum(blur(share), 1e-3)
    mean = blur(light * share) / weight
    spread = np.sqrt(np.maximum(blur(light**2 * share) / weight - mean**2, 0))
    return np.where(usable, (light - mean) / (spread + 0.02), 0).astype(np.float32)
