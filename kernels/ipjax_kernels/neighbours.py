"""Nearest neighbours between a query's patches and every template's, both ways, from one product per template.

Only maxima and indices leave the inner loop; the volume of similarities never exists as a whole.
"""

import math
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ipjax_kernels.positive import root

_SHARES = (0.375, 0.5, 0.625, 0.75)  # of the query's patches: sizes that its valid patches are compacted to
_LEAST_PATCHES = 64  # patches; fewer are not worth the branches
NO_MATCH = -2.0  # the similarity of a patch that has no neighbour: finite, and below every cosine


class Neighbours(NamedTuple):
    """Nearest neighbours both ways; a patch without one has index 0 and similarity ``NO_MATCH``."""

    query_to_template: Int[Array, "*b v p"]  # patch of the template
    query_similarity: Float[Array, "*b v p"]
    template_to_query: Int[Array, "*b v q"]  # patch of the query
    template_similarity: Float[Array, "*b v q"]


@partial(jax.jit, static_argnames=("memory_bytes", "dtype", "implementation", "compact"))
def nearest(
    query: Float[Array, "p c"],
    templates: Float[Array, "v q c"],
    query_valid: Bool[Array, "p"],
    template_valid: Bool[Array, "v q"],
    *,
    memory_bytes: int = 64 * 2**20,
    dtype: Literal["float32", "bfloat16"] = "float32",
    implementation: Literal["xla", "pallas"] = "xla",
    compact: bool = True,
) -> Neighbours:
    """For each query patch the most similar patch of every template, and the other way round.

    Similarities are dot products: cosines if the features are of unit norm. Masks enter before the maximum, so an
    invalid patch is never matched; ties go to the lowest index. A patch that is itself invalid, or that faces nothing
    valid, has index 0 and similarity ``NO_MATCH`` = -2.

    ``memory_bytes`` bounds the similarities in memory: a CPU takes one template at a time, an accelerator as many as
    fit, and a template that does not fit is taken in parts. Under ``vmap`` the queries follow one another
    and share that memory. ``dtype`` is what the features are rounded to before the product, template by template;
    sums are float32 always. ``implementation``: "xla" runs anywhere and can be exported; "pallas" is one fused kernel
    on Hopper GPUs (compute capability 9.0), for bfloat16, which keeps similarities out of memory altogether, and
    "xla" on all other devices. On an H200 it takes 0.4 to 0.5 of the time of "xla": kernels/README.md.
    ``compact`` ("xla" only) multiplies the valid patches of the query and few others: one of five sizes, chosen at
    run time, so nothing is ever left out. The templates' invalid patches are the caller's to leave out, once.

    No derivative flows through the similarities; take the cosine of the matched features for one.

    Raises ValueError at trace time for shapes that do not fit together, a bound below one row of similarities, or
    "pallas" in float32.

    InstantPose Eq. 2-3; Goodwin et al., "Zero-Shot Category-Level Object Pose Estimation", ECCV 2022, section 3.2.
    """
    if query.ndim != 2 or templates.ndim != 3 or query.shape[-1] != templates.shape[-1]:
        raise ValueError(
            "nearest needs query features (p, c) and template features (v, q, c) with the same c; "
            f"got {query.shape} and {templates.shape}"
        )
    if query_valid.shape != query.shape[:1] or template_valid.shape != templates.shape[:2]:
        raise ValueError(
            f"nearest needs one flag per patch, {query.shape[:1]} and {templates.shape[:2]}; "
            f"got {query_valid.shape} and {template_valid.shape}"
        )
    if 0 in query.shape or 0 in templates.shape:
        raise ValueError(f"nearest needs at least one patch and one template; got {query.shape} and {templates.shape}")
    query, templates = jax.lax.stop_gradient((query, templates))
    blocks = partial(_search_blocks, memory_bytes=memory_bytes, dtype=jnp.dtype(dtype), compact=compact)
    with jax.named_scope("nearest"):
        if implementation == "pallas":
            if dtype != "bfloat16":
                raise ValueError(f'implementation="pallas" multiplies bfloat16, not {dtype}: pass dtype="bfloat16"')
            if _has_other_gpu():
                found = blocks(query, templates, query_valid, template_valid)
            else:
                from ipjax_kernels.neighbours_mosaic import search  # Pallas is a heavy import that few need

                found = jax.lax.platform_dependent(
                    query, templates, query_valid, template_valid, cuda=search, default=blocks
                )
        elif implementation == "xla":
            found = blocks(query, templates, query_valid, template_valid)
        else:
            raise ValueError(f'implementation is "xla" or "pallas", not {implementation!r}')
        return _blank_missing(Neighbours(*found), query_valid, template_valid)


