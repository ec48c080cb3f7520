"""The similarity that most pairs of points agree on: weighted minimal sets, truncated scores, local refits (RANSAC).

Every hypothesis is computed, none is branched on: the shapes depend on counts that the caller fixes, never on the data.
"""

from functools import partial
from itertools import combinations
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ipjax_kernels.similarity import fit_batch_last

_PAIRS_PER_STEP = 8  # pairs that are scored in one step on a CPU: more are not faster and take longer to compile


class Hypotheses(NamedTuple):
    """Similarities (``target = scale * rotation @ source + translation``) with their support, best first."""

    rotation: Float[Array, "*b h 3 3"]
    translation: Float[Array, "*b h 3"]
    scale: Float[Array, "*b h"]
    score: Float[Array, "*b h"]  # [0, 1]; -1 = rejected
    inliers: Bool[Array, "*b h k"]
    success: Bool[Array, "*b h"]  # determined, and inside every gate


@partial(jax.jit, static_argnames=("count", "size"))
def draw_minimal_sets(
    key: Key[Array, ""], weight: Float[Array, "k"], count: int, size: int
) -> Int[Array, "{count} {size}"]:
    """``count`` sets of ``size`` different indices, each drawn with probability proportional to its weight.

    Sequential drawing without replacement, through the inverse of the cumulated weights. Weights are taken to 31 −
    log2(k) bits, so the cumulated sums are integers and the indices of a set differ exactly. An index of weight 0 is
    never drawn; where fewer than ``size`` weights are positive, a set repeats an index, and what is fitted to it is
    degenerate. Raises ValueError at trace time if ``size`` exceeds k.
    """
    if weight.ndim != 1 or not 0 < size <= weight.shape[0] or count < 1:
        raise ValueError(
            f"draw_minimal_sets draws {count} sets of {size} from weights of shape (k,) with k >= {size}; "
            f"got {weight.shape}"
        )
    bits = 30 - (weight.shape[0] - 1).bit_length()
    weight = jnp.where(jnp.isfinite(weight), jnp.maximum(weight, 0), 0)
    largest = jnp.max(weight)
    shares = weight / jnp.where(largest > 0, largest, 1) * 2.0**bits
    shares = jnp.where(weight > 0, jnp.maximum(shares, 1), 0).astype(jnp.int32)
    ends = jnp.cumsum(shares)
    draws = jax.random.bits(key, (size, count), jnp.uint32)
    drawn: list[jax.Array] = []
    for draw in draws:
        taken = sum((shares[index] for index in drawn), jnp.zeros(count, jnp.int32))
        place = _scale_bits(draw, ends[-1] - taken)
        # Step over the intervals already drawn, in order of their place.
        for index in _sort_network(drawn):
            place = place + jnp.where(place >= ends[index] - shares[index], shares[index], 0)
        # A loop of ten gathers: comparing with every end costs more, and unrolled,
        # or without the barrier, the compiler fuses it with all that follows for minutes.
        index = jnp.searchsorted(ends, place, side="right").astype(jnp.int32)
        drawn.append(jax.lax.optimization_barrier(index))
    # Nothing left to draw (place past the end): repeat the first index of the set, or 0.
    first = jnp.where(drawn[0] < weight.shape[0], drawn[0], 0)
    drawn = [jnp.where(index < weight.shape[0], index, first) for index in drawn]
    return jnp.stack(drawn, axis=1)


def residuals(
    rotation: Float[Array, "*h 3 3"],
    translation: Float[Array, "*h 3"],
    scale: Float[Array, "*h"],
    source: Float[Array, "k 3"],
    target: Float[Array, "k 3"],
) -> Float[Array, "*h k"]:
    """Squared distances |scale · rotation @ source + translation − target|², in the target's unit squared."""
    # Element by element: nine multiply-adds a pair fuse with whatever reads them; a matrix product would not.
    scaled = scale[..., None, None] * rotation
    total = jnp.zeros((), source.dtype)
    for row in range(3):
        moved = sum(scaled[..., row, column, None] * source[:, column] for column in range(3))
        total = total + (moved + translation[..., row, None] - target[:, row]) ** 2
    return total


