"""Recalls and areas under their curves."""

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax import metrics


def area_by_integration(errors: np.ndarray, limit: float) -> float:
    """The toolbox's curve, sampled: between two errors it takes the higher accuracy."""
    grid = (np.arange(100_000) + 0.5) / 100_000 * limit
    ordered = np.sort(errors[errors <= limit])
    following = np.searchsorted(ordered, grid, side="left") + 1
    return float(np.mean(np.minimum(following, len(ordered))) / len(errors))


@given(hnp.arrays(np.float32, 12, elements=st.floats(0, 0.25, width=32)))
def test_area_under_accuracy_is_an_integral(errors):
    found = metrics.area_under_accuracy(jnp.asarray(errors), 0.1)
    np.testing.assert_allclose(found, area_by_integration(errors, 0.1), atol=1e-3)


def test_area_under_accuracy_by_hand():
    area = lambda *errors: float(metrics.area_under_accuracy(jnp.asarray(errors, dtype=jnp.float32)))
    assert area(0.0, 0.0) == 1.0
    assert area(jnp.inf, 0.2) == 0.0
    assert area(0.05) == pytest.approx(1.0)  # the higher value: PoseCNN's toolbox, not the plain integral
    assert area(0.05, jnp.inf) == pytest.approx(0.5)
    assert area() == 0.0


def test_recall_is_strict():
    errors = jnp.array([0.0, 5.0, 10.0, jnp.inf, jnp.nan])
    np.testing.assert_allclose(metrics.recall(errors, jnp.array([5.0, 10.0, 100.0])), [0.2, 0.4, 0.6])


def test_the_size_is_right_strictly_within_its_tolerance():
    found = jax.vmap(metrics.scale_error, (None, 0))(jnp.ones(()), jnp.asarray([1.0, 0.985, 1.03, 0.93, 1.3]))
    np.testing.assert_allclose(
        metrics.recall(found, jnp.asarray(metrics.SIZE_TOLERANCES, jnp.float32)), [0.4, 0.6, 0.8]
    )


def test_recalls_of_doubles_on_the_host():
    # NumPy's doubles and lists come from anybody's files; warnings are errors here.
    for errors in (np.array([0.1, 0.3, np.inf, np.nan]), [0.1, 0.3, np.inf, np.nan]):
        assert metrics.average_recall.__wrapped__(errors) == pytest.approx(0.3)
    assert metrics.area_under_accuracy.__wrapped__(np.array([0.01, 0.05])) == pytest.approx(0.95)
