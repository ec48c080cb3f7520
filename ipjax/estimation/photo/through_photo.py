"""The pose of an object that one photo without depth showed: through the photo's camera, not through its guessed shape.

What was guessed enters where nothing else is known: the distance from the measured front to the object's centre, and
with it the size.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from ipjax_kernels.perspective import Resection, refine_resection
from ipjax_kernels.positive import invert_positive, root
from ipjax_kernels.rigid import carry
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.config import Config
from ipjax.estimation.confidence import find_rival, probability, rotation_ambiguity
from ipjax.estimation.features import object_features
from ipjax.estimation.photo.drawing import look_from_beside, splat_query
from ipjax.estimation.photo.extent import centre_std, measure_extent
from ipjax.estimation.photo.polishing import compare_drawings
from ipjax.estimation.photo.resection import (
    Look,
    match_photo,
    measure_sight,
    metres_per_unit,
    patch_normals,
    query_from_object,
    resect,
)
from ipjax.estimation.scene import SceneGrid
from ipjax.estimation.scoring import closeness, depth_agreement
from ipjax.records import Agreement, Hypotheses, PoseEstimate, Query, ReferenceView, Similarity, Templates

TIMES = 5.0  # by which a given size may differ from that of the guessed shape


def estimate_through_photo(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]] | None,
    templates: Templates,
    query: Query,
    usable: Bool[Array, ""],
    key: PRNGKeyArray,
    config: Config = Config(),
    diameter: Float[Array, ""] | None = None,
) -> PoseEstimate:
    """:func:`ipjax.estimate` of an object whose templates have a reference view.

    Args:
      encoder: with it the query is drawn into the photo's camera from each candidate, which refines and ranks them;
        without it they are ranked by how many pairs agree.
      usable: whether there is anything to estimate; without it there is no success.
    """
    reference, resection = templates.reference, config.resect
    assert reference is not None
    query = eqx.tree_at(lambda q: q.patches.features, query, object_features(query.patches.features, templates))
    sight = measure_sight(reference, query)
    with jax.named_scope("match"):
        scene = SceneGrid(query, config.score.resolution, config.refine.silhouette)
        side = round(query.patches.valid.shape[0] ** 0.5)
        looks = jax.tree.map(lambda x: x[None], Look(query.patches, patch_normals(scene.cloud, side, side)))
        if encoder is not None and resection.beside:
            beside = look_from_beside(encoder, templates, query, sight, resection)
            looks = jax.tree.map(lambda *x: jnp.concatenate(x), looks, beside)
        sightings = lax.map(lambda look: match_photo(templates, look, config.match.cycle, resection), looks)
        pairs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), sightings)
        # Patches of the query that match nothing show no object, whatever its depth looks like from elsewhere.
        usable = usable & _has_pairs(sightings.rays[0], sightings.weight[0])
    with jax.named_scope("resect"):
        found = resect(pairs, sight, key, resection)
    with jax.named_scope("draw"):
        if encoder is None:
            look = jax.vmap(lambda turn, shift: splat_query(reference, query, turn, shift, sight)[1])
            camera, depth = (found.rotation, found.translation), look(found.rotation, found.translation)
            # Each candidate is judged by the pairs of all views.
            pool = lambda x: x.reshape(-1, *x.shape[2:])
            every = lambda x: jnp.broadcast_to(pool(x), (found.support.shape[0], *pool(x).shape))
            points, where, weight = every(pairs.points), every(pairs.rays), every(pairs.weight)
            overlap = shared = jnp.ones_like(found.support)
            colour, score = jnp.zeros_like(found.support), found.support
        else:
            compared = compare_drawings(encoder, templates, query, found, sight, resection)
            camera, drawn = (compared.rotation, compared.translation), compared.drawing
            points, where, weight = drawn.points, drawn.rays, drawn.weight
            depth, overlap, score = drawn.depth, drawn.overlap * root(drawn.contained), compared.score
            colour, shared = drawn.colour, drawn.shared
        units, front, sized = jax.vmap(lambda one: metres_per_unit(reference, one))(depth)
        score = jnp.where(sized, score, -1)
        behind = jnp.zeros_like(units)
        if diameter is not None:
            # The front is where it was measured; of the given size, the rest is nearer or farther.
            behind = (units - diameter) * front
            # A guessed shape may be several times as long as the object is, but not any number of times.
            score = jnp.where((units < TIMES * diameter) & (diameter < TIMES * units), score, -1)
            units = jnp.full_like(units, diameter)
        poses = jax.vmap(lambda *one: query_from_object(reference, *one))(*camera, units, behind)
    order = lax.top_k(score, score.shape[0])[1]
    everything = poses, camera, score, overlap, colour, shared, found.support, points, where, weight, depth, behind
    everything = jax.tree.map(lambda x: x[order], everything)
    (poses, _, score, *_), best = everything, jax.tree.map(lambda x: x[0], everything)
    pose, camera, _, overlap, colour, shared, support, points, where, weight, depth, behind = best
    success = usable & (score[0] >= 0)
    width = resection.width * sight.diagonal
    fit = refine_resection(*camera, points, where, weight, width, steps=0)
    placed = jnp.sum(camera[0][None] * points[:, None, :], axis=-1) + camera[1]
    offset = placed[:, :2] / jnp.maximum(placed[:, 2:], 1e-6) - where
    squared = jnp.sum(offset**2, axis=-1)
    near = (weight > 0) & (squared < (resection.threshold * sight.diagonal) ** 2) & success
    count = jnp.sum(near, dtype=jnp.int32)
    beside = jnp.sum(jnp.where(near, squared * placed[:, 2] ** 2, 0)) / jnp.maximum(count, 1).astype(squared.dtype)
    total = jnp.sum(weight)
    middle = jnp.sum(weight[:, None] * placed, axis=0) / jnp.where(total > 1e-12, total, 1)
    arm = jnp.matmul(camera[0], pose.translation, precision="highest") + camera[1] - middle
    guess = centre_std(templates.surface, config.resect.guess)
    spread, unit_std = _spread(reference, camera[0], fit, arm, width, pose, guess, config)
    with jax.named_scope("extent"):
        placed = Similarity(camera[0], camera[1], jnp.ones_like(pose.scale))
        surface, share = templates.surface, config.resect.reach
        extent = measure_extent(reference, surface, query, placed, pose.scale, behind, depth, unit_std, share)
    if diameter is None:
        size, scale_std = jnp.where(success, extent.diameter, pose.scale), root(extent.variance)
    else:
        size, scale_std = diameter, jnp.zeros_like(unit_std)
    with jax.named_scope("confidence"):
        agreement = Agreement(
            depth=depth_agreement(templates.surface, scene.depth, scene.mask, scene.cloud.camera, pose, config.score),
            features=jnp.clip(support, 0, 1),
            drawn=overlap,
            colour=colour,
            seen=shared,
            rival=find_rival(poses, jnp.maximum(score, 0)),
        )
        weights = jnp.stack([jnp.asarray(x, score.dtype) for x in config.confidence.photo])
        confidence = jnp.where(success, probability(agreement, weights), 0)
    # A view without a patch, such as padding, is none.
    apart = jnp.where(jnp.any(templates.patches.valid, axis=1), closeness(templates, pose), jnp.inf)
    return PoseEstimate(
        camera_from_object=pose,
        diameter=size,
        box=extent.box,
        confidence=confidence,
        present=success & (confidence >= config.confidence.least),
        covariance=spread,
        scale_std=scale_std,
        ambiguity=rotation_ambiguity(poses, score, spread[:3, :3], config.confidence),
        agreement=agreement,
        hypotheses=Hypotheses(poses, jnp.clip(score, 0, 1)),
        view=jnp.argmin(apart).astype(jnp.int32),
        view_score=sightings.ranking[0],
        inliers=count,
        rmse=root(beside),
        success=success,
    )


def _has_pairs(rays: Float[Array, "v k 2"], weight: Float[Array, "v k"]) -> Bool[Array, ""]:
    """Whether any view has three pairs that are not in one place of the photo."""
    present = (weight > 0)[..., None]
    wide = jnp.max(jnp.where(present, rays, -jnp.inf), axis=1) > jnp.min(jnp.where(present, rays, jnp.inf), axis=1)
    return jnp.any((jnp.sum(weight > 0, axis=1, dtype=jnp.int32) >= 3) & jnp.all(wide, axis=-1))


def _spread(
    reference: ReferenceView,
    turn: Float[Array, "3 3"],
    fit: Resection,
    arm: Float[Array, "3"],
    width: Float[Array, ""],
    pose: Similarity,
    guess: Float[Array, ""],
    config: Config,
) -> tuple[Float[Array, "6 6"], Float[Array, ""]]:
    """The covariance of rotation (rad) and translation (metres) in the query's axes, and the relative deviation of the
    unit.

    Across the photo's ray the rays tell; along it, and with it in size, the guess is only as good as guesses are.

    Args:
      turn: the photo's camera from the query's.
      arm: from the centre of the points that were fitted to the object's, metres, in the photo's camera.
      width: of the robust loss, rays.
      guess: standard deviation of the distance from the measured front to the centre, model units.
    """
    scale, dtype = pose.scale, fit.information.dtype
    unit = jnp.concatenate([jnp.ones(3, dtype), jnp.full(3, scale, dtype)])
    # Neighbouring patches err alike, which no residual shows: even a perfect fit is only as exact as matches are.
    side = round(reference.patches.valid.shape[0] ** 0.5)
    patch = reference.view.mask.shape[1] / side / reference.view.camera.focal[0]
    loss = fit.loss + (config.resect.noise * patch / width) ** 2
    # In diameters, and bounded where nothing is determined: a radian, half a diameter.
    known = fit.information * unit[:, None] * unit[None] * config.resect.independent / jnp.maximum(loss, 1e-9)
    found = invert_positive(known + jnp.diag(jnp.array([1, 1, 1, 4, 4, 4], dtype)))
    along = found[5, 5]
    # The distance of the photo's camera moves no measured surface, and so not the object on it.
    found = found.at[5, :].set(0).at[:, 5].set(0)
    # A turn about the points' centre moves the object's, too, by turn × arm. (That the pose is the inverse of what was
    # fitted changes both signs, and so no product.)
    to_object = carry(arm / scale)
    of_guess = jnp.zeros((6, 6), dtype).at[5, 5].set(guess**2)
    moved = jnp.matmul(jnp.matmul(to_object, found, precision="highest"), to_object.T, precision="highest") + of_guess
    back = jnp.zeros((6, 6), dtype).at[:3, :3].set(turn.T).at[3:, 3:].set(turn.T) * unit[:, None]
    spread = jnp.matmul(jnp.matmul(back, moved, precision="highest"), back.T, precision="highest")
    spread = (spread + spread.T) / 2
    distance = reference.camera_from_object.translation[2]
    return spread, root(guess**2 + along) / distance
