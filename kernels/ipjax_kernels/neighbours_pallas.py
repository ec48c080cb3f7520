"""The fused form of ``neighbours.nearest`` for CUDA devices: product, both maxima and both indices in one kernel.

Similarities stay in registers. A program owns a block of query patches of one template and walks over the template's
patches: its row maxima are final, its column maxima are one candidate per block, reduced by a few lines of XLA after.
"""

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Bool, Float, Int

_CHANNELS = 128  # channels per product: Triton's tiles are powers of two, and 384 is not


def search(
    query: Float[Array, "p c"],
    templates: Float[Array, "v q c"],
    query_valid: Bool[Array, "p"],
    template_valid: Bool[Array, "v q"],
    *,
    dtype: jnp.dtype | type = jnp.float32,
    block: int = 128,
    interpret: bool = False,
) -> tuple[Int[Array, "v p"], Float[Array, "v p"], Int[Array, "v q"], Float[Array, "v q"]]:
    """Indices and similarities, query to template and template to query; unmatched entries are not defined.

    ``interpret`` runs the kernel's steps as ordinary JAX operations, on any device, slowly: for tests.
    """
    views, others, channels = templates.shape
    patches = query.shape[0]
    rows = min(block, pl.next_power_of_2(max(patches, 16)))
    columns = min(block, pl.next_power_of_2(max(others, 16)))
    depth = min(_CHANNELS, pl.next_power_of_2(max(channels, 16)))
    query = _pad(query.astype(dtype), (rows, depth))
    templates = _pad(templates.astype(dtype), (1, columns, depth))
    # 0 or -inf, added to the product: exact, and one instruction. Padding is invalid.
    query_bias = jnp.where(_pad(query_valid, (rows,)), 0.0, -jnp.inf).astype(jnp.float32)
    template_bias = jnp.where(_pad(template_valid, (1, columns)), 0.0, -jnp.inf).astype(jnp.float32)
    (padded, width), height = query.shape, templates.shape[1]
    parts, steps = padded // rows, height // columns
    precision = jax.lax.Precision.HIGHEST if dtype == jnp.float32 else None

    def kernel(query_ref, template_ref, query_bias_ref, template_bias_ref, *outputs):
        forth_index, forth_similarity, back_index, back_similarity = outputs
        bias = query_bias_ref[:]
        start = pl.program_id(1) * rows
        pieces = [pl.ds(i * depth, depth) for i in range(width // depth)]
        held = [query_ref[:, piece] for piece in pieces]  # loaded once, kept for all steps

        def step(i, best):
            place = pl.ds(i * columns, columns)
            similarity = jnp.zeros((rows, columns), jnp.float32)
            for mine, piece in zip(held, pieces, strict=True):
                theirs = template_ref[place, piece]
                similarity += jax.lax.dot_general(
                    mine, theirs, (((1,), (1,)), ((), ())), precision=precision, preferred_element_type=jnp.float32
                )
            similarity = similarity + bias[:, None] + template_bias_ref[place][None, :]
            across = jnp.max(similarity, axis=1)
            down = jnp.max(similarity, axis=0)
            column = jax.lax.broadcasted_iota(jnp.int32, (rows, columns), 1)
            row = jax.lax.broadcasted_iota(jnp.int32, (rows, columns), 0)
            across_index = jnp.min(jnp.where(similarity == across[:, None], column, columns - 1), axis=1)
            down_index = jnp.min(jnp.where(similarity == down[None, :], row, rows - 1), axis=0)
            back_index[place] = down_index + start
            back_similarity[place] = down
            better = across > best[1]  # strictly: ties stay with the lower index
            return jnp.where(better, across_index + i * columns, best[0]), jnp.where(better, across, best[1])

        nothing = jnp.zeros(rows, jnp.int32), jnp.full(rows, -jnp.inf, jnp.float32)
        index, similarity = jax.lax.fori_loop(0, steps, step, nothing)
        forth_index[:] = index
        forth_similarity[:] = similarity

    row_block = pl.BlockSpec((None, rows), lambda view, part: (view, part))
    column_block = pl.BlockSpec((None, None, height), lambda view, part: (view, part, 0))
    forth_index, forth_similarity, back_index, back_similarity = pl.pallas_call(
        kernel,
        grid=(views, parts),
        in_specs=[
            pl.BlockSpec((rows, width), lambda view, part: (part, 0)),
            pl.BlockSpec((None, height, width), lambda view, part: (view, 0, 0)),
            pl.BlockSpec((rows,), lambda view, part: (part,)),
            pl.BlockSpec((None, height), lambda view, part: (view, 0)),
        ],
        out_specs=[row_block, row_block, column_block, column_block],
        out_shape=[
            jax.ShapeDtypeStruct((views, padded), jnp.int32),
            jax.ShapeDtypeStruct((views, padded), jnp.float32),
            jax.ShapeDtypeStruct((views, parts, height), jnp.int32),
            jax.ShapeDtypeStruct((views, parts, height), jnp.float32),
        ],
        compiler_params=plgpu.CompilerParams(num_warps=8, num_stages=2),
        interpret=interpret,
        name="nearest",
    )(query, templates, query_bias, template_bias)
    # argmax takes the first part among equals, and parts are in the order of the query's patches.
    winner = jnp.argmax(back_similarity, axis=1, keepdims=True)
    back_index, back_similarity = (jnp.take_along_axis(x, winner, axis=1)[:, 0] for x in (back_index, back_similarity))
    return forth_index[:, :patches], forth_similarity[:, :patches], back_index[:, :others], back_similarity[:, :others]


def _pad(array, multiples):
    return jnp.pad(array, [(0, -size % multiple) for size, multiple in zip(array.shape, multiples, strict=True)])
