"""Images of the field by marching rays through it, as the official renderer does."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ipjax.networks.triposr.field import activate_density, sample_planes
from ipjax.networks.triposr.model import TripoSR


class Rays(eqx.Module):
    """Origins and unit directions, in the mesh frame."""

    origins: Float[Array, "*b 3"]
    directions: Float[Array, "*b 3"]


class Rendering(eqx.Module):
    """What rays saw of the field."""

    rgb: Float[Array, "*b 3"]  # [0, 1], on white
    distance: Float[Array, "*b"]  # along the ray, mesh units; 0 = the ray met nothing
    opacity: Float[Array, "*b"]  # [0, 1]


def orbit_rays(
    views: int, height: int, width: int, *, elevation: float = 0.0, distance: float = 1.9, fov: float = 40.0
) -> Rays:
    """Rays of cameras on a circle that look at the origin; degrees, mesh units; the first stands on +x.

    Field of view is the vertical one. Shapes: ``views height width 3``.
    """
    azimuth = np.deg2rad(np.linspace(0.0, 360.0, views + 1)[:views])
    tilt = np.deg2rad(elevation)
    spot = [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.full(views, np.sin(tilt))]
    position = distance * np.stack(spot, axis=-1)
    ahead = -position / distance
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.cross(right, ahead)
    focal = 0.5 * height / np.tan(0.5 * np.deg2rad(fov))
    x = (np.arange(width) + 0.5 - 0.5 * width) / focal
    y = (np.arange(height) + 0.5 - 0.5 * height) / focal
    view = lambda axis: axis[:, None, None, :]
    directions = view(ahead) + x[None, None, :, None] * view(right) - y[None, :, None, None] * view(up)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = np.broadcast_to(view(position), directions.shape)
    return Rays(jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32))


def meet_cube(rays: Rays, radius: float) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Bool[Array, "*b"]]:
    """Where rays enter and leave the cube of half side ``radius``·(1 − 1e-3), and whether they meet it (else 0, 0)."""
    half = radius * (1 - 1e-3)
    steep = jnp.where(jnp.abs(rays.directions) < 1e-6, 1e-6, rays.directions)
    low, high = (-half - rays.origins) / steep, (half - rays.origins) / steep
    near = jnp.maximum(jnp.max(jnp.minimum(low, high), axis=-1), 0.0)
    far = jnp.min(jnp.maximum(low, high), axis=-1)
    valid = far - near > 0.01
    return jnp.where(valid, near, 0.0), jnp.where(valid, far, 0.0), valid


def render(model: TripoSR, triplane: Float[Array, "3 c h w"], rays: Rays, *, chunk: int = 1024) -> Rendering:
    """March rays through the field, ``chunk`` (static) rays at a time; any leading shape.

    As the official renderer: mid points of equal bins between entry and exit, an opacity with a step of
    1 / samples whatever the metric step, white behind. All rays are marched, those that miss are masked afterwards.
    """
    samples = model.config.samples
    middle = jnp.asarray((np.arange(samples) + 0.5) / samples, jnp.float32)

    def march(ray: Rays) -> Rendering:
        near, far, valid = meet_cube(ray, model.config.radius)
        distance = near * (1 - middle) + far * middle
        points = ray.origins + distance[:, None] * ray.directions
        raw = model.decoder(sample_planes(triplane, points, model.config.radius))
        alpha = 1 - jnp.exp(-activate_density(model, raw[:, 0]) / samples)
        passed = jnp.cumprod(1 - alpha + 1e-10)
        weight = alpha * jnp.concatenate([jnp.ones(1, jnp.float32), passed[:-1]])
        opacity = jnp.sum(weight)
        rgb = jnp.sum(weight[:, None] * jax.nn.sigmoid(raw[:, 1:]), axis=0) + 1 - opacity
        mean = jnp.sum(weight * distance) / jnp.maximum(opacity, 1e-6)
        return Rendering(
            rgb=jnp.where(valid, rgb, 1.0),
            distance=jnp.where(valid & (opacity > 0.5), mean, 0.0),
            opacity=jnp.where(valid, opacity, 0.0),
        )

    shape = rays.origins.shape[:-1]
    flat = Rays(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3))
    seen = jax.lax.map(march, flat, batch_size=min(chunk, flat.origins.shape[0]))
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), seen)
