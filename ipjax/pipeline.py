"""Figure 2 of the paper, from the query on: one pure function, one graph."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ipjax.alignment import align
from ipjax.config import Config
from ipjax.features import centre_on, lift
from ipjax.matching import match, select
from ipjax.refinement import Cloud, refine
from ipjax.scoring import score
from ipjax.types import Camera, Hypotheses, PoseEstimate, Query, Similarity, Templates


def estimate(
    templates: Templates,
    query: Query,
    key: PRNGKeyArray,
    config: Config = Config(),  # noqa: B008
    *,
    diameter: Float[Array, ""] | None = None,
) -> PoseEstimate:
    """The object's pose and size in the query's camera.

    Write ``jax.jit(estimate)``; ``jax.vmap`` over queries, or over objects padded to one size, works too.

    Args:
      templates: the onboarded object.
      query: the described crop.
      key: of the minimal sets; same key, same answer.
      config: thresholds are traced, sizes and switches static.
      diameter: the object's true diameter in metres, where it is known.

    Returns:
      ``camera_from_object`` maps the normalised object frame (diameter 1) to metres in the crop's camera.
    """
    with jax.named_scope("match"):
        raw = query.patches
        query = eqx.tree_at(lambda q: q.patches.features, query, centre_on(raw.features, templates.mean)[0])
        if config.match.centred:
            matches = match(query.patches, templates, config.match)
        else:
            matches = match(raw, _uncentred(templates), config.match)
        pairs = select(matches, query.patches, templates, config.match)
    with jax.named_scope("align"):
        size = apparent_diameter(query, templates)[matches.view]
        poses, agreement, inliers, determined = align(pairs, size, key, config.align, diameter=diameter)
    keep = config.align.keep
    if config.score.ranking == "render":
        grid = config.score.resolution
        points, cover = lift(query.view, grid, grid, 0.05)
        cell = query.view.depth.shape[0] / grid
        camera = Camera(query.view.camera.focal / cell, (query.view.camera.centre + 0.5) / cell - 0.5)
        cloud = Cloud(points.reshape(grid, grid, 3), (cover > 0.3).reshape(grid, grid), camera)
        if config.refine.steps:
            with jax.named_scope("refine"):
                poses, _ = jax.vmap(
                    lambda pose: refine(
                        templates.surface, cloud, pose, config.refine, scale_known=diameter is not None
                    )
                )(poses)
        with jax.named_scope("score"):
            depth, mask = _coarse(query, grid)
            agreement = jax.vmap(lambda pose: score(templates, query, depth, mask, camera, pose, config.score))(poses)
    agreement = jnp.where(determined, agreement, -1)
    order = jnp.argsort(-agreement, stable=True)
    best = order[0]
    poses = jax.tree.map(lambda x: x[order], poses)
    answer: Similarity = jax.tree.map(lambda x: x[0], poses)
    view = best // keep
    used = inliers[best]
    offset = answer @ pairs.object[view] - pairs.camera[view]
    squared = jnp.where(used, jnp.sum(offset**2, axis=-1), 0)
    return PoseEstimate(
        camera_from_object=answer,
        confidence=jnp.clip(agreement[best], 0, 1),
        hypotheses=Hypotheses(poses, jnp.clip(agreement[order], 0, 1)),
        view=matches.view[view],
        view_score=matches.ranking,
        inliers=jnp.sum(used),
        rmse=jnp.sqrt(jnp.sum(squared) / jnp.maximum(jnp.sum(used, dtype=jnp.float32), 1)),
        success=determined[best],
    )


def _uncentred(templates: Templates) -> Templates:
    raw = templates.patches.features.astype(templates.mean.dtype) * templates.norm[..., None] + templates.mean
    return eqx.tree_at(lambda t: t.patches.features, templates, raw)


def _coarse(query: Query, grid: int):
    """Depth and mask of the crop, background included, by the nearest pixel to each cell's centre."""
    step = query.view.depth.shape[0] // grid
    return query.view.depth[step // 2 :: step, step // 2 :: step], query.view.mask[step // 2 :: step, step // 2 :: step]


def apparent_diameter(query: Query, templates: Templates) -> Float[Array, "v"]:
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
    return jnp.sqrt(seen / jnp.maximum(expected, 1e-9))


def _depth_in_camera(pose: Similarity, points: Float[Array, "p 3"]) -> Float[Array, "p"]:
    return (pose @ points)[:, 2]
