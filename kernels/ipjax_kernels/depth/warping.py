"""A depth image seen from another camera: a surface between its pixels, cut where depth jumps, squares at its borders.

Pixel centres are integers; depth is along z in the units of the points, and 0 where nothing is.
"""

from functools import partial, reduce

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

_SLACK = 1e-3  # of a cell: neighbouring cells both take what lies on the line between them


@partial(jax.jit, static_argnames=("height", "width", "reach"))
def warp_depth(
    points: Float[Array, "r c 3"],
    valid: Bool[Array, "r c"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
    *,
    jump: float | Float[Array, ""] = 0.02,
    size: Float[Array, "2"] | float = 1.1,
    reach: int = 3,
) -> Float[Array, "h w"]:
    """The z-buffer of a depth image's points, in the frame of the camera that is to see them.

    Two triangles between every four pixels that are neighbours carry the surface, if the z of their corners differ by
    at most ``jump`` of themselves; 1 / z is linear across a triangle. Where there is none, every point covers a
    rectangle, so that borders are where half a pixel ends, and holes between points close. The nearest wins; a
    rectangle wins over a surface only if it is nearer by more than ``jump``.

    Args:
      size: width and height of a point's rectangle in pixels of the new image: what a pixel of the old one covers.
      reach: pixels of the new image that one cell may span on each axis; what is beyond is left to the rectangles.

    Time: 2 · reach² scatters of the image; temporary memory: a few images.
    """
    z = points[..., 2]
    there = valid & (z > 1e-6) & jnp.isfinite(points).all(axis=-1)
    safe = jnp.where(there, z, 1)
    x = jnp.where(there, focal[0] * points[..., 0] / safe + centre[0], -1e6)
    y = jnp.where(there, focal[1] * points[..., 1] / safe + centre[1], -1e6)
    inverse = 1 / safe
    corners = [_corner(x, y, inverse, there, down, right) for down, right in ((0, 0), (0, 1), (1, 0), (1, 1))]
    far = jnp.asarray(jnp.inf, points.dtype)
    surface = _draw(jnp.full(height * width, far), corners, height, width, jump, reach)
    size = jnp.broadcast_to(jnp.asarray(size, points.dtype), 2)
    covered = jnp.full(height * width, far)
    first_x, first_y = jnp.ceil(x - size[0] / 2), jnp.ceil(y - size[1] / 2)

    def cover(step, covered):
        column, row = first_x + step % reach, first_y + step // reach
        inside = there & (column <= x + size[0] / 2) & (row <= y + size[1] / 2)
        return _put(covered, row, column, z, inside, height, width)

    covered = lax.fori_loop(0, reach**2, cover, jnp.full(height * width, far))
    wins = ~jnp.isfinite(surface) | (covered < surface * (1 - jump))
    image = jnp.where(wins, covered, surface).reshape(height, width)
    return jnp.where(jnp.isfinite(image), image, 0)


def _corner(x, y, inverse, there, down, right):
    cut = lambda image: image[down : image.shape[0] - 1 + down, right : image.shape[1] - 1 + right]
    return cut(x), cut(y), cut(inverse), cut(there)


def _draw(surface, corners, height, width, jump, reach):
    """Both triangles of every cell, one pixel of the cell's box after the other."""
    upper_left, upper_right, lower_left, lower_right = corners
    triangles = [
        _triangle(upper_left, upper_right, lower_left, jump),
        _triangle(lower_right, lower_left, upper_right, jump),
    ]
    least = lambda axis: reduce(jnp.minimum, [jnp.where(corner[3], corner[axis], 1e6) for corner in corners])
    first_x, first_y = jnp.ceil(least(0) - _SLACK), jnp.ceil(least(1) - _SLACK)

    def draw(step, surface):
        column, row = first_x + step % reach, first_y + step // reach
        (depth, inside), (other, beside) = (look(column, row) for look in triangles)
        return _put(surface, row, column, jnp.where(inside, depth, other), inside | beside, height, width)

    return lax.fori_loop(0, reach**2, draw, surface)


def _triangle(first, second, third, jump):
    """From a pixel to the triangle's depth there, and whether it is inside."""
    (x0, y0, q0, there0), (x1, y1, q1, there1), (x2, y2, q2, there2) = first, second, third
    nearest, farthest = jnp.maximum(jnp.maximum(q0, q1), q2), jnp.minimum(jnp.minimum(q0, q1), q2)
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    whole = there0 & there1 & there2 & (nearest - farthest <= jump * nearest) & (jnp.abs(area) > 1e-4)
    per_area = 1 / jnp.where(whole, area, 1)

    def look(column, row):
        one = ((column - x0) * (y2 - y0) - (x2 - x0) * (row - y0)) * per_area
        two = ((x1 - x0) * (row - y0) - (column - x0) * (y1 - y0)) * per_area
        inside = whole & (one >= -_SLACK) & (two >= -_SLACK) & (one + two <= 1 + _SLACK)
        return 1 / jnp.where(inside, q0 + one * (q1 - q0) + two * (q2 - q0), 1), inside

    return look


def _put(image, row, column, depth, inside, height, width):
    inside &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
    place = jnp.where(inside, row * width + column, height * width).astype(jnp.int32)
    return image.at[place.ravel()].min(depth.ravel(), mode="drop")
