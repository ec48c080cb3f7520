"""The whole estimate on problems with known answers: laws, contracts, and what a bad input does. One tiny shape."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.compilation import QUICKLY
from builders.tiny_pipeline import DRAWN, TINY, TRACES, TURNED, assert_near, estimate, make_sized_query, two_objects
from hypothesis import given, settings
from hypothesis import strategies as st

import ipjax
from benchmarks.bias import pose_errors, rotation_error, summary
from ipjax.config import Config, MatchConfig, ScoreConfig
from ipjax.estimation.features import cut, principal_basis
from ipjax.estimation.pipeline import comparable, distinct
from ipjax.records import Query, Similarity
from ipjax.synthetic import problems


@pytest.fixture(scope="module")
def templates():
    return problems.make_templates()


def same(one, other, tolerance):
    assert rotation_error(one, other) < np.degrees(tolerance)
    np.testing.assert_allclose(one.translation, other.translation, atol=tolerance)
    np.testing.assert_allclose(one.scale, other.scale, rtol=tolerance)


def gather_errors(found_and_true):
    """x, y, z and size of each in % of the diameter, and the rotation in degrees."""
    pairs = list(found_and_true)
    return np.array([pose_errors(*pair) for pair in pairs]), np.array([rotation_error(*pair) for pair in pairs])


@given(st.integers(0, 10_000))
@settings(max_examples=12)
def test_recovers_pose_and_size(templates, seed):
    """Eight directions with no rolls are far apart: of sixty poses the worst is off by 7 % of the diameter and 13°."""
    query, truth = problems.make_query(seed)
    found = estimate(templates, query, jax.random.key(0), TINY)
    assert bool(found.success)
    assert_near(found.camera_from_object, truth, 0.12, 0.15, 20)


@pytest.mark.skipif(jax.__version_info__ >= (0, 11), reason="this JAX has one kind of emitters, the tests' and users'")
def test_the_default_compilation_has_the_same_answer(templates):
    """Tests compile without optimisation and with XLA's older emitters on a CPU (see conftest.py), users with both."""
    default = jax.jit(
        lambda *records: ipjax.estimate(None, *records, jax.random.key(0), TINY),
        compiler_options={"xla_cpu_use_fusion_emitters": True},
    )
    for seed in range(3):
        query, truth = problems.make_query(seed)
        found, other = default(templates, query), estimate(templates, query, jax.random.key(0), TINY)
        assert_near(found.camera_from_object, truth, 0.12, 0.15, 20)
        np.testing.assert_allclose(found.camera_from_object.rotation, other.camera_from_object.rotation, atol=1e-3)
        np.testing.assert_allclose(
            found.camera_from_object.translation, other.camera_from_object.translation, atol=1e-4
        )


def test_estimates_are_off_to_no_side(templates):
    """From the whole image on: signed errors within three standard errors of zero, unsigned ones as small as reached.

    Reached over sixty images: medians of 0.44 % of the diameter, 0.41 % of the size and 1.5°.
    """
    encoder, look = problems.make_encoder(), jax.jit(ipjax.observe)

    def answers():
        for seed in range(40):
            whole = problems.make_frame(seed)
            view = ipjax.frame(whole.rgb, whole.depth, whole.mask, whole.matrix, resolution=112)
            found = estimate(templates, look(encoder, view), jax.random.key(0), TINY)
            yield found.camera_from_object, whole.camera_from_object

    errors, rotation = gather_errors(answers())
    mean, error = summary(list(errors))
    assert (np.abs(mean) <= 3 * error).all(), (mean, error)
    assert np.median(np.linalg.norm(errors[:, :3], axis=1)) < 0.8
    assert np.median(np.abs(errors[:, 3])) < 0.8
    assert np.median(rotation) < 2.5 and np.quantile(rotation, 0.9) < 6


def test_a_known_size_is_kept(templates):
    query, truth = problems.make_query(1)
    found = estimate(templates, query, jax.random.key(0), TURNED, truth.scale)
    np.testing.assert_allclose(found.camera_from_object.scale, truth.scale, rtol=1e-6)
    assert float(found.scale_std) == 0
    assert float(jnp.linalg.norm(found.camera_from_object.translation - truth.translation)) < 0.1 * float(truth.scale)


