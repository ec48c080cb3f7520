"""Z-buffers of points and of triangles, in bounded memory and without shapes that depend on the data.

Pixel centres are integers: pixel (column, row) looks along
((column − centre_x) / focal_x, (row − centre_y) / focal_y, 1).
Depth is along z in the units of the points, and 0 where nothing is.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

# A pixel this close to an edge (in pixels) belongs to both faces, so that rounding leaves no cracks between them.
_SLACK = 1e-4


@functools.partial(jax.jit, static_argnames=("height", "width", "radius"))
def splat_depth(
    points: Float[Array, "n 3"],
    valid: Bool[Array, " n"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
    radius: int = 1,
) -> Float[Array, "h w"]:
    """Depth image of points in the camera frame; each covers a square of 2 · radius + 1 pixels, the nearest wins.

    Points that are not valid, behind the camera or not finite are absent. Vmap over leading axes. Memory: one padded
    image; time: n scatters and 4 · radius image minima.
    """
    rows, columns = height + 2 * radius, width + 2 * radius
    place = _pixels(points, valid, focal, centre + radius, rows, columns)
    far = jnp.asarray(jnp.inf, points.dtype)
    image = jnp.full(rows * columns, far).at[place].min(points[:, 2], mode="drop").reshape(rows, columns)
    # A square splat is a minimum filter of the image of single points, and the filter is separable.
    image = functools.reduce(jnp.minimum, [image[i : i + height] for i in range(2 * radius + 1)])
    image = functools.reduce(jnp.minimum, [image[:, i : i + width] for i in range(2 * radius + 1)])
    return jnp.where(jnp.isfinite(image), image, 0)


@functools.partial(jax.jit, static_argnames=("height", "width"))
def splat_colours(
    points: Float[Array, "n 3"],
    colours: Float[Array, "n c"],
    valid: Bool[Array, " n"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
    behind: Float[Array, ""] | float,
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Image and depth of coloured points in the camera frame; black and 0 where nothing is.

    A pixel has the mean colour of its points that lie at most `behind` behind the nearest one in a 3 × 3 square; a
    pixel without any, the mean of its neighbours'. Meant for several points per pixel. Colours are any numbers that are
    to be averaged so. Otherwise as `splat_depth`.
    """
    depth = splat_depth(points, valid, focal, centre, height, width)
    place = _pixels(points, valid, focal, centre, height, width)
    nearest = depth.reshape(-1).at[place].get(mode="fill", fill_value=-jnp.inf)
    shown = jnp.where(points[:, 2] <= nearest + behind, place, height * width)
    paint = jnp.concatenate([colours, jnp.ones_like(colours[:, :1])], axis=-1)
    sums = jnp.zeros((height * width, paint.shape[1]), colours.dtype).at[shown].add(paint, mode="drop")
    sums = sums.reshape(height, width, -1)
    padded = jnp.pad(sums, ((1, 1), (1, 1), (0, 0)))
    around = sum(padded[i : i + height, j : j + width] for i in range(3) for j in range(3))
    chosen = jnp.where(sums[..., -1:] > 0, sums, around)
    image = chosen[..., :-1] / jnp.maximum(chosen[..., -1:], 1)
    return jnp.where((depth > 0)[..., None], image, 0), depth


