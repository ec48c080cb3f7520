"""The camera of a photo without depth, found among the query's measured points.

A match of a patch of the photo and a patch of the query is a ray of the photo's camera and a point in space, which
needs no depth in the photo: perspective-n-point, with the roles reversed. Minimal sets under weak perspective leave two
mirrored poses each; which is right, and which of all is best, the query drawn into the photo's camera tells.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.consensus import draw_minimal_sets
from ipjax_kernels.perspective import refine_resection, weak_perspective
from ipjax_kernels.positive import root
from ipjax_kernels.rasterize import splat_colours
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.cameras import point_map
from ipjax.config import MatchConfig, ResectConfig
from ipjax.estimation.features import object_features
from ipjax.estimation.matching import match, select
from ipjax.estimation.residuals import Cloud
from ipjax.estimation.scoring import chroma_correlation
from ipjax.metrics.poses import turn_angle
from ipjax.records import Matches, Pairs, Query, ReferenceView, Similarity, Templates


class Resections(eqx.Module):
    """Candidate poses of the photo's camera, ``reference_from_query``, best first."""

    rotation: Float[Array, "h 3 3"]
    translation: Float[Array, "h 3"]  # metres
    support: Float[Array, "h"]  # agreement of the pairs, in [0, 1]; -1 = absent


class Sight(eqx.Module):
    """What the photo's camera sees of the object, in numbers that everything else is relative to."""

    diagonal: Float[Array, ""]  # of the outline's box, rays
    extent: Float[Array, ""]  # square root of the outline's area, rays
    query_extent: Float[Array, ""]  # square root of the area that the query shows, metres


def measure_sight(reference: ReferenceView, query: Query) -> Sight:
    """The sizes of the object in both views."""
    view, mask = reference.view, reference.view.mask
    span = lambda line: jnp.sum(jnp.any(mask, axis=line), dtype=view.depth.dtype)
    high, wide = span(1) / view.camera.focal[1], span(0) / view.camera.focal[0]
    area = jnp.sum(mask, dtype=view.depth.dtype) / (view.camera.focal[0] * view.camera.focal[1])
    lens = query.view.camera.focal
    depth = jnp.where(query.view.mask, query.view.depth, 0)
    shown = jnp.sum(depth**2) / (lens[0] * lens[1])
    return Sight(
        jnp.maximum(root(high**2 + wide**2), 1e-6), jnp.maximum(root(area), 1e-6), jnp.maximum(root(shown), 1e-6)
    )


def match_photo(
    templates: Templates, query: Query, cycle: Float[Array, ""] | float, config: ResectConfig
) -> tuple[Matches, Pairs]:
    """The views of the object that look most like the query by what the photo showed, and their pairs.

    Args:
      query: its patches centred on the templates' mean, as the templates' are.
      cycle: the longest of a pair, patches.
    """
    shown = templates.patches.valid & (templates.seen > 0.5)
    seen = eqx.tree_at(lambda t: t.patches.valid, templates, shown)
    matching = eqx.tree_at(lambda m: m.cycle, MatchConfig(views=config.views, pairs=config.pairs), cycle)
    matches = match(query.patches, seen, matching)
    return matches, select(matches, query.patches, templates, matching)


def rays_of(reference: ReferenceView, points: Float[Array, "*k 3"]) -> Float[Array, "*k 2"]:
    """Where the photo's camera sees points of the object frame, as rays."""
    pose = reference.camera_from_object
    placed = jnp.sum(points[..., None, :] * pose.rotation, axis=-1) + pose.translation
    return placed[..., :2] / jnp.maximum(placed[..., 2:], 1e-6)