def score_sets(
    squared: Float[Array, "*h k"], weight: Float[Array, "k"], threshold: Float[Array, "*#h"]
) -> tuple[Float[Array, "*h"], Float[Array, "*h"], Float[Array, "*h"]]:
    """Three scores of hypotheses from their squared residuals and distance threshold, weighted, per unit of weight.

    Returns ``(truncated, count, loss)``: the truncated quadratic Σ w max(0, 1 − r²/threshold²) / Σ w (MSAC; Torr and
    Zisserman 2000) and the inlier share Σ w [r < threshold] / Σ w, both in [0, 1], higher is better; and Σ w r² over
    all pairs, lower is better.
    """
    total = jnp.sum(weight)
    share = weight / jnp.where(total > 0, total, 1)
    limit = jnp.square(threshold)[..., None]
    inverse = 1 / jnp.where(limit > 0, limit, 1)  # one division a hypothesis, not one a pair
    truncated = jnp.sum(share * jnp.maximum(0, 1 - squared * inverse), axis=-1)
    # Summed before the division, so that equal counts are equal numbers.
    inside = jnp.sum(jnp.where(squared < limit, weight, 0), axis=-1) / jnp.where(total > 0, total, 1)
    truncated = jnp.where(limit[..., 0] > 0, jnp.minimum(truncated, 1), 0)
    return truncated, inside, jnp.sum(weight * squared, axis=-1)


def score_batch_last(
    rotation: Float[Array, "3 3 h"],
    translation: Float[Array, "3 h"],
    scale: Float[Array, "h"],
    source: Float[Array, "k 3"],
    target: Float[Array, "k 3"],
    weight: Float[Array, "k"],
    threshold: Float[Array, "h"],
) -> tuple[Float[Array, "h"], Float[Array, "h"], Float[Array, "h"]]:
    """``score_sets`` of the residuals of thousands of hypotheses, which are never in memory; the batch axis last."""

    def by_pairs(rotation, translation, scale, source, target, weight, threshold):
        # A CPU sums along the last axis one number at a time. Here a few pairs at a time are added to the sums of
        # all hypotheses, which vectorises and stays in the cache; a score that is not used is not computed.
        total = jnp.sum(weight)
        share = weight / jnp.where(total > 0, total, 1)
        limit = jnp.square(threshold)
        inverse = 1 / jnp.where(limit > 0, limit, 1)
        scaled = jax.lax.optimization_barrier(scale * rotation)
        padding = -weight.shape[0] % _PAIRS_PER_STEP
        parts = [
            jnp.pad(x, ((0, padding), *[(0, 0)] * (x.ndim - 1))).reshape(-1, _PAIRS_PER_STEP, *x.shape[1:])
            for x in (source, target, weight, share)
        ]

        def add(sums, part):
            truncated, inside, loss = sums
            for point, image, weight, share in zip(*part, strict=True):
                squared = jnp.zeros((), source.dtype)
                for row in range(3):
                    moved = sum(scaled[row, column] * point[column] for column in range(3))
                    squared = squared + (moved + (translation[row] - image[row])) ** 2
                truncated = truncated + share * jnp.maximum(0, 1 - squared * inverse)
                inside = inside + jnp.where(squared < limit, weight, 0)
                loss = loss + weight * squared
            return (truncated, inside, loss), None

        start = (jnp.zeros_like(scale),) * 3
        (truncated, inside, loss), _ = jax.lax.scan(add, start, parts)
        inside = inside / jnp.where(total > 0, total, 1)
        return jnp.where(limit > 0, jnp.minimum(truncated, 1), 0), inside, loss

    def at_once(rotation, translation, scale, source, target, weight, threshold):
        rotation, translation = jnp.moveaxis(rotation, -1, 0), jnp.moveaxis(translation, -1, 0)
        return score_sets(residuals(rotation, translation, scale, source, target), weight, threshold)

    arguments = rotation, translation, scale, source, target, weight, threshold
    return jax.lax.platform_dependent(*arguments, cpu=by_pairs, default=at_once)


