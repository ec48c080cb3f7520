"""How a cheap RGB-D camera departs from the truth: exposure and noise of its photo, noise and holes of its depth."""

import dataclasses

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from ipjax.cameras import unproject
from ipjax.records import Camera


@dataclasses.dataclass(frozen=True)
class Sensor:
    """How a depth camera of the structured-light kind departs from the truth; all zero = a perfect one.

    The axial noise is Nguyen et al. 2012's for the Kinect: ``sigma = axial + quadratic (z - 0.4)²``, metres.
    """

    axial: float = 0.0012
    quadratic: float = 0.0019
    step: float = 0.0008  # quantisation at 1 m, metres; grows with z², as disparities do
    jitter: float = 0.5  # pixels by which edges fray
    holes: float = 0.03  # share of the image lost in blots
    edge: float = 0.5  # chance of losing a pixel beside a jump in depth
    grazing: float = 0.15  # cosine between ray and surface below which nothing comes back
    colour: float = 0.012  # noise of the photo, of the full range
    blur: float = 0.6  # of the photo, pixels


STRUCTURED_LIGHT = Sensor()
PERFECT = Sensor(*[0.0] * 9)


def expose(rng: np.random.Generator, rgb: UInt8[np.ndarray, "h w 3"], sensor: Sensor) -> UInt8[np.ndarray, "h w 3"]:
    """A rendered image as a cheap camera would have it: exposure, white balance, blur and noise."""
    if sensor.colour == 0 and sensor.blur == 0:
        return rgb
    image = rgb.astype(np.float32) / 255
    if sensor.blur:
        image = ndimage.gaussian_filter(image, (sensor.blur, sensor.blur, 0))
    balance = rng.uniform(0.9, 1.1) * rng.normal(1, 0.03, 3)
    image = np.clip(image * balance, 0, 1) ** rng.uniform(0.85, 1.15)
    image = image + sensor.colour * rng.standard_normal(image.shape, np.float32)
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def sense_depth(
    rng: np.random.Generator, depth: Float[np.ndarray, "h w"], camera: Camera, sensor: Sensor
) -> Float[np.ndarray, "h w"]:
    """True depth (metres along z, 0 = nothing) as a cheap sensor would have it: frayed edges, noise that grows with z²,
    steps, holes.
    """
    if sensor == PERFECT:
        return depth.astype(np.float32)
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    rise, run = np.gradient(depth.astype(np.float64), axis=0), np.gradient(depth.astype(np.float64), axis=1)
    # The normal of z(u, v) seen by a pinhole: tangents along u and v, crossed.
    fx, fy = np.asarray(camera.focal, float)
    rays = unproject(camera.to_matrix(), np.stack([columns, rows], -1).astype(float), np.ones((height, width)))
    along_u = rays * run[..., None] + depth[..., None] * [1 / fx, 0, 0]
    along_v = rays * rise[..., None] + depth[..., None] * [0, 1 / fy, 0]
    normal = np.cross(along_u, along_v)
    cosine = np.abs((normal * rays).sum(-1)) / np.maximum(
        np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1), 1e-12
    )
    jump = np.maximum(np.abs(rise), np.abs(run)) > 0.015

    shift = np.round(rng.normal(0, sensor.jitter, (2, height, width))).astype(int)
    moved = depth[np.clip(rows + shift[0], 0, height - 1), np.clip(columns + shift[1], 0, width - 1)].astype(np.float64)
    sigma = sensor.axial + sensor.quadratic * (moved - 0.4) ** 2
    noise = ndimage.gaussian_filter(rng.standard_normal((height, width)), 0.8)
    moved += sigma * noise / noise.std()
    if sensor.step:
        step = sensor.step * np.maximum(moved, 1e-3) ** 2
        moved = np.round(moved / step) * step
    blots = ndimage.gaussian_filter(rng.standard_normal((height, width)), 4)
    lost = blots > np.quantile(blots, 1 - sensor.holes) if sensor.holes else np.zeros_like(jump)
    lost |= jump & (rng.uniform(size=jump.shape) < sensor.edge)
    lost |= (cosine < sensor.grazing) & ~jump
    return np.where(lost | (depth <= 0), 0, np.round(moved, 4)).astype(np.float32)
