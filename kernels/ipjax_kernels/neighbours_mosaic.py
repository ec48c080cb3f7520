"""The fused form of ``neighbours.nearest`` for Hopper GPUs, in Pallas Mosaic GPU.

One block of threads owns a tile: some patches of the query against some of one template. It multiplies them on the
tensor cores, 64 channels at a time, and of the similarities, which stay in registers, only the maxima of the tile's
rows and columns and their indices are written. A few lines of XLA then choose among the tiles.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu as plgpu
from jaxtyping import Array, Bool, Float, Int

_ROWS, _COLUMNS = 128, 128  # a tile: patches of the query and of the template; its similarities fill the registers
_DEPTH = 64  # channels per product: a row of shared memory's widest swizzle, 128 bytes
_AHEAD = 3  # products whose operands are on their way: two such blocks share a multiprocessor's memory
_FORBIDDEN = -1e30  # similarity to an invalid patch: below every product of features


def search(
    query: Float[Array, "p c"],
    templates: Float[Array, "v q c"],
    query_valid: Bool[Array, "p"],
    template_valid: Bool[Array, "v q"],
    *,
    interpret: Any = None,
) -> tuple[Int[Array, "v p"], Float[Array, "v p"], Int[Array, "v q"], Float[Array, "v q"]]:
    """Indices and similarities, query to template and template to query, of features rounded to bfloat16.

    Unmatched entries are not defined. ``interpret``: parameters of Pallas' simulation of a GPU, which runs anywhere,
    slowly: for tests.
    """
    views, others, _ = templates.shape
    patches = query.shape[0]
    query = _extend(_pad(query, (_ROWS, 1)), _pad(query_valid, (_ROWS,)), first=True)
    templates = _extend(_pad(templates, (1, _COLUMNS, 1)), _pad(template_valid, (1, _COLUMNS)), first=False)
    templates = jnp.swapaxes(templates, 1, 2)  # part of the copy above: channels by patches, as a product reads them
    (height, channels), width = query.shape, templates.shape[2]
    parts, steps = height // _ROWS, width // _COLUMNS
    shape = _ROWS, _COLUMNS
    # Only a device has layouts, and the simulation of JAX 0.10 does not know the word.
    iota = partial(plgpu.broadcasted_iota, layout=plgpu.Layout.WGMMA) if interpret is None else lax.broadcasted_iota
    # JAX 0.12 declares a method of their base class without defining it.
    tiling = plgpu.TilingTransform((8, _DEPTH))  # pyright: ignore[reportAbstractUsage]
    transforms = tiling, plgpu.SwizzleTransform(2 * _DEPTH)  # pyright: ignore[reportAbstractUsage]

    def nearest(query_ref, template_ref, forth_index, forth_similarity, back_index, back_similarity):
        view, part, step = (lax.axis_index(name) for name in ("view", "part", "step"))
        rows, columns = pl.ds(part * _ROWS, _ROWS), pl.ds(step * _COLUMNS, _COLUMNS)

        def product(accumulator):
            def multiply(_, query_tile, template_tile):
                plgpu.wgmma(accumulator, query_tile, template_tile)
                plgpu.wgmma_wait(1)  # all but this one: its operands are released a step later

            plgpu.emit_pipeline(
                multiply,
                grid=(channels // _DEPTH,),
                in_specs=[
                    plgpu.BlockSpec((_ROWS, _DEPTH), lambda i: (part, i), transforms=transforms, delay_release=1),
                    plgpu.BlockSpec((_DEPTH, _COLUMNS), lambda i: (i, step), transforms=transforms, delay_release=1),
                ],
                max_concurrent_steps=_AHEAD,
            )(query_ref, template_ref.at[view])
            return accumulator[...]

        similarity = pl.run_scoped(product, plgpu.ACC(shape, jnp.float32))
        across, down = jnp.max(similarity, axis=1), jnp.max(similarity, axis=0)
        # The lowest index among equals.
        column = iota(jnp.int32, shape, 1)
        is_best = similarity == lax.broadcast_in_dim(across, shape, (0,))
        forth_index[view, step, rows] = jnp.min(jnp.where(is_best, column, _COLUMNS - 1), axis=1) + step * _COLUMNS
        forth_similarity[view, step, rows] = across
        row = iota(jnp.int32, shape, 0)
        is_best = similarity == lax.broadcast_in_dim(down, shape, (1,))
        back_index[view, part, columns] = jnp.min(jnp.where(is_best, row, _ROWS - 1), axis=0) + part * _ROWS
        back_similarity[view, part, columns] = down

    found = plgpu.kernel(
        nearest,
        out_type=[
            jax.ShapeDtypeStruct(size, dtype)
            for size in ((views, steps, height), (views, parts, width))
            for dtype in (jnp.int32, jnp.float32)
        ],
        # The last one runs fastest: one tile of a template after another, with all of the query in the cache.
        grid=(views, steps, parts),
        grid_names=("view", "step", "part"),
        interpret=interpret,
    )(query, templates)
    forth_index, forth_similarity = _choose(*found[:2])
    back_index, back_similarity = _choose(*found[2:])
    return forth_index[:, :patches], forth_similarity[:, :patches], back_index[:, :others], back_similarity[:, :others]


def _extend(features, valid, *, first):
    """Masks as two more channels: their share of a product is 0 between valid patches, and hugely negative else."""
    features = jnp.where(valid[..., None], features, 0).astype(jnp.bfloat16)
    mask = jnp.where(valid, 0.0, _FORBIDDEN).astype(jnp.bfloat16)
    pair = (mask, jnp.ones_like(mask)) if first else (jnp.ones_like(mask), mask)
    extended = jnp.concatenate([features, jnp.stack(pair, axis=-1)], axis=-1)
    return _pad(extended, (*[1] * valid.ndim, _DEPTH))


def _choose(index, similarity):
    """The best of the tiles; argmax takes the first among equals, and tiles are in the order of their patches."""
    winner = jnp.argmax(similarity, axis=1, keepdims=True)
    return tuple(jnp.take_along_axis(x, winner, axis=1)[:, 0] for x in (index, similarity))


def _pad(array, multiples):
    return jnp.pad(array, [(0, -size % multiple) for size, multiple in zip(array.shape, multiples, strict=True)])