def _pixels(
    points: Float[Array, "n 3"],
    valid: Bool[Array, " n"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
) -> Int[Array, " n"]:
    """The index, row by row, of the pixel that each point is seen in; height · width for one that is not seen."""
    z = points[:, 2]
    ahead = valid & (z > 0) & jnp.all(jnp.isfinite(points), axis=-1)
    pixel = focal * points[:, :2] / jnp.where(ahead, z, 1)[:, None] + centre
    column, row = jnp.round(jnp.where(ahead[:, None], jnp.clip(pixel, -1e6, 1e6), -1e6)).astype(jnp.int32).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return jnp.where(inside, row * width + column, height * width)


@functools.partial(jax.jit, static_argnames=("height", "width", "tile", "block"))
def rasterize(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "m 3"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    height: int,
    width: int,
    *,
    near: Float[Array, ""] | float = 1e-6,
    tile: int = 4,
    block: int = 4096,
) -> tuple[Float[Array, "h w"], Int[Array, "h w"], Float[Array, "h w 3"]]:
    """What a camera sees of triangles whose vertices are in the camera frame.

    Returns depth along z (exact perspective; 0 = nothing), the index of the nearest face (−1 = nothing; the lower
    index where depths tie), and the barycentric weights of the surface point in it. Both sides of a face are seen. A
    face with a vertex nearer than `near` is left out whole.

    Every face's box of pixels is cut into squares of `tile` pixels; `block` squares are drawn at a time, as often as
    it takes. Memory: O(n + m + height · width + block · tile²), time: O(m + squares · tile²). Squares are counted in
    int32: more than 2³¹ of them (a million faces that each fill the image) are not drawn right.
    """
    # Relative to the principal point, where float32 is finest.
    depth = vertices[:, 2]
    usable = (depth > near) & jnp.all(jnp.isfinite(vertices), axis=-1)
    safe = jnp.where(usable, depth, 1)
    screen = jnp.where(usable[:, None], focal * vertices[:, :2] / safe[:, None], 0)
    corners = screen[faces]  # m 3 2
    low = jnp.ceil(jnp.min(corners, axis=1) + centre - _SLACK)
    high = jnp.floor(jnp.max(corners, axis=1) + centre + _SLACK)
    limit = jnp.asarray([width - 1, height - 1], screen.dtype)
    first = jnp.clip(low, 0, limit + 1).astype(jnp.int32)
    last = jnp.clip(high, -1, limit).astype(jnp.int32)
    squares = jnp.maximum(last - first + tile, 0) // tile  # m 2: columns, rows
    drawn = jnp.all(usable[faces], axis=1)
    ends = jnp.cumsum(jnp.where(drawn, squares[:, 0] * squares[:, 1], 0), dtype=jnp.int32)
    inverse = jnp.where(usable, 1 / safe, 1)[faces]  # m 3

    offset = jnp.arange(tile, dtype=jnp.int32)
    offset_x, offset_y = jnp.tile(offset, tile), jnp.repeat(offset, tile)
    no_face = jnp.asarray(faces.shape[0], jnp.int32)
    empty = (
        jnp.asarray(0, jnp.int32),
        jnp.full(height * width, jnp.asarray(0, screen.dtype)),  # inverse depth: the largest wins
        jnp.full(height * width, no_face),
    )

    def unfinished(state):
        return state[0] < ends[-1]

    def draw(state):
        start, nearest, owner = state
        square = start + jnp.arange(block, dtype=jnp.int32)
        face = jnp.minimum(jnp.searchsorted(ends, square, side="right"), no_face - 1).astype(jnp.int32)
        count = squares[face]
        rest = square - (ends[face] - count[:, 0] * count[:, 1])
        across = jnp.maximum(count[:, 0], 1)
        column = (first[face, 0] + rest % across * tile)[:, None] + offset_x  # block tile²
        row = (first[face, 1] + rest // across * tile)[:, None] + offset_y
        weights, hit = _barycentric(corners[face][:, None], column, row, centre)
        value = jnp.sum(weights * inverse[face][:, None], axis=-1)
        hit &= (column <= last[face, 0][:, None]) & (row <= last[face, 1][:, None])
        hit &= (square < ends[-1])[:, None]
        place = jnp.where(hit, row * width + column, height * width).reshape(-1)
        value = value.reshape(-1)
        closer = nearest.at[place].max(value, mode="drop")
        owner = jnp.where(closer > nearest, no_face, owner)  # beaten by this block
        wins = closer.at[place].get(mode="fill", fill_value=jnp.inf) == value
        index = jnp.broadcast_to(face[:, None], hit.shape).reshape(-1)
        owner = owner.at[jnp.where(wins, place, height * width)].min(index, mode="drop")
        return start + block, closer, owner

    if faces.shape[0] == 0:
        _, nearest, owner = empty
    else:
        _, nearest, owner = lax.while_loop(unfinished, draw, empty)
    seen = owner < no_face
    face = jnp.where(seen, owner, 0)
    row, column = jnp.divmod(jnp.arange(height * width, dtype=jnp.int32), width)
    if faces.shape[0] == 0:
        weights = jnp.zeros((height * width, 3), screen.dtype)
    else:
        weights, _ = _barycentric(corners[face], column, row, centre)
        # Screen weights become weights of the surface point: each counts by its inverse depth.
        weights = weights * inverse[face]
        weights = weights / jnp.sum(weights, axis=-1, keepdims=True)
    image = jnp.where(seen, 1 / jnp.where(seen, nearest, 1), 0)
    return (
        image.reshape(height, width),
        jnp.where(seen, owner, -1).reshape(height, width),
        jnp.where(seen[:, None], weights, 0).reshape(height, width, 3),
    )


def _barycentric(
    corners: Float[Array, "*b 3 2"], column: Int[Array, "*c"], row: Int[Array, "*c"], centre: Float[Array, "2"]
) -> tuple[Float[Array, "*c 3"], Bool[Array, "*c"]]:
    """Screen weights of pixels in triangles (clamped to them), and whether the pixel's centre is inside."""
    x = column.astype(corners.dtype) - centre[0] - corners[..., 0, 0]
    y = row.astype(corners.dtype) - centre[1] - corners[..., 0, 1]
    one, two = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    area = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
    sign = jnp.where(area < 0, -1, 1).astype(corners.dtype)
    area = jnp.abs(area)
    w1 = (x * two[..., 1] - y * two[..., 0]) * sign
    w2 = (one[..., 0] * y - one[..., 1] * x) * sign
    w0 = area - w1 - w2
    hit = (
        (area > 0)
        & (w1 >= -_SLACK * _length(two))
        & (w2 >= -_SLACK * _length(one))
        & (w0 >= -_SLACK * _length(two - one))
    )
    weights = jnp.clip(jnp.stack([w0, w1, w2], axis=-1), 0, None)
    total = jnp.sum(weights, axis=-1, keepdims=True)
    return weights / jnp.where(total > 0, total, 1), hit


def _length(vectors: Float[Array, "*b 2"]) -> Float[Array, "*b"]:
    return jnp.sqrt(jnp.sum(vectors * vectors, axis=-1))
