"""The camera of a photo without depth, found among the query's measured points.

A match of a patch of the photo and a patch of the query is a ray of the photo's camera and a point in space, which
needs no depth in the photo: perspective-n-point, with the roles reversed. Minimal sets under weak perspective leave two
mirrored poses each; which is right, and which of all is best, the query drawn into the photo's camera tells.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.consensus import draw_minimal_sets
from ipjax_kernels.perspective import refine_resection, weak_perspective
from ipjax_kernels.positive import root
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.config import MatchConfig, ResectConfig
from ipjax.estimation.matching import match, select
from ipjax.estimation.residuals import Cloud
from ipjax.metrics.poses import turn_angle
from ipjax.records import Patches, Query, ReferenceView, Similarity, Templates


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


class Look(eqx.Module):
    """What was described of the query, as its own camera or another sees it: what is matched with the photo."""

    patches: Patches  # features centred as the templates' are; points in metres, the query's camera
    normals: Float[Array, "*b p 3"]  # of the surface in each patch, towards the query's camera; zero = unknown


class Sightings(eqx.Module):
    """Pairs of a look: points of the query, and where the photo's camera sees them."""

    ranking: Float[Array, "*b m"]  # of all views of the object
    points: Float[Array, "*b v k 3"]  # metres, the query's camera
    rays: Float[Array, "*b v k 2"]  # of the photo's camera
    normals: Float[Array, "*b v k 3"]  # zero = unknown
    weight: Float[Array, "*b v k"]  # 0 = absent


def match_photo(templates: Templates, look: Look, cycle: Float[Array, ""] | float, config: ResectConfig) -> Sightings:
    """The views of the object that look most like the query by what the photo showed, and their pairs.

    Args:
      cycle: the longest of a pair, patches.
    """
    reference = templates.reference
    assert reference is not None
    shown = templates.patches.valid & (templates.seen > 0.5)
    seen = eqx.tree_at(lambda t: t.patches.valid, templates, shown)
    matching = eqx.tree_at(lambda m: m.cycle, MatchConfig(views=config.views, pairs=config.pairs), cycle)
    matches = match(look.patches, seen, matching)
    pairs = select(matches, look.patches, templates, matching)
    rays = rays_of(reference, pairs.object)
    return Sightings(matches.ranking, pairs.camera, rays, look.normals[matches.query], pairs.weight)


def rays_of(reference: ReferenceView, points: Float[Array, "*k 3"]) -> Float[Array, "*k 2"]:
    """Where the photo's camera sees points of the object frame, as rays."""
    pose = reference.camera_from_object
    placed = jnp.sum(points[..., None, :] * pose.rotation, axis=-1) + pose.translation
    return placed[..., :2] / jnp.maximum(placed[..., 2:], 1e-6)


def patch_normals(cloud: Cloud, rows: int, columns: int) -> Float[Array, "p 3"]:
    """The surface's normals at the middle of each patch, towards the camera; zero where the depth does not tell."""
    normals = grid_normals(cloud.points, cloud.valid)
    side = cloud.valid.shape[0]
    at = lambda count: np.round((np.arange(count) + 0.5) * side / count - 0.5).astype(np.int32)
    return normals[at(rows)[:, None], at(columns)[None]].reshape(-1, 3)


def grid_normals(points: Float[Array, "h w 3"], known: Bool[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Normals towards the origin from each point's four neighbours; zero where one of the five is not known."""
    around, beside = jnp.pad(points, ((1, 1), (1, 1), (0, 0))), jnp.pad(known, 1)
    right, down = around[1:-1, 2:] - around[1:-1, :-2], around[2:, 1:-1] - around[:-2, 1:-1]
    normals = jnp.cross(down, right)
    whole = beside[1:-1, 2:] & beside[1:-1, :-2] & beside[2:, 1:-1] & beside[:-2, 1:-1] & known
    normals = jnp.where(jnp.sum(normals * points, axis=-1, keepdims=True) > 0, -normals, normals)
    normals = normals / jnp.maximum(root(jnp.sum(normals**2, axis=-1, keepdims=True)), 1e-12)
    return jnp.where(whole[..., None], normals, 0)


def resect(pairs: Sightings, sight: Sight, key: PRNGKeyArray, config: ResectConfig) -> Resections:
    """Candidates from the pairs of each view: minimal sets, the distinct best, refined on all pairs of their view."""
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

    keys = jax.random.split(key, pairs.rays.shape[0])
    found = jax.vmap(of_view)(keys, pairs.points, pairs.rays, pairs.normals, pairs.weight)
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
