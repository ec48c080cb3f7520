"""Candidates drawn, compared with the photo, and moved until they look like it: by patches, then by colours."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from ipjax_kernels.direct import Prior
from ipjax_kernels.perspective import refine_resection
from ipjax_kernels.positive import root
from jax import lax
from jaxtyping import Array, Float

from ipjax.config import ResectConfig
from ipjax.estimation.photo.contrasts import align_colours, align_drawn, expect, prepare_comparison, unlikeness
from ipjax.estimation.photo.drawing import Drawing, draw_query
from ipjax.estimation.photo.resection import Resections, Sight
from ipjax.records import Query, Templates


class Compared(eqx.Module):
    """The candidates after their drawings were compared with the photo, each with its best drawing."""

    rotation: Float[Array, "*b 3 3"]
    translation: Float[Array, "*b 3"]
    score: Float[Array, "*b"]  # by which they are ranked, in [0, 1]; -1 = absent
    drawing: Drawing


def compare_drawings(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    found: Resections,
    sight: Sight,
    config: ResectConfig,
) -> Compared:
    """Draw every candidate; then move the ``config.polished`` best and draw them again, ``config.rounds`` times.

    What their drawings match brings them to within some degrees, the contrasts of their colours to within one or two.
    Of each candidate the pose whose drawing scores best remains.

    One loop whose body draws one candidate: the encoder is compiled once.
    """
    reference = templates.reference
    assert reference is not None
    count = found.support.shape[0]
    polished = min(config.polished, count)
    draw = lambda turn, shift: draw_query(encoder, templates, query, turn, shift, sight, config)
    blank = jax.eval_shape(draw, found.rotation[0], found.translation[0])
    blank = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), blank)
    absent = jnp.full(count, -1, found.support.dtype)
    # What no pair agrees with and what sticks out of the outline is rarely right, however alike the rest of it looks.
    agreed = root(root(jnp.clip(found.support, 0, 1)))
    width = config.width * sight.diagonal
    comparison = prepare_comparison(reference, query)

    def polish(prior):
        wide = align_colours(comparison, prior, config)
        close = align_drawn(reference, query, wide.rotation, wide.translation, prior, sight, config)
        return close.rotation, close.translation

    def step(index, state):
        priors, first, best = state
        order = lax.top_k(first, max(polished, 1))[1]
        one = jnp.where(index < count, index, order[(index - count) % max(polished, 1)])
        prior = jax.tree.map(lambda x: x[one], priors)
        turn, shift = lax.cond(index < count, lambda one: (one.rotation, one.translation), polish, prior)
        drawn = draw(turn, shift)
        unlike = unlikeness(comparison, turn, shift)
        score = drawn.overlap * root(drawn.contained) * agreed[one] * jnp.exp(-config.unlike * unlike)
        score = jnp.where(found.support[one] >= 0, score, -1)
        first = first.at[one].set(jnp.where(index < count, score, first[one]))
        here = Compared(turn, shift, score, drawn)
        better = score > best.score[one]
        best = jax.tree.map(
            lambda all_of_them, new: all_of_them.at[one].set(jnp.where(better, new, all_of_them[one])), best, here
        )
        fit = refine_resection(turn, shift, drawn.points, drawn.rays, drawn.weight, width, steps=config.steps)
        prior = expect(comparison, fit, drawn.points, drawn.weight, config)
        return jax.tree.map(lambda all_of_them, new: all_of_them.at[one].set(new), priors, prior), first, best

    nothing = jnp.zeros((count, 6, 6), found.translation.dtype)
    middles = jnp.broadcast_to(comparison.middle, (count, 3))
    start = Prior(found.rotation, found.translation, nothing, middles), absent
    best = Compared(found.rotation, found.translation, absent, blank)
    return lax.fori_loop(0, count + polished * config.rounds, step, (*start, best))[2]
