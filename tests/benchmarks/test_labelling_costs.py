"""FLOP are counted as often as loops are run, and what bounds a stage is told from them."""

import jax
import jax.numpy as jnp
import pytest
from jax import lax

from benchmarks.counting import Cost, counted
from benchmarks.labelling_costs import Row, bound, hour_lines, stage_lines

X = jnp.ones((32, 32))
cube = lambda x: jnp.zeros((32, *x.shape))
ONE = 2 * 32**3  # a product


@pytest.mark.parametrize(
    ("function", "products"),
    [
        (lambda x: x @ x, 1),
        (lambda x: lax.scan(lambda c, _: (c @ c, None), x, None, length=10)[0], 10),
        (lambda x: lax.fori_loop(0, 7, lambda _, c: c @ c, x @ x), 8),
        (lambda x: lax.fori_loop(0, 3, lambda _, c: lax.fori_loop(0, 5, lambda _, d: d @ d, c) @ c, x), 18),
        (lambda x: jax.jit(lambda y: lax.map(lambda row: y @ y @ row, y))(x), 32 + 1),
        (lambda x: lax.platform_dependent(x, cpu=lambda y: lax.map(lambda _: y @ y, y), default=cube), 32),
        (lambda x: lax.cond(jnp.sum(x) > 0, jax.jit(lambda y: y @ y), lambda y: y @ y @ y @ y, x), 1),
        (lambda x: jax.jit(lambda y: lax.switch(jnp.int32(y[0, 0]), [lambda: y @ y @ y @ y, lambda: y @ y @ y]))(x), 2),
    ],
    ids=["straight", "scan", "fori", "nested", "within jit", "by platform", "branch", "branch within jit"],
)
def test_the_body_of_a_loop_counts_as_often_as_it_is_run(function, products):
    cost = counted(function, X)
    assert cost.flop == pytest.approx(products * ONE, rel=0.05)
    assert cost.bytes >= 2 * X.nbytes


def test_what_bounds_a_stage_and_what_follows_for_many_frames():
    arithmetic = Row("products", Cost(1e9, 1e6), 0.02)
    memory = Row("sums", Cost(1e6, 1e9), 0.2)
    small = Row("turns", Cost(1e6, 1e6), 0.5)
    rates = 1e11, 1e10
    assert bound(arithmetic, *rates) == "arithmetic, 50 %"
    assert bound(memory, *rates) == "memory, 50 %"
    assert bound(small, *rates).startswith("neither (memory, 0.0 %)")
    lines = stage_lines([arithmetic, memory, small, Row("crop", None, 0.28)], *rates)
    assert lines[-1].startswith("| **all** | 1 | 1e+03 | 1 | 1e+03 |")
    # A second of a core for each object: on two cores 7200 frames of one object an hour, 5.79 days for a million.
    assert hour_lines(1.0, 2)[2] == "| 1 | 7,200 | 57,600 | 460,800 | 5.79 |"
    assert hour_lines(1.0, 2)[3].startswith("| 3 | 2,400 |")