@jax.jit
def cycle_distance(
    query_to_template: Int[Array, "p"],
    template_to_query: Int[Array, "q"],
    grid: Float[Array, "p 2"],
    query_valid: Bool[Array, "p"],
    template_valid: Bool[Array, "q"],
) -> Float[Array, "p"]:
    """How far from where it set out a query patch ends after going to the template and back, in units of ``grid``.

    inf for an invalid patch and for one without a match. For one template; ``vmap`` over templates.

    InstantPose Eq. 4: the cycle starts at the query.
    """
    patches, others = query_valid.shape[0], template_valid.shape[0]
    if query_to_template.shape != (patches,) or template_to_query.shape != (others,) or grid.shape != (patches, 2):
        raise ValueError(
            f"cycle_distance needs neighbours ({patches},) and ({others},) and grid ({patches}, 2); "
            f"got {query_to_template.shape}, {template_to_query.shape} and {grid.shape}"
        )
    back = template_to_query[query_to_template]
    distance = root(jnp.sum((grid - grid[back]) ** 2, axis=-1))
    return jnp.where(query_valid & template_valid[query_to_template], distance, jnp.inf)


def _has_other_gpu():
    """Whether this machine has a GPU other than Hopper, for which alone the fused kernel was written."""
    try:
        devices = jax.devices("cuda")
    except RuntimeError:  # no GPU: what is traced here may be exported to one
        return False
    return any(getattr(device, "compute_capability", "9.0") != "9.0" for device in devices)


def _blank_missing(found, query_valid, template_valid):
    query_matched = query_valid[None, :] & jnp.any(template_valid, axis=1, keepdims=True)
    template_matched = template_valid & jnp.any(query_valid)
    return Neighbours(
        jnp.where(query_matched, found.query_to_template, 0),
        jnp.where(query_matched, found.query_similarity, NO_MATCH),
        jnp.where(template_matched, found.template_to_query, 0),
        jnp.where(template_matched, found.template_similarity, NO_MATCH),
    )


def _search_blocks(query, templates, query_valid, template_valid, *, memory_bytes, dtype, compact):
    row_bytes = 2 * 4 * query.shape[0]  # the similarities, and room for their masked copy
    if row_bytes > memory_bytes:
        raise ValueError(f"nearest needs memory_bytes >= {row_bytes} for {query.shape[0]} patches; got {memory_bytes}")

    @jax.custom_batching.sequential_vmap
    def search(query, templates, query_valid, template_valid):
        if templates.dtype == jnp.bfloat16:
            # As plain bits: the CPU compiler would widen all templates at once, before the loop.
            templates = jax.lax.bitcast_convert_type(templates, jnp.uint16)
        patches = query.shape[0]
        arguments = query.astype(dtype), query_valid, templates, template_valid
        if not compact or patches < _LEAST_PATCHES:
            return _search_all(*arguments, memory_bytes=memory_bytes)
        sizes = sorted({min(patches, 16 * math.ceil(share * patches / 16)) for share in (*_SHARES, 1.0)})
        count = jnp.sum(query_valid, dtype=jnp.int32)
        choice = jnp.sum(jnp.asarray(sizes[:-1], jnp.int32) < count, dtype=jnp.int32)
        branches = [partial(_search_first, size=size, memory_bytes=memory_bytes) for size in sizes]
        return jax.lax.switch(choice, branches, *arguments)

    return search(query, templates, query_valid, template_valid)


