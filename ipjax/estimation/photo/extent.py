"""How large the object is that one photo without depth showed: its guessed surface, and what the query measured of it.

Across the photo's rays the guess is right, along them it is not. What both the photo and the query show is moved along
its ray to where it was measured, and whatever the query measured belongs to the object, be it in the guess or not.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from jax import lax
from jaxtyping import Array, Bool, Float

from ipjax.cameras import point_map
from ipjax.estimation.photo.drawing import MARGIN, RIM, measured_surface
from ipjax.records import Query, ReferenceView, Similarity, Surface

FARTHEST = 0.35  # diameters between guess and measurement, beyond which it was something else that was measured
OUTLIER = 0.05  # diameters from the median of its neighbours, beyond which a measurement is left out
WINDOW = 2  # pixels on each side that are its neighbours
REACH = 1.0  # diameters from the guessed centre, beyond which along the ray nothing counts as the object
STEP = 2  # of the query's pixels every such one is looked at
EXACT = 0.01  # standard deviation of a diameter of which both ends were measured, a share of it
DIRECTIONS = 128  # along which the object's ends are sought


class Extent(eqx.Module):
    """Size and box of the object, and how far the size may be off for what of it is guessed."""

    diameter: Float[Array, ""]  # metres
    variance: Float[Array, ""]  # of it, metres²
    box: Float[Array, "2 3"]  # lowest and highest corner, along the object's axes, model units


def measure_extent(
    reference: ReferenceView,
    surface: Surface,
    query: Query,
    camera_from_query: Similarity,
    unit: Float[Array, ""],
    behind: Float[Array, ""],
    depth: Float[Array, "h w"],
    unit_std: Float[Array, ""],
    share: float | Float[Array, ""],
) -> Extent:
    """The guessed surface at its size, corrected along the photo's rays where the query measured it, with the rest of
    what the query measured.

    How much farther the back reaches than guessed is one normal number, of ``share`` the deviation that each of its
    points has. With D the diameter, and D + dᵢ what it is with the back by xᵢ deviations farther away, Gauss and
    Hermite's rule of five such xᵢ and their weights wᵢ gives the mean square by which the true one differs from it,

        variance = Σ wᵢ dᵢ² + (ε e)² + (``EXACT`` D)².

    So what is guessed counts for nothing where the ends of the diameter were measured and no guess reaches beyond
    them, and most where the diameter lies along the photo's ray. ε is the unit's relative deviation, and e how far the
    ends of the diameter move apart with it: those that are guessed, by their distance from the photo's axis.

    Args:
      reference: the photo; its depth is a guess.
      surface: guessed; without ``along_std`` it counts as exact.
      camera_from_query: the photo's camera, metres; scale 1.
      unit: metres of a model unit.
      behind: metres by which the object is moved away from the photo's camera.
      depth: of the query drawn into the photo's camera, metres, 0 = nothing.
      unit_std: relative standard deviation of the unit.
      share: of the deviation of single points, by which the whole back may be off beyond what the query tells of it.
    """
    pose, camera = reference.camera_from_object, reference.view.camera
    placed = jnp.matmul(surface.points, pose.rotation.T, precision="highest") + pose.translation
    rays = placed / jnp.maximum(placed[:, 2:], 1e-6)
    measured, known = _look_up(depth, reference.view.mask, camera.focal * rays[:, :2] + camera.centre, OUTLIER * unit)
    ahead = jnp.zeros(3, placed.dtype).at[2].set(behind)
    guess = unit * placed + ahead
    known = known & (surface.seen > 0.5) & (jnp.abs(measured - guess[:, 2]) < FARTHEST * unit)
    guess = jnp.where(known[:, None], measured[:, None] * rays, guess)
    centre = unit * pose.translation + ahead
    own, used = _query_points(reference, query, camera_from_query, centre, REACH * unit)
    own = jnp.where(used[:, None], own, guess[:1])

    along = jnp.zeros_like(measured) if surface.along_std is None else unit * surface.along_std
    back = share * jnp.where(surface.seen > 0.5, 0, along)[:, None] * rays
    ends = _ends(own)
    spread = lambda points: _farthest(_ends(points), ends)
    first, second, length = spread(guess)
    places, weights = np.polynomial.hermite_e.hermegauss(5)
    added = jnp.stack([spread(guess + float(place) * back)[2] - length for place in places])
    weights = jnp.asarray(weights / weights.sum(), added.dtype)
    variance = jnp.sum(weights * added**2)
    # Which of the two ends are guessed, and how far a change of the unit moves them apart.
    every, loose = jnp.concatenate([guess, own]), jnp.concatenate([~known, jnp.zeros_like(used)])
    lever = lambda index: jnp.where(loose[index], every[index] - centre, 0)
    apart = jnp.sum((lever(first) - lever(second)) * (every[first] - every[second])) / jnp.maximum(length, 1e-9)
    inside = jnp.matmul((every - ahead) / unit - pose.translation, pose.rotation, precision="highest")
    box = jnp.stack([jnp.min(inside, axis=0), jnp.max(inside, axis=0)])
    return Extent(length, variance + (unit_std * apart) ** 2 + (EXACT * length) ** 2, box)


def _query_points(
    reference: ReferenceView,
    query: Query,
    camera_from_query: Similarity,
    centre: Float[Array, "3"],
    reach: Float[Array, ""],
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """The query's measured surface in the photo's camera, metres, and which of it can be the object's.

    Depth is averaged over what was measured around each pixel, which the mask's rim has none of its own of. What the
    photo's outline does not cover, or lies far from the object along the ray, is not the object's.
    """
    view, camera = query.view, reference.view.camera
    near = max(1, round(RIM * view.mask.shape[1]))
    known = measured_surface(query).astype(view.depth.dtype)
    window = (2 * near + 1, 2 * near + 1)
    add = lambda x: lax.reduce_window(x, np.zeros((), x.dtype), lax.add, window, (1, 1), "SAME")
    count = add(known)
    mean = add(known * view.depth) / jnp.maximum(count, 1)
    points = camera_from_query @ point_map(view.camera, mean)[::STEP, ::STEP].reshape(-1, 3)
    used = ((count > 0) & view.mask)[::STEP, ::STEP].reshape(-1)
    height, width = reference.view.mask.shape
    ahead = points[:, 2] > 1e-6
    pixel = camera.focal * points[:, :2] / jnp.where(ahead, points[:, 2], 1)[:, None] + camera.centre
    column, row = jnp.moveaxis(jnp.round(jnp.clip(pixel, -1e6, 1e6)).astype(jnp.int32), -1, 0)
    side = 2 * max(1, round(MARGIN * width)) + 1
    wide = lax.reduce_window(reference.view.mask, False, lax.bitwise_or, (side, side), (1, 1), "SAME")
    covered = (column >= 0) & (column < width) & (row >= 0) & (row < height) & ahead
    covered = covered & wide[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
    return points, used & covered & (jnp.abs(points[:, 2] - centre[2]) < reach)


def _look_up(
    depth: Float[Array, "h w"], mask: Bool[Array, "h w"], pixels: Float[Array, "n 2"], most: Float[Array, ""]
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """The median of the depth about each pixel, and whether it is known there and within ``most`` of that pixel's."""
    height, width = depth.shape
    shifts = np.mgrid[-WINDOW : WINDOW + 1, -WINDOW : WINDOW + 1].reshape(2, -1).T[:, ::-1].astype(np.int32)
    at = jnp.round(jnp.clip(pixels, -1e6, 1e6)).astype(jnp.int32)
    column, row = jnp.moveaxis(at[:, None] + shifts, -1, 0)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
    around = depth[place]
    here = mask[place] & inside & (around > 0)
    count = jnp.sum(here, axis=1, dtype=jnp.int32)
    ordered = jnp.sort(jnp.where(here, around, jnp.inf), axis=1)
    median = jnp.take_along_axis(ordered, (jnp.maximum(count, 1) - 1)[:, None] // 2, axis=1)[:, 0]
    middle = shifts.shape[0] // 2
    known = here[:, middle] & (count > middle) & (jnp.abs(around[:, middle] - median) < most)
    return jnp.where(known, median, 0), known


class _Ends(eqx.Module):
    """The points at both ends along each of ``DIRECTIONS`` directions: places along it, indices, points."""

    reach: Float[Array, "2 d"]  # how far each end lies outwards
    index: Array  # 2 d
    point: Float[Array, "2 d 3"]
    count: int = eqx.field(static=True)


def _ends(points: Float[Array, "n 3"]) -> _Ends:
    number = np.arange(DIRECTIONS)
    height, angle = 1 - (number + 0.5) / DIRECTIONS, np.pi * (1 + 5**0.5) * number  # evenly over half a sphere
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)
    along = jnp.matmul(points, jnp.asarray(directions.T, points.dtype), precision="highest")
    index = jnp.stack([jnp.argmin(along, axis=0), jnp.argmax(along, axis=0)])
    return _Ends(jnp.stack([-jnp.min(along, axis=0), jnp.max(along, axis=0)]), index, points[index], points.shape[0])