def patch_normals(cloud: Cloud, rows: int, columns: int) -> Float[Array, "p 3"]:
    """The surface's normals at the middle of each patch, towards the camera; zero where the depth does not tell."""
    points = jnp.pad(cloud.points, ((1, 1), (1, 1), (0, 0)))
    known = jnp.pad(cloud.valid, 1)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normals = jnp.cross(down, right)
    whole = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1] & cloud.valid
    normals = jnp.where(jnp.sum(normals * cloud.points, axis=-1, keepdims=True) > 0, -normals, normals)
    normals = normals / jnp.maximum(root(jnp.sum(normals**2, axis=-1, keepdims=True)), 1e-12)
    normals = jnp.where(whole[..., None], normals, 0)
    side = cloud.valid.shape[0]
    at = lambda count: np.round((np.arange(count) + 0.5) * side / count - 0.5).astype(np.int32)
    return normals[at(rows)[:, None], at(columns)[None]].reshape(-1, 3)


def resect(
    pairs: Pairs,
    rays: Float[Array, "v k 2"],
    normals: Float[Array, "v k 3"],
    sight: Sight,
    key: PRNGKeyArray,
    config: ResectConfig,
) -> Resections:
    """Candidates from the pairs of each view: minimal sets, the distinct best, refined on all pairs of their view.

    Args:
      pairs: query points in metres; the object points are not used.
      rays: of the pairs, in the photo's camera.
      normals: of the query's surface at the pairs; zero = unknown.
    """
    threshold, width = config.threshold * sight.diagonal, config.width * sight.diagonal
    expected = sight.extent / sight.query_extent
    low, high = config.scale_gate

    def of_view(key, points, rays, normals, weight):
        table = draw_minimal_sets(key, weight, config.count, 3)
        total = jnp.sum(weight)
        total = jnp.where(total > 1e-9, total, 1)
        middle = jnp.sum(weight[:, None] * points, axis=0) / total
        centred = points - middle
        chosen = lambda x: jnp.moveaxis(x[table], 0, -1)  # corner, coordinate, set
        weak = jax.tree.map(lambda x: x.reshape(*x.shape[:-2], -1), weak_perspective(chosen(centred), chosen(rays)))
        fits = weak.success & (weak.scale > low * expected) & (weak.scale < high * expected)
        fits = fits & jnp.tile(jnp.all(weight[table] > 0, axis=1), 2)
        support = _weak_support(weak, centred, rays, normals, weight, threshold)
        support = jnp.where(fits, support, -1)
        best, present = _distinct(jnp.moveaxis(weak.rotation, -1, 0), support, config.keep, config.apart)
        take = lambda x: jnp.moveaxis(x, -1, 0)[best]
        rotation, offset, scale = take(weak.rotation), take(weak.offset), weak.scale[best]
        distance = 1 / jnp.maximum(scale, 1e-9)
        translation = jnp.concatenate([offset * distance[:, None], distance[:, None]], axis=1)
        # What is absent is some pose that can be drawn and differentiated.
        rotation = jnp.where(present[:, None, None], rotation, jnp.eye(3, dtype=rotation.dtype))
        translation = jnp.where(present[:, None], translation, jnp.stack([0 * expected, 0 * expected, 1 / expected]))
        translation = translation - jnp.sum(rotation * middle, axis=-1)
        fit = lambda turn, shift: refine_resection(turn, shift, points, rays, weight, width, steps=config.steps)
        found = jax.vmap(fit)(rotation, translation)
        facing = jnp.einsum("hij,kj->hki", found.rotation, normals, precision="highest")[..., 2] < 0.1
        agreed = jnp.sum(weight * jnp.where(facing, 1, 0), axis=1) / total
        support = (1 - found.loss) * agreed * total / weight.shape[0]
        return found.rotation, found.translation, jnp.where(present, support, -1)

    keys = jax.random.split(key, rays.shape[0])
    found = jax.vmap(of_view)(keys, pairs.camera, rays, normals, pairs.weight)
    rotation, translation, support = (x.reshape(-1, *x.shape[2:]) for x in found)
    best, present = _distinct(rotation, support, config.drawn, config.apart)
    return Resections(rotation[best], translation[best], jnp.where(present, support[best], -1))