@partial(jax.jit, static_argnames=("count", "size", "keep", "refits", "rank", "relative"))
def consensus(
    key: Key[Array, ""],
    source: Float[Array, "k 3"],
    target: Float[Array, "k 3"],
    weight: Float[Array, "k"],
    threshold: Float[Array, ""] | float,
    *,
    sets: Int[Array, "n m"] | None = None,
    count: int = 1000,
    size: int = 3,
    keep: int = 16,
    refits: int = 3,
    scale_bounds: tuple[Float[Array, ""] | float, Float[Array, ""] | float] = (0.0, float("inf")),
    edge_ratio: Float[Array, ""] | float = 0.0,
    spread: Float[Array, ""] | float = 0.0,
    rank: Literal["msac", "count"] = "msac",
    relative: bool = False,
) -> Hypotheses:
    """The ``keep`` similarities that most pairs agree on, best first.

    ``count`` minimal sets of ``size`` pairs are drawn in proportion to the weights (or given: ``sets``, indices
    (n, m)), a similarity is fitted to each and scored by all pairs. The best are fitted again to their inliers,
    ``refits`` times, and the better of the two is kept, so that a score never falls (by more than rounding).

    ``threshold`` is the distance below which a pair is an inlier, in target units; with ``relative`` a fraction of the
    hypothesis's own scale (the object's diameter, if the source has unit diameter). ``rank``: "msac" = the truncated
    quadratic score; "count" = the inlier share, then the smaller sum of squares over all pairs, then the first.

    Rejected, whatever their score: sets that do not determine a rotation; sets whose edges grow by factors less alike
    than ``edge_ratio`` (smallest over largest, in [0, 1]; 0 = off); sets more collinear than ``spread`` (the ratio in
    [0, 1] that ``similarity.fit_batch_last`` defines; 0 = off); scales outside ``scale_bounds`` (target units per
    source unit). A rejected hypothesis has score -1, no inliers, success false, and finite numbers.

    Raises ValueError at trace time if the shapes do not fit together, or if ``keep`` exceeds the number of sets.

    Fischler and Bolles 1981; Chum, Matas and Kittler, "Locally optimized RANSAC", 2003; the rank "count" is that of
    scikit-image's ``ransac``.
    """
    if source.ndim != 2 or source.shape != target.shape or source.shape[-1] != 3 or weight.shape != source.shape[:1]:
        raise ValueError(
            "consensus needs source and target (k, 3) and weight (k,); "
            f"got {source.shape}, {target.shape} and {weight.shape}"
        )
    present = (weight > 0) & jnp.all(jnp.isfinite(source) & jnp.isfinite(target), axis=-1)
    weight = jnp.where(present, weight, 0)
    source = jnp.where(present[:, None], source, 0)
    target = jnp.where(present[:, None], target, 0)
    with jax.named_scope("draw"):
        table = draw_minimal_sets(key, weight, count, size) if sets is None else sets
    if table.ndim != 2 or not 0 < keep <= table.shape[0] or table.shape[1] < 3:
        raise ValueError(f"consensus needs sets (n, m) with m >= 3 and keep <= n; got {table.shape} and keep={keep}")
    lower, upper = (jnp.asarray(bound, source.dtype) for bound in scale_bounds)
    threshold = jnp.asarray(threshold, source.dtype)

    def rank_scores(scores, scale, allowed):
        truncated, inside, loss = scores
        allowed = allowed & (scale >= lower) & (scale <= upper)
        first = truncated if rank == "msac" else inside
        second = jnp.zeros_like(loss) if rank == "msac" else loss
        return jnp.where(allowed, first, -1), jnp.where(allowed, second, jnp.inf), allowed

    def limit_of(scale):
        return threshold * scale if relative else jnp.broadcast_to(threshold, scale.shape)

    def judge(rotation, translation, scale):
        limit = limit_of(scale)
        squared = residuals(rotation, translation, scale, source, target)
        return squared, limit, squared < jnp.square(limit)[:, None]

    with jax.named_scope("fit"):
        chosen_source = jnp.moveaxis(source.T[:, table.T], 0, 1)  # (m, 3, n): the batch axis last
        chosen_target = jnp.moveaxis(target.T[:, table.T], 0, 1)
        chosen_source, chosen_target = jax.lax.optimization_barrier((chosen_source, chosen_target))
        ones = jnp.ones(table.T.shape, source.dtype)
        rotation, translation, scale, spread_found, success = fit_batch_last(chosen_source, chosen_target, ones)
        success = success & (spread_found >= spread) & jnp.all(weight[table] > 0, axis=1)
        success = success & _edges_agree(chosen_source, chosen_target, edge_ratio)
        rotation, translation, scale, success = jax.lax.optimization_barrier((rotation, translation, scale, success))
    with jax.named_scope("judge"):
        limit = limit_of(scale)
        scores = score_batch_last(rotation, translation, scale, source, target, weight, limit)
        score, loss, success = rank_scores(scores, scale, success)
        # A full sort costs six times as much; only "count" needs its second key.
        order = jax.lax.top_k(score, keep)[1] if rank == "msac" else _order(score, loss)[:keep]
        rotation, translation = jnp.moveaxis(rotation[..., order], -1, 0), jnp.moveaxis(translation[..., order], -1, 0)
        inliers = judge(rotation, translation, scale[order])[2]
        best = (rotation, translation, scale[order], score[order], loss[order], inliers)
        success = success[order]

    def refit(_, best):
        score, loss, inliers = best[3:]
        fitted = fit_batch_last(source[:, :, None], target[:, :, None], jnp.where(inliers, weight, 0).T)
        rotation, translation = jnp.moveaxis(fitted[0], -1, 0), jnp.moveaxis(fitted[1], -1, 0)
        squared, limit, inliers = judge(rotation, translation, fitted[2])
        scores = score_sets(squared, weight, limit)
        new_score, new_loss, allowed = rank_scores(scores, fitted[2], fitted[4] & success)
        # Sums of the same weights in another order may differ in the last digit; the loss decides then.
        tied = jnp.abs(new_score - score) <= 8 * jnp.finfo(score.dtype).eps
        better = allowed & jnp.where(tied, new_loss < loss, new_score > score)
        new = (rotation, translation, fitted[2], new_score, new_loss, inliers)
        return tuple(
            jnp.where(better.reshape(-1, *[1] * (old.ndim - 1)), fresh, old)
            for old, fresh in zip(best, new, strict=True)
        )

    with jax.named_scope("refit"):
        best = jax.lax.fori_loop(0, refits, refit, best)
    order = _order(best[3], best[4])
    rotation, translation, scale, score, _, inliers = (field[order] for field in best)
    success = success[order]
    inliers = inliers & present & success[:, None]
    return Hypotheses(rotation, translation, scale, score, inliers, success)