def _search_first(query, query_valid, templates, template_valid, *, size, memory_bytes):
    """Search for ``size`` patches of the query, all valid ones among them; indices are those of the whole query."""
    patches = query.shape[0]
    if size == patches:
        return _search_all(query, query_valid, templates, template_valid, memory_bytes=memory_bytes)
    index = jnp.arange(patches, dtype=jnp.int32)
    # Valid ones first, each kind in its old order, so that ties still go to the lowest index.
    chosen = jax.lax.sort((~query_valid, index), num_keys=1, is_stable=True)[1][:size]
    found = _search_all(query[chosen], query_valid[chosen], templates, template_valid, memory_bytes=memory_bytes)
    place = jnp.clip(jnp.cumsum(query_valid, dtype=jnp.int32) - 1, 0, size - 1)
    forth, similarity, back, back_similarity = found
    return forth[:, place], similarity[:, place], chosen[back], back_similarity


def _search_all(query, query_valid, templates, template_valid, *, memory_bytes):
    views, others, _ = templates.shape
    row_bytes = 2 * 4 * query.shape[0]
    rows = min(others, memory_bytes // row_bytes)
    together = min(views, memory_bytes // (row_bytes * others))
    step = partial(_search_template, query, query_valid, rows=rows)

    def search(templates, template_valid, batch_size=None):
        return tuple(jax.lax.map(lambda template: step(*template), (templates, template_valid), batch_size=batch_size))

    if together < 2:
        return search(templates, template_valid)
    # One template's similarities stay in a CPU's cache; an accelerator wants more work at a time.
    together = partial(search, batch_size=together)
    return tuple(jax.lax.platform_dependent(templates, template_valid, cpu=search, default=together))


def _search_template(query, query_valid, template, template_valid, *, rows):
    patches, others = query.shape[0], template.shape[0]
    if rows == others:
        return _search_block(query, query_valid, template, template_valid)
    # Even parts; the last one is padded with invalid patches.
    parts = math.ceil(others / rows)
    rows = math.ceil(others / parts)
    padding = parts * rows - others
    template = jnp.pad(template, ((0, padding), (0, 0))).reshape(parts, rows, -1)
    template_valid = jnp.pad(template_valid, (0, padding)).reshape(parts, rows)

    def advance(best, part):
        start, features, valid = part
        found = _search_block(query, query_valid, features, valid)
        better = found.query_similarity > best[1]
        index = jnp.where(better, found.query_to_template + start, best[0])
        similarity = jnp.where(better, found.query_similarity, best[1])
        return (index, similarity), (found.template_to_query, found.template_similarity)

    start = jnp.zeros(patches, jnp.int32), jnp.full(patches, -jnp.inf, jnp.float32)
    starts = jnp.arange(parts, dtype=jnp.int32) * rows
    forth, back = jax.lax.scan(advance, start, (starts, template, template_valid))
    return Neighbours(*forth, *(x.reshape(-1)[:others] for x in back))


def _search_block(query, query_valid, template, template_valid):
    if template.dtype == jnp.uint16:
        template = jax.lax.bitcast_convert_type(template, jnp.bfloat16)
    similarity = jax.lax.dot_general(
        query,
        template.astype(query.dtype),
        (((1,), (1,)), ((), ())),
        precision=jax.lax.Precision.HIGHEST,
        preferred_element_type=jnp.float32,
    )
    # The barriers keep the compiler from fusing the product's reader with it and from reducing value and index
    # together: a plain maximum and a comparison vectorise, an argmax does not.
    similarity = jax.lax.optimization_barrier(similarity)
    similarity = jnp.where(query_valid[:, None] & template_valid[None, :], similarity, -jnp.inf)
    best_of_template = jnp.max(similarity, axis=1)
    best_of_query = jnp.max(similarity, axis=0)
    similarity, best_of_template, best_of_query = jax.lax.optimization_barrier(
        (similarity, best_of_template, best_of_query)
    )
    shape = similarity.shape
    columns = jax.lax.broadcasted_iota(jnp.int32, shape, 1)
    rows = jax.lax.broadcasted_iota(jnp.int32, shape, 0)
    forth = jnp.min(jnp.where(similarity == best_of_template[:, None], columns, shape[1] - 1), axis=1)
    back = jnp.min(jnp.where(similarity == best_of_query[None, :], rows, shape[0] - 1), axis=0)
    return Neighbours(forth, best_of_template, back, best_of_query)