def _farthest(one: _Ends, other: _Ends) -> tuple[Array, Array, Float[Array, ""]]:
    """Two points of two sets that lie farthest apart, and their distance, to about half a percent; indices of the
    second set follow those of the first."""
    outer = other.reach > one.reach
    index = jnp.where(outer, other.index + one.count, one.index)
    point = jnp.where(outer[..., None], other.point, one.point)
    squared = jnp.sum((point[0] - point[1]) ** 2, axis=-1)
    best = jnp.argmax(squared)
    return index[0, best], index[1, best], root(squared[best])


def centre_std(surface: Surface, default: Float[Array, ""] | float) -> Float[Array, ""]:
    """How far the object's centre may be from where its guessed front says, along the photo's ray, model units.

    It lies midway between the front, which is put where it was measured, and the back: half of what the back may be
    off (root mean square). ``default``: of a surface that does not say.
    """
    if surface.along_std is None:
        return jnp.asarray(default, surface.points.dtype)
    # Padding has no normals.
    hidden = jnp.where(jnp.any(surface.normals != 0, axis=-1), jnp.clip(1 - surface.seen, 0, 1), 0)
    total = jnp.sum(hidden)
    back = root(jnp.sum(hidden * surface.along_std**2) / jnp.where(total > 0, total, 1)) / 2
    return jnp.where(total > 0, back, default)
