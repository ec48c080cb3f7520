"""Errors with the size."""

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
from builders.poses import ERRORS, NONE, POINTS, TURN, poses, random_pose, rows_of, symmetries_of
from hypothesis import given
from hypothesis import strategies as st

from ipjax import metrics
from ipjax.transforms import Similarity


def test_scale_is_part_of_the_pose():
    pose = random_pose(3)
    unit = Similarity(pose.rotation, pose.translation, jnp.asarray(0.25))
    symmetries = poses(np.eye(3)[None], np.zeros((1, 3)))
    assert metrics.mssd(POINTS, symmetries, unit, unit) == 0
    assert metrics.add_s(POINTS, unit, unit) < 1e-6
    larger = Similarity(pose.rotation, pose.translation, jnp.asarray(0.275))
    np.testing.assert_allclose(
        metrics.mssd(POINTS, symmetries, unit, larger), 0.025 * jnp.max(jnp.linalg.norm(POINTS, axis=-1)), rtol=1e-4
    )
    np.testing.assert_allclose(metrics.scale_error(unit.scale, larger.scale), 0.1, rtol=1e-5)


sized = jax.jit(metrics.sized_errors)


@given(
    seed=st.integers(0, 1000),
    factor=st.floats(0.5, 2.0),
    size=st.floats(0.05, 5.0),
    centre=hnp.arrays(np.float32, 3, elements=st.floats(-0.125, 0.125, width=32)),
)
def test_a_wrong_size_alone_is_an_error_as_large_as_the_size_is_wrong(seed, factor, size, centre):
    """True rotation, size wrong by a factor about any point c: |f − 1| · |x − c|, largest and mean."""
    truth = random_pose(seed)
    truth = Similarity(truth.rotation, truth.translation, jnp.asarray(size, jnp.float32))
    kept = truth.rotation @ jnp.asarray(centre)
    estimate = Similarity(
        truth.rotation, truth.translation + size * (1 - factor) * kept, jnp.asarray(factor * size, jnp.float32)
    )
    found = sized(0.4, POINTS, NONE, truth, estimate)
    arms = np.linalg.norm(np.asarray(POINTS) - centre, axis=-1) / 0.4
    np.testing.assert_allclose(found.mssd, abs(factor - 1) * arms.max(), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found.add, abs(factor - 1) * arms.mean(), rtol=1e-3, atol=1e-5)
    assert found.add_s <= found.add + 1e-5
    np.testing.assert_allclose(found.size, abs(factor - 1), atol=1e-5)


@given(seed=st.integers(0, 1000), grow=st.floats(0.0, 0.9))
def test_sized_errors_forgive_symmetries_and_nothing_else(seed, grow):
    """A symmetric pose of the wrong size is as wrong as the true pose of the wrong size; more so the more it is off."""
    symmetries, truth = poses(*TURN), random_pose(seed)
    turn = jnp.asarray(TURN[0][seed % len(TURN[0])], jnp.float32)
    errors = []
    for rotation in (truth.rotation, truth.rotation @ turn):
        for factor in (1 + grow, 1 + grow + 0.1):
            estimate = Similarity(rotation, truth.translation, jnp.asarray(factor, jnp.float32))
            errors.append(float(sized(0.4, POINTS, symmetries, truth, estimate).mssd))
    reach = float(jnp.max(jnp.linalg.norm(POINTS, axis=-1))) / 0.4
    np.testing.assert_allclose(errors, [grow * reach, (grow + 0.1) * reach] * 2, rtol=1e-3, atol=1e-5)


def test_sized_errors_are_bops_at_the_true_size_and_can_be_mapped():
    """One estimate after another, or all at once; where every size is right, BOP's own numbers in diameters."""
    rows, truth, estimate = rows_of(2)
    points, symmetries = jnp.asarray(ERRORS["obj2_pts"]), poses(*symmetries_of(2))
    diameter = float(ERRORS["obj2_diameter"])
    run = lambda t, e: metrics.sized_errors(diameter, points, symmetries, t, e)
    found = jax.jit(jax.vmap(run))(truth, estimate)
    for name, golden in (("mssd", "mssd"), ("add", "add"), ("add_s", "adi")):
        np.testing.assert_allclose(getattr(found, name), ERRORS[golden][rows] / diameter, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(found.size, np.zeros(len(rows)))
    expected = [np.mean(np.asarray(found.mssd) < t) for t in metrics.THRESHOLDS]
    np.testing.assert_allclose(metrics.average_recall(found.mssd), np.mean(expected), atol=1e-6)
