"""What an estimate says of its own certainty: laws of the formulas, and what each does at its ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.config import ConfidenceConfig
from ipjax.estimation.confidence import covariance, find_rival, pair_information, probability, rotation_ambiguity
from ipjax.records import Agreement, Pairs, Similarity
from ipjax.synthetic import problems
from ipjax.transforms import retract, rotation_from_vector

SURE = Agreement(*(jnp.asarray(x, jnp.float32) for x in (0.95, 0.9, 0.9, 0.8, 1.0, 0.1)))
CONFIG = ConfidenceConfig()


def make_pose(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    rotation = jnp.asarray(problems.random_rotation(rng), jnp.float32)
    return Similarity(rotation, jnp.asarray(rng.uniform(0.1, 0.9, 3), jnp.float32), jnp.asarray(0.2, jnp.float32))


def many(*poses: Similarity) -> Similarity:
    return jax.tree.map(lambda *x: jnp.stack(x), *poses)


@pytest.mark.parametrize("weights", [CONFIG.drawn, CONFIG.undrawn])
def test_a_better_agreement_is_never_less_probable(weights):
    weights = jnp.asarray(weights)
    sure = float(probability(SURE, weights))
    for name, worse in (("depth", 0.5), ("features", 0.4), ("drawn", 0.4), ("colour", -0.2), ("rival", 0.95)):
        other = dataclasses.replace(SURE, **{name: jnp.asarray(worse, jnp.float32)})
        assert 0 <= float(probability(other, weights)) <= sure <= 1
    nothing = jax.tree.map(jnp.zeros_like, SURE)
    assert np.isfinite(float(probability(nothing, weights)))


def test_the_present_are_told_from_the_absent():
    """The default threshold separates what agrees in everything from what agrees in nothing."""
    weights = jnp.asarray(CONFIG.drawn)
    poor = Agreement(*(jnp.asarray(x, jnp.float32) for x in (0.4, 0.2, 0.2, 0.0, 1.0, 0.9)))
    assert float(probability(poor, weights)) < CONFIG.least < float(probability(SURE, weights))


def test_the_rival_is_the_best_that_is_elsewhere():
    first = make_pose(0)
    near = dataclasses.replace(first, rotation=rotation_from_vector(jnp.array([0.1, 0, 0])) @ first.rotation)
    turned = dataclasses.replace(first, rotation=rotation_from_vector(jnp.array([0, 1.0, 0])) @ first.rotation)
    moved = dataclasses.replace(first, translation=first.translation + 0.05)
    found = find_rival(many(first, near, turned, moved), jnp.array([0.8, 0.7, 0.4, 0.2]))
    assert float(found) == pytest.approx(0.5)
    assert float(find_rival(many(first, near), jnp.array([0.8, 0.7]))) == 0
    assert float(find_rival(many(first, turned), jnp.array([0.8, -1.0]))) == 0


def make_pairs(pose: Similarity, seed: int, count: int = 40) -> Pairs:
    rng = np.random.default_rng(seed)
    points = jnp.asarray(rng.uniform(-0.4, 0.4, (count, 3)), jnp.float32)
    noise = 0.02 * float(pose.scale) * rng.normal(size=(count, 3))
    return Pairs(points, pose @ points + jnp.asarray(noise, jnp.float32), jnp.ones(count, jnp.float32))


@given(seed=st.integers(0, 2**31))
def test_pairs_inform_by_the_slopes_of_their_offsets(seed):
    pose = make_pose(seed)
    pairs = make_pairs(pose, seed)
    offsets = lambda step: ((retract(pose, step) @ pairs.object - pairs.camera) / pose.scale).reshape(-1)
    slopes = np.asarray(jax.jacfwd(offsets)(jnp.zeros(7)), np.float64)
    expected = slopes.T @ slopes / np.mean(np.asarray(offsets(jnp.zeros(7))) ** 2)
    found = pair_information(pose, pairs, jnp.ones(40, bool))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_unused_pairs_say_nothing():
    pose = make_pose(1)
    assert float(jnp.abs(pair_information(pose, make_pairs(pose, 1), jnp.zeros(40, bool))).max()) == 0


def test_the_covariance_is_that_of_repeated_fits():
    """With all pairs independent and nothing else known, it is the spread of least-squares fits to new noise."""
    pose = make_pose(2)
    config = dataclasses.replace(CONFIG, pair_share=1.0)
    depth = jnp.zeros((7, 7)), jnp.asarray(1.0)
    tell = jax.jit(covariance, static_argnames="scale_known")
    told = [
        tell(depth, pair_information(pose, pairs, jnp.ones(40, bool)), pose.scale, config, scale_known=False)
        for pairs in (make_pairs(pose, seed) for seed in range(200))
    ]

    @jax.jit
    def best_step(pairs):
        offsets = lambda step: (retract(pose, step) @ pairs.object - pairs.camera).reshape(-1)
        return jax.jacfwd(offsets)(jnp.zeros(7)), offsets(jnp.zeros(7))

    steps = []
    for seed in range(200):
        slopes, now = (np.asarray(x, np.float64) for x in best_step(make_pairs(pose, seed)))
        steps.append(np.linalg.lstsq(slopes, -now, rcond=None)[0])
    real = np.cov(np.array(steps).T)
    unit = np.array([1, 1, 1, *[float(pose.scale)] * 3])
    real_spread = np.sqrt(np.diag(real)[:6]) * unit
    spread = np.sqrt(np.mean([np.diag(np.asarray(c)) for c, _ in told], axis=0))
    np.testing.assert_allclose(spread, real_spread, rtol=0.2)
    scale = np.mean([float(s) for _, s in told])
    assert scale == pytest.approx(np.sqrt(real[6, 6]) * float(pose.scale), rel=0.2)


def test_nothing_known_is_finite_and_wide():
    spread, scale = covariance(
        (jnp.zeros((7, 7)), jnp.asarray(0.0)), jnp.zeros((7, 7)), jnp.asarray(0.2), CONFIG, scale_known=False
    )
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), [1, 1, 1, 0.1, 0.1, 0.1], rtol=1e-4)
    assert float(scale) == pytest.approx(0.1, rel=1e-4)


def test_a_known_size_has_no_spread():
    pose = make_pose(3)
    pairs = pair_information(pose, make_pairs(pose, 3), jnp.ones(40, bool))
    free, _ = covariance((jnp.zeros((7, 7)), jnp.asarray(1.0)), pairs, pose.scale, CONFIG, scale_known=False)
    fixed, scale = covariance((jnp.zeros((7, 7)), jnp.asarray(1.0)), pairs, pose.scale, CONFIG, scale_known=True)
    assert float(scale) == 0
    assert np.all(np.diag(fixed) <= np.diag(free) * (1 + 1e-4))  # knowing more never widens


@given(seed=st.integers(0, 2**31), angle=st.sampled_from([0.4, np.pi / 2, np.pi]))
def test_alternatives_turned_about_one_axis_name_it(seed, angle):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    pose = make_pose(seed)
    turned = pose.rotation @ rotation_from_vector(jnp.asarray(angle * axis, jnp.float32))
    both = many(pose, dataclasses.replace(pose, rotation=turned))
    found = rotation_ambiguity(both, jnp.array([0.8, 0.8]), 1e-6 * jnp.eye(3), CONFIG)
    length = float(jnp.linalg.norm(found))
    assert abs(float(found @ axis)) / length > 0.999
    assert length == pytest.approx(angle / 2**0.5, rel=1e-2)  # two equals, one turned by the angle
    alone = rotation_ambiguity(both, jnp.array([0.8, -1.0]), 1e-6 * jnp.eye(3), CONFIG)
    assert float(jnp.linalg.norm(alone)) < 0.01


def test_without_alternatives_the_covariance_decides():
    pose = make_pose(4)
    own = pose.rotation @ jnp.diag(jnp.array([0.01, 0.0001, 0.0001])) @ pose.rotation.T
    found = rotation_ambiguity(many(pose, pose), jnp.array([0.8, -1.0]), own, CONFIG)
    np.testing.assert_allclose(np.abs(found), [0.1, 0, 0], atol=1e-3)
