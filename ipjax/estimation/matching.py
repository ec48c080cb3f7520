"""Which template looks like the query, and which patch is which (Eq. 1–5)."""

import jax
import jax.numpy as jnp
from ipjax_kernels.neighbours import NO_MATCH, cycle_distance, nearest
from jax import lax
from jaxtyping import Array, Float

from ipjax.config import MatchConfig
from ipjax.records import Matches, Pairs, Patches, Templates


def match(query: Patches, templates: Templates, config: MatchConfig = MatchConfig()) -> Matches:
    """Nearest neighbours both ways, cyclic distances, and the templates ranked by them.

    The cycle starts at the query (Eq. 2–4); masks enter before every argmax. ``ranking='cyclic'`` is Eq. 5, the sum
    of the K smallest distances, with ties (the rule, not the exception, on a patch grid) broken by the sum of their
    cosines. ``ranking='cosine'`` sums the cosines of all cycles no longer than ``config.cycle``.
    With ``config.shortlist`` only so many templates are searched, those of the highest :func:`pooled_similarity`; all
    others rank below them.

    Args:
      query: patches ``p`` of the crop, centred if the templates' are.
      templates: patches ``v q`` of the object.

    Returns:
      ``config.views`` templates with ``config.pairs`` pairs each, ordered by distance, then cosine, then patch. Of
      all this only the cosines of these pairs have a derivative.

    Raises:
      ValueError: the features of the two sides differ in length, or the shortlist is empty.
    """
    if config.shortlist is not None and config.shortlist < 1:
        raise ValueError(f"the shortlist must hold at least one template, not {config.shortlist}")
    if query.features.shape[-1] != templates.patches.features.shape[-1]:
        raise ValueError(
            f"the query's features have {query.features.shape[-1]} channels and the templates' "
            f"{templates.patches.features.shape[-1]}: they must come from the same encoder"
        )
    patches = templates.patches
    every = patches.valid.shape[0]
    chosen = None
    if config.shortlist is not None and config.shortlist < every:
        with jax.named_scope("shortlist"):
            alike = jnp.where(jnp.any(patches.valid, axis=1), pooled_similarity(patches, query), -2)
            chosen = jnp.sort(lax.top_k(alike, config.shortlist)[1])
            patches = jax.tree.map(lambda x: x[chosen], patches)
    found = nearest(query.features, patches.features, query.valid, patches.valid, memory_bytes=config.memory_bytes)
    distance = jax.vmap(cycle_distance, (0, 0, None, None, 0))(
        found.query_to_template, found.template_to_query, query.grid, query.valid, patches.valid
    )
    pairs = min(config.pairs, query.valid.shape[0])
    absent = ~jnp.any(patches.valid, axis=1)  # a view without a patch, such as padding, ranks behind all others
    if config.ranking == "cyclic":
        order, near, cosine = jax.vmap(_order)(distance, found.query_similarity)
        near, cosine = near[:, :pairs], jnp.where(jnp.isfinite(near), cosine, 0)[:, :pairs]
        # A missing pair costs the grid's diagonal, so that a view with few pairs does not win by having few terms.
        missing_cost = jnp.sqrt(jnp.sum(jnp.max(query.grid, axis=0) ** 2)) + 1
        cost = jnp.sum(jnp.minimum(near, missing_cost), axis=1)
        cost = jnp.where(absent, jnp.max(cost) + 1, cost)
        ranking = -cost
        index = jnp.arange(cost.shape[0], dtype=jnp.int32)
        view = lax.sort((cost, -jnp.sum(cosine, axis=1), index), num_keys=2)[2][: config.views]
    else:
        kept = (distance <= config.cycle) & query.valid
        ranking = jnp.sum(jnp.where(kept, found.query_similarity, 0), axis=1) / jnp.maximum(
            jnp.sum(query.valid, dtype=jnp.float32), 1
        )
        ranking = jnp.where(absent, jnp.min(ranking) - 1, ranking)
        view = lax.top_k(ranking, min(config.views, ranking.shape[0]))[1]
    order, near, cosine = jax.vmap(_order)(distance[view], found.query_similarity[view])
    order = order[:, :pairs]
    template = jnp.take_along_axis(found.query_to_template[view], order, axis=1)
    # A patch without a match points at one that may be absent and hold NaN, and its derivative, zero times that, would
    # be NaN as well.
    partner_valid = patches.valid[view[:, None], template]
    partner = jnp.where(partner_valid[..., None], patches.features[view[:, None], template], 0)
    cosine = _cosine_with_derivative(cosine[:, :pairs], query.features[order], partner)
    if chosen is not None:
        ranking = jnp.full(every, jnp.min(ranking) - 1).at[chosen].set(ranking)
        view = chosen[view]
    return Matches(
        ranking=ranking,
        view=view,
        query=order,
        template=template,
        distance=near[:, :pairs],
        similarity=cosine,
    )