def test_the_estimate_says_how_sure_it_is(templates):
    query, truth = problems.make_query(1)
    found = estimate(templates, query, jax.random.key(0), TINY)
    spread = np.asarray(found.covariance, np.float64)
    np.testing.assert_allclose(spread, spread.T, rtol=1e-4, atol=1e-9)
    assert np.linalg.eigvalsh(spread).min() > 0
    size = float(truth.scale)
    assert np.sqrt(np.diag(spread)[3:]).max() < 0.5 * size and 0 < float(found.scale_std) < 0.5 * size
    assert bool(found.present) == (float(found.confidence) >= TINY.confidence.least)
    for part in jax.tree.leaves(found.agreement):
        assert 0 <= float(part) <= 1
    # Half of the object hidden, and what is seen in noise: less is known.
    poor, _ = problems.make_query(1, noise=1.5, occlusion=0.5)
    worse = estimate(templates, poor, jax.random.key(0), TINY)
    assert float(worse.confidence) < float(found.confidence)
    assert np.trace(np.asarray(worse.covariance)[3:, 3:]) > np.trace(spread[3:, 3:])


def test_the_same_key_gives_the_same_answer(templates):
    query, _ = problems.make_query(2, noise=0.3)
    one, other = (estimate(templates, query, jax.random.key(7), TINY) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_one_trace_for_all_thresholds_and_keys(templates):
    query, _ = problems.make_query(5)
    one = estimate(templates, query, jax.random.key(0), TINY)
    traces = len(TRACES)
    leaves, structure = jax.tree.flatten(TINY)
    other = jax.tree.unflatten(structure, [leaf * 1.1 for leaf in leaves])  # every threshold at once
    moved = estimate(templates, problems.make_query(6)[0], jax.random.key(1), other)
    assert len(leaves) > 5
    assert len(TRACES) == traces
    assert float(one.rmse) != float(moved.rmse)


def test_the_graph_has_no_callback_and_no_lapack(templates):
    query, truth = problems.make_query(0)
    text = estimate.lower(templates, query, jax.random.key(0), TURNED, truth.scale).as_text()
    assert "callback" not in text and "lapack" not in text and "cusolver" not in text
    assert text.count("stablehlo") > 100  # it is the graph that was searched


def list_products(jaxpr):
    """Every matrix product and convolution of a graph, those in its loops and branches too."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("dot_general", "conv_general_dilated"):
            yield equation
        for value in equation.params.values():
            for part in value if isinstance(value, (list, tuple)) else [value]:
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from list_products(inner)


@pytest.mark.parametrize("config", [TURNED, DRAWN, ipjax.Config.paper()], ids=["turned", "drawn", "paper"])
def test_no_product_is_left_to_the_devices_precision(templates, config):
    """GPUs round the factors of float32 products to ten bits unless they are told otherwise."""
    templates = dataclasses.replace(templates, appearance=problems.make_appearance(64))
    query, _ = problems.make_query(0)
    arguments = problems.make_encoder(), templates, query, jax.random.key(0), config
    found = list(list_products(jax.make_jaxpr(ipjax.estimate)(*arguments).jaxpr))
    left = [str(product) for product in found if product.params["precision"] != (jax.lax.Precision.HIGHEST,) * 2]
    assert len(found) > 2 and not left, left


def test_scaling_the_object_scales_nothing_but_the_scale(templates):
    """Model units cancel: templates of half the size give twice the scale and the same pose."""
    query, _ = problems.make_query(8)
    half = eqx.tree_at(lambda t: t.patches.points, templates, templates.patches.points / 2)
    one = ipjax.Config.paper()
    full = estimate(templates, query, jax.random.key(0), one).camera_from_object
    # The paper's threshold is relative to the diameter, so it doubles with the model's unit.
    doubled = eqx.tree_at(lambda c: c.align.threshold, one, one.align.threshold / 2)
    small = estimate(half, query, jax.random.key(0), doubled).camera_from_object
    np.testing.assert_allclose(small.scale, 2 * full.scale, rtol=1e-3)
    np.testing.assert_allclose(small.translation, full.translation, atol=1e-3)


@pytest.mark.parametrize("config", [TURNED, DRAWN, Config.paper()])
def test_the_answer_has_the_precision_of_the_records(config, x64):
    """Whatever that of the thresholds and the diameter is: under x64 both are float64 if nobody says otherwise."""
    known = two_objects()[0]
    query, truth = problems.make_query(0)
    run = lambda config, diameter: ipjax.estimate(
        problems.make_encoder(), known, query, jax.random.key(0), config, diameter
    )
    wide = jax.tree.map(jnp.float64, (config, truth.scale))
    one, other = (jax.eval_shape(run, *given) for given in ((config, truth.scale), wide))
    assert jax.tree.map(lambda x: x.dtype, one) == jax.tree.map(lambda x: x.dtype, other)
    assert one.camera_from_object.scale.dtype == one.confidence.dtype == jnp.float32


def test_nothing_to_match_is_reported_in_numbers(templates):
    query, _ = problems.make_query(0)
    nothing = jnp.zeros_like(query.patches.valid)
    blind = Query(eqx.tree_at(lambda p: p.valid, query.patches, nothing), query.view)
    found = estimate(templates, blind, jax.random.key(0), TINY)
    assert not bool(found.success)
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(found) if jnp.issubdtype(x.dtype, jnp.floating))
    assert float(found.confidence) == 0.0


def test_paper_runs_without_refinement(templates):
    """Pairs of patches alone: medians of 2.7 % of the diameter, 3.1 % of the size and 5.4° over 24 images."""

    def answers():
        for seed in range(12):
            query, truth = problems.make_query(seed)
            found = estimate(templates, query, jax.random.key(0), Config.paper())
            assert bool(found.success)
            assert_near(found.camera_from_object, truth, 0.12, 0.15, 18)
            yield found.camera_from_object, truth

    errors, rotation = gather_errors(answers())
    mean, error = summary(list(errors))
    assert (np.abs(mean) <= 3 * error).all(), (mean, error)
    assert np.median(np.linalg.norm(errors[:, :3], axis=1)) < 4.5
    assert np.median(np.abs(errors[:, 3])) < 5
    assert np.median(rotation) < 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda q: eqx.tree_at(lambda q: q.patches.features, q, q.patches.features[:, :16]),
            "16 channels.*same encoder",
        ),
        (lambda q: eqx.tree_at(lambda q: q.view.depth, q, q.view.depth[:56]), "square crops.*56 × 112"),
    ],
)
def test_what_does_not_fit_is_said(templates, change, message):
    from jaxtyping import config

    query, _ = problems.make_query(0)
    config.update("jaxtyping_disable", True)  # it would speak first
    try:
        with pytest.raises(ValueError, match=message):
            ipjax.estimate(None, templates, change(query), jax.random.key(0), TINY)
    finally:
        config.update("jaxtyping_disable", False)


@pytest.mark.parametrize("grid", [30, 1000])
def test_a_grid_that_does_not_divide_the_crop_is_said(templates, grid):
    query, _ = problems.make_query(0)
    config = dataclasses.replace(TINY, score=ScoreConfig(resolution=grid, alternates=0))
    with pytest.raises(ValueError, match=f"score.resolution must divide the 112 pixels .* {grid} does not"):
        jax.eval_shape(ipjax.estimate, None, templates, query, jax.random.key(0), config)


def test_compacted_templates_give_the_same_answer(templates):
    """Background is left out of the templates, and of nothing that is told."""
    small = ipjax.compact(templates, multiple=8)
    assert small.norm.shape[1] < templates.norm.shape[1]
    for seed in range(3):
        query, _ = problems.make_query(seed)
        whole, found = (estimate(one, query, jax.random.key(seed), TINY) for one in (templates, small))
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-4, rtol=1e-3), whole, found)


def test_vmap_over_padded_objects_queries_and_diameters_equals_the_loop():
    """A padded object gives the answer that it gives alone, drawn and with its size known, beside a larger one."""
    encoder = problems.make_encoder()
    objects, diameters = two_objects(), jnp.array([0.12, 0.09])
    padded = ipjax.pad_templates(objects)
    assert padded.patches.features.shape[:3] == (2, 8, 64) and padded.appearance.points.shape[:2] == (2, 20_000)
    queries = [make_sized_query(seed, size)[0] for seed, size in zip((11, 12), (0.12, 0.09), strict=True)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *queries)
    keys = jax.random.split(jax.random.key(3), 2)
    together = jax.jit(jax.vmap(ipjax.estimate, (None, 0, 0, 0, None, 0)), compiler_options=QUICKLY)
    together = together(encoder, padded, stacked, keys, DRAWN, diameters)
    alone = jax.jit(ipjax.estimate, compiler_options=QUICKLY)
    for index, one in enumerate(objects):
        wanted = alone(encoder, one, queries[index], keys[index], DRAWN, diameters[index])
        found = jax.tree.map(lambda x, index=index: x[index], together)
        assert int(found.view) == int(wanted.view) and int(found.inliers) == int(wanted.inliers)
        same(found.camera_from_object, wanted.camera_from_object, 1e-3)
        views = one.norm.shape[0]
        np.testing.assert_allclose(found.view_score[:views], wanted.view_score, atol=1e-4)
        assert (np.asarray(found.view_score[views:]) < np.asarray(wanted.view_score).min()).all()
        for name in ("confidence", "covariance", "ambiguity", "agreement"):
            jax.tree.map(
                lambda x, y: np.testing.assert_allclose(x, y, rtol=2e-2, atol=2e-3),
                getattr(found, name),
                getattr(wanted, name),
            )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: dataclasses.replace(t, appearance=None), "have their appearance"),
        (lambda t: eqx.tree_at(lambda t: t.patches.features, t, t.patches.features[..., :16]), "one shape"),
        (lambda t: jax.tree.map(lambda x: x[None], t), "single objects"),
    ],
)
def test_objects_that_are_not_alike_are_not_padded(change, message):
    with pytest.raises(ValueError, match=message):
        ipjax.pad_templates([two_objects()[0], change(two_objects()[1])])
    with pytest.raises(ValueError, match="at least one"):
        ipjax.pad_templates([])


def test_with_the_encoder_candidates_are_drawn(templates):
    """An ellipsoid's depth is the same after a half-turn, its colours are not: drawn, the answer is the true one."""
    encoder = problems.make_encoder()
    known = dataclasses.replace(templates, appearance=problems.make_appearance(20_000))
    config = dataclasses.replace(TURNED, score=ScoreConfig(resolution=28, alternates=1, drawn=3))
    run = jax.jit(ipjax.estimate, compiler_options=QUICKLY)
    for seed in range(4):
        query, truth = problems.make_query(seed, noise=0.3)
        found = run(encoder, known, query, jax.random.key(0), config)
        assert found.hypotheses.score.shape == (3,)
        assert bool(jnp.all(jnp.diff(found.hypotheses.score) <= 0))
        relative = np.asarray(found.camera_from_object.rotation).T @ np.asarray(truth.rotation)
        assert np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))) < 15
    plain = jax.eval_shape(run, encoder, templates, query, jax.random.key(0), config)
    assert plain.hypotheses.score.shape[0] > 3  # without an appearance nothing can be drawn