def _order(score, loss):
    """Indices by score, highest first, then by loss, lowest first, then by index."""
    indices = jnp.arange(score.shape[0], dtype=jnp.int32)
    return jax.lax.sort((-score, loss, indices), num_keys=3)[2]


def _edges_agree(source, target, edge_ratio):
    smallest, largest = jnp.inf, jnp.zeros((), source.dtype)
    for i, j in combinations(range(source.shape[0]), 2):
        before = jnp.sum((source[i] - source[j]) ** 2, axis=0)
        after = jnp.sum((target[i] - target[j]) ** 2, axis=0)
        growth = after / jnp.where(before > 0, before, 1)
        smallest, largest = jnp.minimum(smallest, growth), jnp.maximum(largest, growth)
    return smallest >= jnp.square(jnp.asarray(edge_ratio, source.dtype)) * largest


def _scale_bits(draw, total):
    """⌊draw · total / 2³²⌋ for 32 random bits and 0 <= total < 2³¹, without 64-bit integers."""
    total = total.astype(jnp.uint32)
    half = jnp.uint32(16)
    mask = jnp.uint32(0xFFFF)
    draw_high, draw_low = draw >> half, draw & mask
    total_high, total_low = total >> half, total & mask
    middle = draw_high * total_low + ((draw_low * total_low) >> half)
    middle_low = (middle & mask) + draw_low * total_high
    high = draw_high * total_high + (middle >> half) + (middle_low >> half)
    return high.astype(jnp.int32)


def _sort_network(arrays):
    """A few equally shaped arrays, sorted element by element."""
    arrays = list(arrays)
    for end in range(len(arrays) - 1, 0, -1):
        for i in range(end):
            arrays[i], arrays[i + 1] = jnp.minimum(arrays[i], arrays[i + 1]), jnp.maximum(arrays[i], arrays[i + 1])
    return arrays