def _weak_support(weak, points, rays, normals, weight, threshold):
    """Truncated quadratic support of each hypothesis by all pairs; surface that faces away gives none."""
    share = weight / jnp.maximum(jnp.sum(weight), 1e-9)
    part = 8
    padding = -share.shape[0] % part
    parts = [
        jnp.pad(x, ((0, padding), *[(0, 0)] * (x.ndim - 1))).reshape(-1, part, *x.shape[1:])
        for x in (points, rays, normals, share)
    ]
    inverse = 1 / threshold**2
    scaled = weak.scale * weak.rotation

    def add(total, part):
        for point, ray, normal, share in zip(*part, strict=True):
            squared = 0.0
            for row in range(2):
                moved = sum(scaled[row, column] * point[column] for column in range(3))
                squared = squared + (moved + (weak.offset[row] - ray[row])) ** 2
            away = sum(weak.rotation[2, column] * normal[column] for column in range(3)) > 0.1
            total = total + jnp.where(away, 0, share * jnp.maximum(0, 1 - squared * inverse))
        return total, None

    return lax.scan(add, jnp.zeros_like(weak.scale), tuple(parts))[0]


def _distinct(
    rotation: Float[Array, "n 3 3"], score: Float[Array, "n"], count: int, apart: float | Float[Array, ""]
) -> tuple[Array, Bool[Array, "k"]]:
    """Indices of the best poses, each turned from all better ones by more than ``apart``, and whether there are any."""

    def choose(rest, _):
        best = jnp.argmax(rest)
        trace = jnp.sum(rotation * rotation[best], axis=(-2, -1))
        return jnp.where(turn_angle(trace) < apart, -1, rest).at[best].set(-1), (best, rest[best] >= 0)

    return lax.scan(choose, score, None, length=count)[1]


class Drawing(eqx.Module):
    """The query as the photo's camera sees it from a candidate pose, compared with the photo."""

    overlap: Float[Array, "*b"]  # mean cosine of the patches that both cover
    colour: Float[Array, "*b"]  # correlation of their colours, in [-1, 1]
    shared: Float[Array, "*b"]  # share of the photo's outline that both cover
    points: Float[Array, "*b p 3"]  # of the query, metres, behind each patch of the photo
    rays: Float[Array, "*b p 2"]  # where the photo shows what the drawing shows in that patch
    weight: Float[Array, "*b p"]
    depth: Float[Array, "*b h w"]  # metres