def test_fewer_hypotheses_than_are_tried_turned(templates):
    """One view and one hypothesis of it: what there is, is turned."""
    config = dataclasses.replace(TURNED, match=MatchConfig(views=1), score=ScoreConfig(resolution=28, alternates=3))
    query, _ = problems.make_query(0)
    found = jax.eval_shape(lambda: ipjax.estimate(None, templates, query, jax.random.key(0), config))
    assert found.hypotheses.score.shape == (2 * config.align.keep,)


@given(seed=st.integers(0, 2**31))
def test_distinct_poses_are_the_greedy_choice(seed):
    rng = np.random.default_rng(seed)
    base = [problems.random_rotation(rng) for _ in range(3)]
    rotation = np.stack([base[i] for i in rng.integers(0, 3, 12)])
    translation = np.round(rng.uniform(-1, 1, (12, 3)))
    score = np.where(rng.random(12) < 0.2, -1, rng.random(12)).astype(np.float32)
    poses = Similarity(*(jnp.asarray(x, jnp.float32) for x in (rotation, translation, np.ones(12))))
    chosen, there = jax.jit(distinct, static_argnums=2)(poses, jnp.asarray(score), 6, 0.1)
    expected: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        near = [np.allclose(rotation[i], rotation[j]) and np.allclose(translation[i], translation[j]) for j in expected]
        if score[i] >= 0 and not any(near) and len(expected) < 6:
            expected.append(int(i))
    assert np.asarray(chosen)[np.asarray(there)].tolist() == expected