@jax.custom_jvp
def _cosine_with_derivative(cosine, features, partner):
    """The cosines that the kernel found, with a derivative, which the kernel lacks: that of the matched features."""
    del features, partner
    return cosine


@_cosine_with_derivative.defjvp
def _differentiate_cosine(primals, tangents):
    cosine, features, partner = primals
    change = jnp.sum(tangents[1] * partner.astype(features.dtype), axis=-1)
    change = change + jnp.sum(features * tangents[2].astype(features.dtype), axis=-1)
    return cosine, jnp.where(cosine > NO_MATCH, change, 0).astype(cosine.dtype)


CELLS = 2  # on a side of the grid of cells in which patches are pooled


def pooled_similarity(templates: Patches, query: Patches) -> Float[Array, "v"]:
    """Cosine in [-1, 1] between the query and every template by pooled features: mean directions of 2 × 2 cells.

    One pass over the templates' features; no patch is compared with another.

    Args:
      templates: patches ``v q`` on a grid that covers the same part of the object as the query's.
      query: patches ``p`` of a square crop.
    """
    within = lambda grid: jnp.floor(grid * (CELLS / (jnp.max(grid, initial=0) + 1)) + 1e-4).astype(jnp.int32)
    cells = jnp.arange(CELLS**2, dtype=jnp.int32)[:, None]

    def pool(features, cell, valid):
        inside = (cells == cell[:, 1] * CELLS + cell[:, 0]) & valid
        features = jnp.where(valid[:, None], features, 0).astype(jnp.float32)  # invalid patches may hold NaN
        total = jnp.dot(inside.astype(jnp.float32), features, precision="highest")
        cell_norm = jnp.sqrt(jnp.sum(total * total, axis=1, keepdims=True))
        total = total / jnp.maximum(cell_norm, 1e-9)
        return total / jnp.maximum(jnp.sqrt(jnp.sum(total * total)), 1e-9)

    whole = pool(query.features, within(query.grid), query.valid)
    one = lambda template: jnp.sum(pool(*template) * whole)
    return lax.map(one, (templates.features, within(templates.grid), templates.valid))


def _order(distance: Float[Array, "p"], similarity: Float[Array, "p"]):
    """Patches by distance, then cosine (high first), then index: a total order, the same everywhere."""
    index = jnp.arange(distance.shape[0], dtype=jnp.int32)
    near, negative, index = lax.sort((distance, -similarity, index), num_keys=2, is_stable=True)
    return index, near, -negative


def select(
    matches: Matches,
    query: Patches,
    templates: Templates,
    config: MatchConfig = MatchConfig(),
) -> Pairs:
    """Lift matches to pairs of 3-D points, ``[v k]``; the weight falls with the cycle and rises with the cosine."""
    points = templates.patches.points[matches.view]
    use = (matches.distance <= config.cycle) & jnp.isfinite(matches.distance)
    weight = jnp.maximum(matches.similarity, 0) / (1 + jnp.where(use, matches.distance, 0))
    return Pairs(
        object=jnp.take_along_axis(points, matches.template[..., None], axis=1),
        camera=query.points[matches.query],
        weight=jnp.where(use, weight, 0),
    )
