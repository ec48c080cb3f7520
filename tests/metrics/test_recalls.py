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


@given(hnp.arrays(np.float32, 12, elements=st.floats(0, 0.25, width=32)))
def test_the_exact_area_is_the_integral_of_recalls(errors):
    grid = (np.arange(20_000, dtype=np.float32) + 0.5) / 20_000 * 0.1
    for found in (metrics.auc(errors, 0.1), metrics.auc(jnp.asarray(errors), 0.1)):
        np.testing.assert_allclose(found, metrics.recall(errors, grid).mean(), atol=1e-4)
    # The toolbox's curve is one step ahead, up to the largest error below the limit.
    toolbox = metrics.area_under_accuracy(jnp.asarray(errors), 0.1)
    largest = max((float(e) for e in errors if e <= 0.1), default=0.0)
    np.testing.assert_allclose(toolbox - metrics.auc(errors, 0.1), largest / 0.1 / 12, atol=1e-5)


def test_the_exact_area_by_hand():
    area = lambda *errors: float(metrics.auc(np.array(errors, np.float64)))
    assert area(0.0, 0.0) == 1.0
    assert area(0.05) == pytest.approx(0.5, abs=1e-15)
    assert area(0.02, np.inf) == pytest.approx(0.4, abs=1e-15)
    assert area(0.02, np.nan, 0.1, 7.0) == pytest.approx(0.2, abs=1e-15)
    assert area() == 0.0
    many = metrics.auc(np.array([[0.0, 0.05], [0.1, 0.08]]))
    np.testing.assert_allclose(many, [0.75, 0.1], atol=1e-15)
    assert float(metrics.auc(np.array([30.0]), 100.0)) == pytest.approx(0.7)  # any unit that both share


def test_five_degrees_and_five_centimetres_are_strict_and_both():
    degrees = np.array([4.9, 5.1, 4.9, 0.0, np.inf, np.nan, 0.0])
    metres = np.array([0.049, 0.049, 0.051, 0.05, np.inf, 0.0, 0.0])
    for asarray in (np.asarray, lambda x: jnp.asarray(x, jnp.float32)):
        share = metrics.pose_recall(asarray(np.radians(degrees)), asarray(metres))
        assert float(share) == pytest.approx(2 / 7)
    assert float(metrics.pose_recall(np.zeros(0), np.zeros(0))) == 0.0
    assert float(metrics.pose_recall(np.radians(degrees), metres, np.radians(6), 0.05)) == pytest.approx(3 / 7)


def test_recalls_of_doubles_are_in_doubles():
    limit = metrics.GRASP_LIMIT
    errors = np.array([np.nextafter(limit, 0), limit, np.nextafter(limit, 1)])
    found = metrics.recall(errors, np.array([limit]))
    assert isinstance(found, np.ndarray) and found.dtype == np.float64
    assert found[0] == 1 / 3


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