def shorten(templates, count: int):
    """The templates with features cut to `count` principal directions, as onboarding does it."""
    basis = jnp.asarray(principal_basis(templates.patches, count))
    features, kept = cut(templates.patches.features, basis)
    patches = dataclasses.replace(templates.patches, features=features)
    return dataclasses.replace(templates, patches=patches, norm=templates.norm * kept, basis=basis)


def test_principal_directions_are_the_strongest_and_canonical(templates):
    features = np.asarray(templates.patches.features, np.float64)[np.asarray(templates.patches.valid)]
    basis = principal_basis(templates.patches, 7)
    np.testing.assert_allclose(basis @ basis.T, np.eye(7), atol=1e-5)
    assert (basis[np.arange(7), np.abs(basis).argmax(1)] > 0).all()
    _, values, _ = np.linalg.svd(features, full_matrices=False)
    np.testing.assert_allclose(((features @ basis.T.astype(np.float64)) ** 2).sum(0), values[:7] ** 2, rtol=1e-4)
    with pytest.raises(ValueError, match="cannot be cut to 0"):
        principal_basis(templates.patches, 0)
    with pytest.raises(ValueError, match="cannot be cut to 33"):
        principal_basis(templates.patches, 33)


def test_all_principal_directions_lose_nothing(templates):
    query, _ = problems.make_query(3)
    whole = shorten(templates, 32)
    for config in (Config(), Config.paper()):
        mine, known = comparable(whole, query.patches, config)
        theirs, wanted = comparable(templates, query.patches, config)
        valid = np.asarray(templates.patches.valid)
        products = lambda q, t: np.einsum("pc,vqc->vpq", q.features, t.patches.features)[:, np.asarray(q.valid)]
        np.testing.assert_allclose(
            products(mine, known).swapaxes(1, 2)[valid], products(theirs, wanted).swapaxes(1, 2)[valid], atol=1e-4
        )


def test_fewer_channels_still_recover_pose_and_size(templates):
    """Sixteen of thirty-two: the answer is nearly the same, and features of either length are told apart."""
    short = shorten(templates, 16)
    assert short.patches.features.shape[-1] == 16

    def answers():
        for seed in range(12):
            query, truth = problems.make_query(seed)
            found = estimate(short, query, jax.random.key(0), TINY)
            assert bool(found.success)
            assert_near(found.camera_from_object, truth, 0.12, 0.15, 15)
            yield found.camera_from_object, truth

    # Over 24 images: medians of 0.68 % of the diameter, 0.52 % of the size and 2.6°.
    errors, rotation = gather_errors(answers())
    mean, error = summary(list(errors))
    assert (np.abs(mean) <= 3 * error).all(), (mean, error)
    assert np.median(np.linalg.norm(errors[:, :3], axis=1)) < 1.4
    assert np.median(np.abs(errors[:, 3])) < 1.2
    assert np.median(rotation) < 4.5
    with pytest.raises(ValueError, match="16 channels"):
        query, _ = problems.make_query(0, channels=16)
        ipjax.estimate(None, short, query, jax.random.key(0), TINY)