def splat_query(
    reference: ReferenceView,
    query: Query,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    sight: Sight,
) -> tuple[Float[Array, "h w 6"], Float[Array, "h w"]]:
    """The query's measured surface as the photo's camera would see it: colour and place (metres, the query's camera) of
    each pixel, and its depth in the photo's camera (metres, 0 = nothing)."""
    view, lens = query.view, reference.view.camera
    points = point_map(view.camera, view.depth).reshape(-1, 3)
    placed = jnp.einsum("ij,nj->ni", rotation, points, precision="highest") + translation
    measured = (view.mask & (view.depth > 0)).reshape(-1)
    paint = jnp.concatenate([view.rgb.reshape(-1, 3), points], axis=-1)
    behind = 0.05 * sight.query_extent
    return splat_colours(placed, paint, measured, lens.focal, lens.centre, *reference.view.mask.shape, behind)


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
    height, width = reference.view.mask.shape
    image, depth = splat_query(reference, query, rotation, translation, sight)
    shown = depth > 0
    features = object_features(encoder(jnp.where(shown[..., None], image[..., :3], 0)), templates)
    rows, columns, channels = features.shape
    features = features.reshape(-1, channels)
    mean = lambda x: jnp.mean(x.reshape(rows, height // rows, columns, width // columns, -1), axis=(1, 3)).reshape(
        rows * columns, -1
    )
    cover = mean(shown.astype(depth.dtype))[:, 0]
    where = mean(jnp.where(shown[..., None], image[..., 3:], 0)) / jnp.maximum(cover, 1e-6)[:, None]
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
    drawn_colour = mean(jnp.where(shown[..., None], image[..., :3], 0)) / jnp.maximum(cover, 1e-6)[:, None]
    photo_colour = jnp.where(reference.view.mask[..., None], reference.view.rgb, 0)
    photo_colour = mean(photo_colour) / jnp.maximum(outline, 1e-6)[:, None]
    return Drawing(
        overlap=jnp.clip(overlap, 0, 1),
        colour=chroma_correlation(drawn_colour, photo_colour, shared),
        shared=jnp.sum(shared) / jnp.maximum(jnp.sum(outline), 1e-6),
        points=where,
        rays=rays,
        weight=weight,
        depth=depth,
    )


class Compared(eqx.Module):
    """The candidates after their drawings were compared with the photo, each with its best drawing."""

    rotation: Float[Array, "*b 3 3"]
    translation: Float[Array, "*b 3"]
    drawing: Drawing  # an overlap of -1 = absent


def compare_drawings(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    found: Resections,
    sight: Sight,
    config: ResectConfig,
) -> Compared:
    """Draw every candidate; then refine the ``config.polished`` best on what their drawings match, and draw them again,
    ``config.rounds`` times. Of each candidate the pose whose drawing overlaps best remains.

    One loop whose body draws one candidate: the encoder is compiled once.
    """
    count = found.support.shape[0]
    polished = min(config.polished, count)
    blank = jax.eval_shape(lambda turn, shift: draw_query(encoder, templates, query, turn, shift, sight, config),
                           found.rotation[0], found.translation[0])  # fmt: skip
    blank = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), blank)
    blank = eqx.tree_at(lambda d: d.overlap, blank, jnp.full(count, -1, blank.overlap.dtype))
    width = config.width * sight.diagonal

    def step(index, state):
        turns, shifts, first, best = state
        order = lax.top_k(first, polished)[1]
        one = jnp.where(index < count, index, order[(index - count) % polished])
        drawn = draw_query(encoder, templates, query, turns[one], shifts[one], sight, config)
        drawn = eqx.tree_at(lambda d: d.overlap, drawn, jnp.where(found.support[one] >= 0, drawn.overlap, -1))
        first = first.at[one].set(jnp.where(index < count, drawn.overlap, first[one]))
        here = Compared(turns[one], shifts[one], drawn)
        better = drawn.overlap > best.drawing.overlap[one]
        best = jax.tree.map(
            lambda all_of_them, new: all_of_them.at[one].set(jnp.where(better, new, all_of_them[one])), best, here
        )
        fit = refine_resection(
            turns[one], shifts[one], drawn.points, drawn.rays, drawn.weight, width, steps=config.steps
        )
        return turns.at[one].set(fit.rotation), shifts.at[one].set(fit.translation), first, best

    start = found.rotation, found.translation, blank.overlap, Compared(found.rotation, found.translation, blank)
    return lax.fori_loop(0, count + polished * config.rounds, step, start)[3]


def metres_per_unit(
    reference: ReferenceView, depth: Float[Array, "h w"]
) -> tuple[Float[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """The size of a model unit, the distance (model units) of the guessed front that it was found on, and whether any.

    Medians of the ratio of the measured depth in the photo's camera to the guessed one, where both are.
    """
    guess = reference.view.depth
    both = (depth > 0) & (guess > 0)
    last = jnp.maximum(jnp.sum(both, dtype=jnp.int32) - 1, 0) // 2
    median = lambda x: jnp.sort(jnp.where(both, x, jnp.inf).reshape(-1))[last]
    unit, front = median(depth / jnp.where(both, guess, 1)), median(guess)
    found = jnp.any(both)
    return jnp.where(found, unit, 1), jnp.where(found, front, 1), found


def query_from_object(
    reference: ReferenceView,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    unit: Float[Array, ""],
    behind: Float[Array, ""] | float = 0.0,
) -> Similarity:
    """The object's pose in the query's camera.

    Args:
      rotation, translation: the photo's camera from the query's, metres.
      unit: metres of a model unit.
      behind: metres that the object is moved away from the photo's camera.
    """
    photo = reference.camera_from_object
    ahead = jnp.zeros_like(translation).at[2].set(behind)
    turned = jnp.matmul(rotation.T, photo.rotation, precision="highest")
    shift = jnp.matmul(rotation.T, unit * photo.translation + ahead - translation, precision="highest")
    return Similarity(turned, shift, jnp.asarray(unit, translation.dtype))
