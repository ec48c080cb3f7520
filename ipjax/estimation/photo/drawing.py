"""The query's measured surface as other cameras see it: to be compared with the photo, or matched with it.

Its depth was measured, so what it looks like from elsewhere is known wherever it was seen: drawn into the photo's
camera from a candidate pose, it shows whether the pose is right; drawn from beside, it is seen as a photo from there
would show it.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from ipjax_kernels.rasterize import splat_colours
from jax import lax
from jaxtyping import Array, Bool, Float

from ipjax.cameras import point_map
from ipjax.config import ResectConfig
from ipjax.estimation.features import object_features
from ipjax.estimation.photo.resection import Look, Sight, grid_normals, rays_of
from ipjax.estimation.scoring import chroma_correlation
from ipjax.records import Camera, Patches, Query, ReferenceView, Templates
from ipjax.transforms import rotation_from_vector

BEHIND = 0.3  # of the query's extent: from its measured front to about the middle of the object
RIM = 0.009  # of the crop's width: so near to the mask's rim no depth is believed
MARGIN = 0.018  # of the image's side: so far outside the outline still counts as inside
FILLED = 2  # pixels from the rim of a hole that are filled


def splat_query(
    reference: ReferenceView,
    query: Query,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    sight: Sight,
) -> tuple[Float[Array, "h w 6"], Float[Array, "h w"]]:
    """The query's measured surface as the photo's camera would see it: colour and place (metres, the query's camera) of
    each pixel, and its depth in the photo's camera (metres, 0 = nothing)."""
    return _splat(reference.view.camera, reference.view.mask.shape, query, rotation, translation, sight)


def _splat(
    lens: Camera,
    size: tuple[int, ...],
    query: Query,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    sight: Sight,
) -> tuple[Float[Array, "h w 6"], Float[Array, "h w"]]:
    """As `splat_query`, in any camera, of (height, width)."""
    view = query.view
    points = point_map(view.camera, view.depth).reshape(-1, 3)
    placed = jnp.einsum("ij,nj->ni", rotation, points, precision="highest") + translation
    measured = measured_surface(query).reshape(-1)
    paint = jnp.concatenate([view.rgb.reshape(-1, 3), points, jnp.ones_like(points[:, :1])], axis=-1)
    image, depth = splat_colours(placed, paint, measured, lens.focal, lens.centre, *size, 0.05 * sight.query_extent)
    # On a steep surface a pixel may have a depth from beside and no point of its own, and so neither colour nor place.
    painted = image[..., -1] > 0.5
    image, depth = jnp.where(painted[..., None], image[..., :-1], 0), jnp.where(painted, depth, 0)
    for _ in range(FILLED):
        image, depth = _fill_holes(image, depth)
    return image, depth


def measured_surface(query: Query) -> Bool[Array, "h w"]:
    """The pixels whose depth is the object's: at the mask's rim it is often that of what lies behind."""
    return ~_near(~query.view.mask, RIM) & (query.view.depth > 0)


def _near(mask: Bool[Array, "h w"], share: float) -> Bool[Array, "h w"]:
    """The mask and all within a share of the image's width of it, at least a pixel."""
    side = 2 * max(1, round(share * mask.shape[1])) + 1
    return lax.reduce_window(mask, False, lax.bitwise_or, (side, side), (1, 1), "SAME")


def _fill_holes(image: Float[Array, "h w c"], depth: Float[Array, "h w"]) -> tuple[Array, Array]:
    """Pixels between points, which lie apart where the query saw the surface at a flat angle: their neighbours' mean.

    Only where at least half of the neighbours are drawn, so that an outline does not grow.
    """
    height, width = depth.shape
    known = depth > 0
    every = jnp.concatenate(
        [jnp.where(known[..., None], image, 0), depth[..., None], known[..., None].astype(depth.dtype)], axis=-1
    )
    every = jnp.pad(every, ((1, 1), (1, 1), (0, 0)))
    around = functools.reduce(jnp.add, [every[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    count = around[..., -1]
    filled = around[..., :-1] / jnp.maximum(count, 1)[..., None]
    hole = ~known & (count >= 4)
    return jnp.where(hole[..., None], filled[..., :-1], image), jnp.where(hole, filled[..., -1], depth)


class _Described(eqx.Module):
    """A drawing of the query, patch by patch."""

    features: Float[Array, "p c"]  # centred as the templates' are
    points: Float[Array, "p 3"]  # mean place of what is drawn there: metres, the query's camera
    colours: Float[Array, "p 3"]  # mean of what is drawn there
    cover: Float[Array, " p"]  # share of the patch that is drawn
    grid: tuple[int, int] = eqx.field(static=True)  # rows and columns of patches


def _describe(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    image: Float[Array, "h w 6"],
    depth: Float[Array, "h w"],
) -> _Described:
    """What the encoder makes of a drawing as `splat_query` returns it."""
    shown = depth > 0
    image = jnp.where(shown[..., None], image, 0)
    features = object_features(encoder(image[..., :3]), templates)
    rows, columns, channels = features.shape
    cover = _patch_means(shown.astype(depth.dtype), rows, columns)[:, 0]
    means = _patch_means(image, rows, columns) / jnp.maximum(cover, 1e-6)[:, None]
    return _Described(features.reshape(-1, channels), means[:, 3:], means[:, :3], cover, (rows, columns))


def _patch_means(image: Float[Array, "h w *c"], rows: int, columns: int) -> Float[Array, "p c"]:
    """The mean of each patch."""
    height, width = image.shape[:2]
    parts = image.reshape(rows, height // rows, columns, width // columns, -1)
    return jnp.mean(parts, axis=(1, 3)).reshape(rows * columns, -1)


def look_from_beside(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    sight: Sight,
    config: ResectConfig,
) -> Look:
    """The query's measured surface drawn and described from ``config.beside`` directions around its own: leading axis.

    Each is turned by ``config.tilt`` about the surface's middle. Surface that the photo shows from the front, and the
    query at a flat angle, looks alike from one of them.
    """
    reference = templates.reference
    assert reference is not None
    view, dtype = query.view, query.view.depth.dtype
    points = point_map(view.camera, view.depth)
    measured = measured_surface(query).astype(dtype)[..., None]
    front = jnp.sum(points * measured, axis=(0, 1)) / jnp.maximum(jnp.sum(measured), 1)
    ahead = front / jnp.maximum(root(jnp.sum(front**2)), 1e-9)
    ahead = jnp.where(jnp.any(measured > 0), ahead, jnp.array([0, 0, 1], dtype))
    middle = front + BEHIND * sight.query_extent * ahead
    right = jnp.cross(jnp.array([0, 1, 0], dtype), ahead)
    right = right / jnp.maximum(root(jnp.sum(right**2)), 1e-9)
    towards = jnp.stack([right, jnp.cross(ahead, right), ahead])
    angle = 2 * jnp.pi * jnp.arange(config.beside, dtype=dtype) / config.beside
    turns = rotation_from_vector(config.tilt * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=-1))
    distance = sight.query_extent / sight.extent
    size, (height, width) = view.depth.shape, reference.view.mask.shape
    zoom = jnp.array([size[1] / width, size[0] / height], dtype)
    photo = reference.view.camera
    lens = Camera(photo.focal * zoom, (photo.centre + 0.5) * zoom - 0.5)

    def look(turn):
        rotation = jnp.matmul(turn, towards, precision="highest")
        translation = jnp.zeros(3, dtype).at[2].set(distance) - jnp.matmul(rotation, middle, precision="highest")
        drawn = _describe(encoder, templates, *_splat(lens, size, query, rotation, translation, sight))
        (rows, columns), where, valid = drawn.grid, drawn.points, drawn.cover > config.cover
        normals = grid_normals(where.reshape(rows, columns, 3), valid.reshape(rows, columns))
        grid = jnp.asarray(np.indices((rows, columns))[::-1].reshape(2, -1).T, dtype)
        patches = Patches(drawn.features, where, grid, valid, query.patches.encoder)
        return Look(patches, normals.reshape(-1, 3))

    return lax.map(look, turns)


def contained_share(
    reference: ReferenceView, query: Query, rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
) -> Float[Array, ""]:
    """Share of the query's measured points that the photo's camera sees within the object's outline, or next to it.

    Whatever the query shows is part of the object, and so lies behind the outline from wherever it is seen.
    """
    mask, lens = reference.view.mask, reference.view.camera
    height, width = mask.shape
    wide = _near(mask, MARGIN)
    placed = jnp.einsum("ij,hwj->hwi", rotation, point_map(query.view.camera, query.view.depth), precision="highest")
    placed = placed + translation
    ahead = placed[..., 2] > 1e-6
    pixel = lens.focal * placed[..., :2] / jnp.where(ahead, placed[..., 2], 1)[..., None] + lens.centre
    column, row = jnp.moveaxis(jnp.round(jnp.clip(pixel, -1e6, 1e6)).astype(jnp.int32), -1, 0)
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height) & ahead
    within = within & wide[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
    measured = measured_surface(query)
    count = lambda x: jnp.sum(x, dtype=lens.focal.dtype)
    return count(measured & within) / jnp.maximum(count(measured), 1)


class Drawing(eqx.Module):
    """The query as the photo's camera sees it from a candidate pose, compared with the photo."""

    overlap: Float[Array, "*b"]  # mean cosine of the patches that both cover
    contained: Float[Array, "*b"]  # share of the query's points, hidden ones too, within the photo's outline
    colour: Float[Array, "*b"]  # correlation of their colours, in [-1, 1]
    shared: Float[Array, "*b"]  # share of the photo's outline that both cover
    points: Float[Array, "*b p 3"]  # of the query, metres, behind each patch of the photo
    rays: Float[Array, "*b p 2"]  # where the photo shows what the drawing shows in that patch
    weight: Float[Array, "*b p"]
    depth: Float[Array, "*b h w"]  # metres


def draw_query(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    sight: Sight,
    config: ResectConfig,
) -> Drawing:
    """The query's measured, coloured surface drawn into the photo's camera, described, and matched nearby."""
    reference = templates.reference
    assert reference is not None
    image, depth = splat_query(reference, query, rotation, translation, sight)
    drawn = _describe(encoder, templates, image, depth)
    (rows, columns), features, cover = drawn.grid, drawn.features, drawn.cover
    mean = lambda x: _patch_means(x, rows, columns)
    outline = mean(reference.view.mask.astype(depth.dtype))[:, 0]
    photo = jnp.where(reference.patches.valid[:, None], reference.patches.features, 0).astype(features.dtype)
    cosine = jnp.sum(features * photo, axis=-1)
    shared = jnp.where(reference.patches.valid, jnp.minimum(cover, outline), 0)
    overlap = jnp.sum(cosine * shared) / jnp.maximum(jnp.sum(shared), 1e-6)
    # Nearby, every patch of the photo is compared, and the place is the mean of those that are most alike.
    grid = np.indices((rows, columns)).reshape(2, -1)
    apart = jnp.asarray(np.abs(grid[:, :, None] - grid[:, None]).max(axis=0), depth.dtype)
    alike = jnp.matmul(features, photo.T, precision="highest")
    alike = jnp.where((apart <= config.window) & reference.patches.valid[None], alike, -jnp.inf)
    best = jnp.max(alike, axis=1)
    found = jnp.isfinite(best)
    pull = jnp.where(jnp.isfinite(alike), jnp.exp((alike - jnp.where(found, best, 0)[:, None]) / config.softness), 0)
    pull = pull / jnp.maximum(jnp.sum(pull, axis=1, keepdims=True), 1)  # the best counts 1
    rays = jnp.matmul(pull, rays_of(reference, reference.patches.points), precision="highest")
    weight = jnp.where(found & (cover > config.cover), jnp.maximum(best, 0), 0)
    photo_colour = jnp.where(reference.view.mask[..., None], reference.view.rgb, 0)
    photo_colour = mean(photo_colour) / jnp.maximum(outline, 1e-6)[:, None]
    return Drawing(
        overlap=jnp.clip(overlap, 0, 1),
        contained=contained_share(reference, query, rotation, translation),
        colour=chroma_correlation(drawn.colours, photo_colour, shared),
        shared=jnp.sum(shared) / jnp.maximum(jnp.sum(outline), 1e-6),
        points=drawn.points,
        rays=rays,
        weight=weight,
        depth=depth,
    )
