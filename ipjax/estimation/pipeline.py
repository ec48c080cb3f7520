"""Figure 2 of the paper, from the query on: one pure function, one graph."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.positive import root
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ipjax.config import Config
from ipjax.estimation.alignment import align
from ipjax.estimation.confidence import covariance, find_rival, pair_information, probability, rotation_ambiguity
from ipjax.estimation.features import identity_of, object_features
from ipjax.estimation.matching import match, select
from ipjax.estimation.photo.choice import judge_by_photo
from ipjax.estimation.photo.through_photo import estimate_through_photo
from ipjax.estimation.refinement import information, refine, settle
from ipjax.estimation.scene import SceneGrid
from ipjax.estimation.scoring import score, score_drawn, seen_share
from ipjax.estimation.validity import finite_estimate, finite_query, finite_templates
from ipjax.metrics.poses import turn_angle
from ipjax.records import Agreement, Hypotheses, Pairs, Patches, PoseEstimate, Query, Similarity, Templates


def estimate(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]] | None,
    templates: Templates,
    query: Query,
    key: PRNGKeyArray,
    config: Config = Config(),
    diameter: Float[Array, ""] | None = None,
) -> PoseEstimate:
    """The object's pose and size in the query's camera.

    Write ``jax.jit(estimate)``. Every argument is positional, so that ``jax.vmap`` can map each of them: queries, keys,
    diameters, and objects that ``ipjax.pad_templates`` has made alike.

    Args:
      encoder: the one that described the query; with it the best candidates are drawn and described again, and only
        they are among the hypotheses. Slower by one encoding for each, and surer. None = nothing is drawn.
      templates: the onboarded object.
      query: the described crop.
      key: of the minimal sets; same key, same answer.
      config: thresholds are traced, sizes and switches static.
      diameter: the object's true diameter in metres; None = not known, the size is estimated, too.

    Returns:
      ``camera_from_object`` maps the normalised object frame (diameter 1) to metres in the crop's camera. All numbers
      are finite: what is not finite among the inputs is absent, and where it cannot be (a camera, the features' mean, a
      threshold, the diameter) ``success`` and ``present`` are False and the confidence is 0.

    Raises:
      ValueError: the crop is not square, or the templates, the query and the encoder are not of one encoder (by the
        length of features, and by identity where it is known: see ``features.identity_of``).
    """
    _check_shapes(templates, query)
    _check_encoders(encoder, templates, query)
    (templates, has_object), (query, has_camera) = finite_templates(templates), finite_query(query)
    usable = has_object & has_camera & _are_numbers(config)
    # In the precision of the records: under x64 Python's numbers are float64, and would make the pose so.
    config, diameter = jax.tree.map(lambda x: jnp.asarray(x, query.patches.points.dtype), (config, diameter))
    if diameter is not None:
        diameter = jnp.asarray(diameter, query.view.depth.dtype)
        has_size = jnp.isfinite(diameter) & (diameter > 0)
        usable, diameter = usable & has_size, jnp.where(has_size, diameter, 1)
    guessed = templates.reference is not None and not templates.reference.measured
    if guessed and config.score.ranking == "render":
        used = encoder if config.score.drawn else None
        return finite_estimate(estimate_through_photo(used, templates, query, usable, key, config, diameter))
    with jax.named_scope("match"):
        matches = match(*comparable(templates, query.patches, config), config.match)
        pairs = select(matches, query.patches, templates, config.match)
    # From here on the query's features are centred, as the templates' are.
    query = eqx.tree_at(lambda q: q.patches.features, query, object_features(query.patches.features, templates))
    with jax.named_scope("align"):
        size = apparent_diameter(templates, query)[matches.view]
        poses, agreed, _, determined = align(pairs, size, key, config.align, diameter)
        determined = determined & usable
    scale_known = diameter is not None
    scene = SceneGrid(query, config.score.resolution, config.refine.silhouette)
    unknown = jnp.zeros_like(agreed)
    unknown = Agreement(unknown, unknown, unknown, unknown, unknown, unknown)
    found = _Candidates(poses, determined, jnp.where(determined, agreed, -1), unknown)
    drawable = templates.appearance is not None or templates.reference is not None
    drawing = encoder is not None and drawable and config.score.drawn > 0
    if config.score.ranking == "render":
        found = _rounds(templates, query, scene, found, config, scale_known=scale_known)
        if encoder is not None and drawing:
            found = _draw_best(encoder, templates, query, found, config)
    order = lax.top_k(found.score, found.score.shape[0])[1]
    found = jax.tree.map(lambda x: x[order], found)
    if config.refine.settle and config.refine.steps:
        found = _settle_best(templates, scene, found, pairs, config, scale_known=scale_known)
    best = jax.tree.map(lambda x: x[0], found)
    # The pairs reported are those of the view with the most inliers, whichever view's hypothesis led to the pose.
    offset = jax.vmap(lambda one: best.poses @ one.object - one.camera)(pairs)
    squared = jnp.sum(offset**2, axis=-1)
    near = (pairs.weight > 0) & (squared < (config.align.threshold * best.poses.scale) ** 2) & best.determined
    view = lax.argmax(jnp.sum(near, axis=1, dtype=jnp.int32), 0, jnp.int32)
    matched, squared, used = jax.tree.map(lambda x: x[view], (pairs, squared, near))
    count = jnp.sum(used, dtype=jnp.int32)
    with jax.named_scope("confidence"):
        certainty = _certainty(templates, scene, found, matched, used, config, drawing=drawing, scale_known=scale_known)
    found = PoseEstimate(
        camera_from_object=best.poses,
        diameter=best.poses.scale,
        box=jnp.stack([-templates.extents / 2, templates.extents / 2]),
        **certainty,
        hypotheses=Hypotheses(found.poses, jnp.clip(found.score, 0, 1)),
        view=matches.view[view],
        view_score=matches.ranking,
        inliers=count,
        rmse=root(jnp.sum(jnp.where(used, squared, 0)) / jnp.maximum(count, 1).astype(squared.dtype)),
        success=best.determined,
    )
    return finite_estimate(found)


def _are_numbers(config: Config) -> Bool[Array, ""]:
    """Whether no threshold is NaN; some may be infinite."""
    return ~jnp.any(jnp.isnan(jnp.stack([jnp.asarray(x, jnp.float32) for x in jax.tree.leaves(config)])))


class _Candidates(eqx.Module):
    """Poses on their way through refinement, scores and drawing."""

    poses: Similarity
    determined: Bool[Array, "*n"]
    score: Float[Array, "*n"]  # -1 = absent
    agreement: Agreement


def _settle_best(
    templates: Templates, scene: SceneGrid, found: _Candidates, pairs: Pairs, config: Config, *, scale_known: bool
) -> _Candidates:
    """The candidates, the best refined by `settle`, for errors of the mesh; the pairs are those of all views."""
    strongest = jax.tree.map(lambda x: x[:, : config.refine.pairs].reshape(-1, *x.shape[2:]), pairs)
    with jax.named_scope("settle"):
        best = jax.tree.map(lambda x: x[0], found.poses)
        moved = settle(templates.surface, scene.cloud, best, strongest, config.refine, scale_known=scale_known)
    poses = jax.tree.map(lambda all_of_them, first: all_of_them.at[0].set(first), found.poses, moved)
    return eqx.tree_at(lambda f: f.poses, found, poses)


def _certainty(
    templates: Templates,
    scene: SceneGrid,
    found: _Candidates,
    pairs: Pairs,
    used: Bool[Array, "k"],
    config: Config,
    *,
    drawing: bool,
    scale_known: bool,
) -> dict[str, Any]:
    """The fields of an estimate about its certainty; candidates best first, ``pairs`` of the best one."""
    best = jax.tree.map(lambda x: x[0], found)
    parts = found.agreement
    # Not the score: the fitted weights of the confidence remain valid when its formula changes.
    evidence = parts.depth * parts.features * parts.drawn if drawing else found.score
    rival = find_rival(found.poses, jnp.where(found.score > 0, evidence, 0))
    seen = seen_share(templates.surface, best.poses)
    agreement = eqx.tree_at(lambda a: (a.seen, a.rival), best.agreement, (seen, rival))
    if config.score.ranking == "render":
        weights = config.confidence.drawn if drawing else config.confidence.undrawn
        weights = jnp.stack([jnp.asarray(x, found.score.dtype) for x in weights])
        if templates.photo_centre is not None:  # a pose that rests on what was invented is not sure
            weights = weights.at[0].add(-config.confidence.invented).at[5].add(config.confidence.invented)
        confidence = jnp.where(best.determined, probability(agreement, weights), 0)
        present = best.determined & (confidence >= config.confidence.least)
    else:  # the share of pairs that agree is no probability
        confidence, present = jnp.clip(best.score, 0, 1), best.determined
    spread, scale_std = covariance(
        information(templates.surface, scene.cloud, best.poses, config.refine),
        pair_information(best.poses, pairs, used),
        best.poses.scale,
        config.confidence,
        scale_known=scale_known,
    )
    return {
        "confidence": confidence,
        "present": present,
        "covariance": spread,
        "scale_std": scale_std,
        "ambiguity": rotation_ambiguity(found.poses, found.score, spread[:3, :3], config.confidence),
        "agreement": agreement,
    }


def _check_shapes(templates: Templates, query: Query) -> None:
    height, width = query.view.depth.shape
    if height != width:
        raise ValueError(f"estimate takes square crops, as ipjax.frame makes them, not {height} × {width} pixels")
    given, wanted = query.patches.features.shape[-1], templates.mean.shape[-1]
    if given != wanted:
        raise ValueError(
            f"the query's features have {given} channels and the templates' {wanted}: "
            "they must come from the same encoder"
        )


def _check_encoders(encoder: object, templates: Templates, query: Query) -> None:
    """Refuse features of different encoders, by their identity; an encoder without one is not compared."""
    found = {
        "the object was onboarded with": templates.patches.encoder,
        "the query was described by": query.patches.encoder,
        "candidates would be drawn for": identity_of(encoder),
    }
    known = {what: identity for what, identity in found.items() if identity is not None}
    if len(set(known.values())) > 1:
        sources = ", ".join(f"{what} '{identity}'" for what, identity in known.items())
        raise ValueError(
            f"{sources}: features of different encoders cannot be compared; onboard the object again, or use the "
            "encoder that it was made with"
        )


def _rounds(
    templates: Templates, query: Query, scene: SceneGrid, first: _Candidates, config: Config, *, scale_known: bool
) -> _Candidates:
    """Refine and score the hypotheses; then do the same with the best of them turned about the box's axes.

    Both rounds are one body of a scan, so that refinement is compiled once; they take the same number of poses.
    """
    count = first.score.shape[0]
    turned = min(config.score.alternates, count)

    def one_round(given, last):
        poses, determined = given
        if config.refine.steps:
            with jax.named_scope("refine"):
                fit = lambda pose: refine(templates.surface, scene.cloud, pose, config.refine, scale_known=scale_known)
                poses = jax.vmap(lambda pose: fit(pose)[0])(poses)
        rated, agreement = _score_all(templates, query, scene, poses, config)
        found = _Candidates(poses, determined, jnp.where(determined, rated, -1), agreement)
        if not turned:
            return given, found
        # After the last round nothing is turned, for nothing would refine it.
        return lax.cond(last, lambda _: given, turn_best, found), found

    def turn_best(found):
        best = lax.top_k(found.score, turned)[1]
        determined = jnp.repeat(found.determined[best], TURNS)
        alternates = turn(jax.tree.map(lambda x: x[best], found.poses), templates.axes)
        # Most turned poses score low before refinement already: only the best are refined.
        unrefined = jnp.where(determined, _score_all(templates, query, scene, alternates, config)[0], -1)
        chosen = lax.top_k(unrefined, min(count, TURNS * turned))[1]
        padding = jnp.arange(count) >= chosen.shape[0]  # repeats, so that both rounds have the same number of poses
        take = lambda x: jnp.resize(x[chosen], (count, *x.shape[1:]))
        return jax.tree.map(take, alternates), take(determined) & ~padding

    rounds = jnp.array([False, True] if turned else [True])
    _, found = lax.scan(one_round, (first.poses, first.determined), rounds)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)


def _score_all(
    templates: Templates, query: Query, scene: SceneGrid, poses: Similarity, config: Config
) -> tuple[Float[Array, "h"], Agreement]:
    """Scores of all poses without drawing them."""
    with jax.named_scope("score"):
        rate = lambda pose: score(
            None, templates, query, scene.depth, scene.mask, scene.cloud.camera, pose, config.score
        )
        return jax.vmap(rate)(poses)


def _draw_best(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    found: _Candidates,
    config: Config,
) -> _Candidates:
    """The best candidates, each different from the others, scored by what they look like, too.

    Those of an object from a photo with depth are scored by the photo alone (`photo.choice`).
    """
    by_photo = templates.reference is not None
    count = min(config.resect.drawn if by_photo else config.score.drawn, found.score.shape[0])
    chosen, ahead = distinct(found.poses, found.score, count, config.score.apart)
    kept = jax.tree.map(lambda x: x[chosen], found)
    determined = kept.determined & ahead
    if by_photo:
        with jax.named_scope("draw"):
            rated, overlap, colour = judge_by_photo(encoder, templates, query, kept.poses, config)
        agreement = eqx.tree_at(lambda a: (a.drawn, a.colour), kept.agreement, (overlap, colour))
        return _Candidates(kept.poses, determined, jnp.where(determined, rated, -1), agreement)
    # Compiled for one platform, but traced for both: jitted, it is traced once.
    rate = jax.jit(lambda pose, undrawn: score_drawn(encoder, templates, query, pose, undrawn, config.score))
    with jax.named_scope("draw"):
        # One image at a time is fastest on a CPU; accelerators want them all.
        rated, agreement = lax.platform_dependent(
            kept.poses, kept.agreement, cpu=lambda *x: lax.map(lambda one: rate(*one), x), default=jax.vmap(rate)
        )
    return _Candidates(kept.poses, determined, jnp.where(determined, rated, -1), agreement)


def distinct(
    poses: Similarity, score: Float[Array, "n"], count: int, apart: float | Float[Array, ""]
) -> tuple[Int[Array, "k"], Bool[Array, "k"]]:
    """Indices of the best poses that differ from all better ones, best first, and whether there were so many.

    Args:
      score: higher is better, negative = absent.
      apart: the angle in rad below which two poses are one, if their centres are also within 3 % of the diameter.
    """

    def choose(rest, _):
        best = jnp.argmax(rest)
        trace = jnp.sum(poses.rotation * poses.rotation[best], axis=(-2, -1))
        moved = root(jnp.sum((poses.translation - poses.translation[best]) ** 2, axis=-1))
        same = (turn_angle(trace) < apart) & (moved < 0.03 * poses.scale[best])
        return jnp.where(same, -1, rest).at[best].set(-1), (best, rest[best] >= 0)

    return lax.scan(choose, score, None, length=count)[1]


TURNS = 9  # of one pose: a quarter, half and three quarters about each of three axes


def turn(poses: Similarity, axes: Float[Array, "3 3"]) -> Similarity:
    """Each pose turned by 90°, 180° and 270° about each axis through the object's centre: ``n`` poses give ``9 n``.

    Boxes and cans fit their depth in several of these; correspondences often settle on a wrong one.
    """
    quarter = np.array(
        [[[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
    )
    turns = np.concatenate([np.linalg.matrix_power(quarter, k) for k in (1, 2, 3)]).astype(axes.dtype)
    about = jnp.einsum("ki,tkl,lj->tij", axes, turns, axes, precision="highest")
    rotation = jnp.einsum("nij,tjk->ntik", poses.rotation, about, precision="highest").reshape(-1, 3, 3)
    repeat = lambda x: jnp.repeat(x, len(turns), axis=0)
    return Similarity(rotation, repeat(poses.translation), repeat(poses.scale))


def comparable(templates: Templates, query: Patches, config: Config = Config()) -> tuple[Patches, Templates]:
    """The query's patches and the templates with features of one kind: without the object's mean, or raw.

    Args:
      templates: as onboarded, centred.
      query: as described, raw.
    """
    if config.match.centred:
        features = object_features(query.features, templates)
        return eqx.tree_at(lambda q: q.features, query, features), templates
    features = jnp.where(templates.patches.valid[..., None], templates.patches.features, 0)  # invalid ones may hold NaN
    raw = features.astype(templates.mean.dtype) * templates.norm[..., None]
    if templates.basis is not None:
        raw = jnp.matmul(raw, templates.basis, precision="highest")
    raw = raw + templates.mean
    return query, eqx.tree_at(lambda t: t.patches.features, templates, raw)


def apparent_diameter(templates: Templates, query: Query) -> Float[Array, "v"]:
    """The object's diameter in metres if the query showed it as each template does, from the area both cover.

    An occluded object looks smaller than it is, so this errs low.
    """

    def area(patches, camera):
        depth = jnp.where(patches.valid, patches.points[..., 2], 0)
        return jnp.sum((depth / jnp.mean(camera.focal)) ** 2)

    seen = area(query.patches, query.view.camera)
    inside = jax.vmap(lambda pose, points: _depth_in_camera(pose, points))(
        templates.camera_from_object, templates.patches.points
    )
    depth = jnp.where(templates.patches.valid, inside, 0)
    expected = jnp.sum((depth / jnp.mean(templates.camera.focal, axis=-1)[..., None]) ** 2, axis=-1)
    return root(seen / jnp.maximum(expected, 1e-9))


def _depth_in_camera(pose: Similarity, points: Float[Array, "p 3"]) -> Float[Array, "p"]:
    return (pose @ points)[:, 2]
