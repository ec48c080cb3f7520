"""Matching against the golden views, and its laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.golden import GOLDEN
from hypothesis import given, settings
from hypothesis import strategies as st

from ipjax.config import Config, MatchConfig
from ipjax.estimation.matching import match, pooled_similarity, select
from ipjax.inference.batching import compact
from ipjax.onboarding.viewpoints import viewpoints
from ipjax.records import Camera, Patches, Similarity, Surface, Templates
from ipjax.synthetic import problems


@pytest.fixture(scope="module")
def templates():
    return problems.make_templates()


@pytest.fixture(scope="module")
def query():
    return problems.make_query(3, noise=0.5)[0].patches


def golden_problem(features_q, masks_q, features_t, masks_t):
    """Golden arrays [h w c] and [v h w c] as patches; points are irrelevant to matching."""

    def patches(features, mask):
        *lead, h, w, c = features.shape
        unit = features / np.linalg.norm(features, axis=-1, keepdims=True)
        grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2)
        return Patches(
            jnp.asarray(unit.reshape(*lead, h * w, c), jnp.float32),
            jnp.zeros((*lead, h * w, 3), jnp.float32),
            jnp.asarray(np.broadcast_to(grid, (*lead, h * w, 2)), jnp.float32),
            jnp.asarray(mask.reshape(*lead, h * w)),
        )

    views = features_t.shape[0]
    zeros = jnp.zeros
    templates = Templates(
        patches(features_t, masks_t),
        jnp.zeros(features_t.shape[-1]),
        *[jnp.ones((views, features_t.shape[1] * features_t.shape[2]), jnp.float32)] * 2,
        Similarity(jnp.tile(jnp.eye(3), (views, 1, 1)), zeros((views, 3)), jnp.ones(views)),
        Camera(jnp.ones((views, 2)), zeros((views, 2))),
        Surface(zeros((4, 3)), zeros((4, 3)), jnp.ones(4)),
        jnp.ones(3),
        jnp.eye(3),
    )
    return patches(features_q, masks_q), templates


@pytest.mark.parametrize("name", ["zsp_pair16", "zsp_rand16"])
@pytest.mark.parametrize("count", [20, 50])
def test_top_pairs_equal_the_specification(name, count):
    data = np.load(GOLDEN / f"{name}.npz")
    query, templates = golden_problem(data["feat_q"], data["mask_q"], data["feat_r"][None], data["mask_r"][None])
    config = MatchConfig(ranking="cyclic", views=1, pairs=count, cycle=float("inf"))
    matches = match(query, templates, config)
    width = data["feat_q"].shape[1]
    flat = lambda ij: ij[:, 0] * width + ij[:, 1]
    np.testing.assert_array_equal(matches.query[0], flat(data[f"spec_top{count}_q_ij"]))
    np.testing.assert_array_equal(matches.template[0], flat(data[f"spec_top{count}_r_ij"]))
    np.testing.assert_allclose(matches.distance[0], data[f"spec_top{count}_d"], atol=1e-6)
    np.testing.assert_allclose(matches.similarity[0], data[f"spec_top{count}_sim"], atol=2e-6)


def painted_ball(rotation, rng, side=12, channels=64, noise=0.25):
    """Features [side side channels] of a ball seen along z: waves over its surface, a part that changes with the view,
    and noise; and its mask."""
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) / (side / 2 - 0.5)
    mask = x * x + y * y < 1
    depth = -np.sqrt(np.maximum(1 - x * x - y * y, 0))
    inside = np.stack([x, y, depth], -1) @ rotation  # object_from_camera is the transpose
    waves = np.random.default_rng(7)
    frequency, sway = waves.normal(0, 3, (3, channels)), waves.normal(size=(9, channels))
    phase = waves.uniform(0, 2 * np.pi, channels)
    features = np.cos(inside @ frequency + phase) + 0.5 * np.sin(rotation.ravel() @ sway)
    return features + noise * rng.normal(size=features.shape), mask


def small_turn(rng):
    """By up to 6 degrees about any axis."""
    x, y, z = rng.uniform(-0.06, 0.06, 3)
    u, _, v = np.linalg.svd(np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]]))
    return u @ v


@pytest.mark.parametrize("rolls", [1, 4])
@pytest.mark.parametrize("ranking", ["cyclic", "cosine"])
@given(seed=st.integers(0, 2**31))
@settings(max_examples=8)
def test_the_nearest_view_wins(rolls, ranking, seed):
    """Eq. 5 alone ties on several views; broken by the cosine it finds the one from which the query was seen."""
    rng = np.random.default_rng(seed)
    turns = np.asarray(viewpoints(16 // rolls, rolls).rotation, np.float64)
    true = int(rng.integers(16))
    query = painted_ball(small_turn(rng) @ turns[true], rng)
    views = [painted_ball(turn, rng) for turn in turns]
    features, masks = (np.stack(part) for part in zip(*views, strict=True))
    patches, templates = golden_problem(*query, features, masks)
    matches = match(patches, templates, MatchConfig(ranking=ranking, views=3, pairs=20))
    assert int(matches.view[0]) == true
    if ranking == "cyclic":
        sums = np.sort(cyclic(patches, templates), axis=1)[:, :20].sum(axis=1)
        assert (sums == sums.min()).sum() > 1 and sums[true] == sums.min()


def cyclic(query, templates):
    """Eq. 4 of every view in float64, infinite where a patch is none."""
    grid, here = np.asarray(query.grid), np.asarray(query.valid)
    found = []
    for features, there in zip(
        *(np.asarray(x) for x in (templates.patches.features, templates.patches.valid)), strict=True
    ):
        cosine = np.asarray(query.features, np.float64) @ features.T.astype(np.float64)
        cosine = np.where(here[:, None] & there, cosine, -2)
        back = cosine.argmax(axis=0)[cosine.argmax(axis=1)]
        found.append(np.where(here, np.linalg.norm(grid - grid[back], axis=-1), np.inf))
    return found


@pytest.mark.parametrize("shape", [(9, 7), (5, 12)])
def test_non_square_grids_equal_the_specification(shape):
    """Least cyclic distance first, then the greatest cosine, then the first patch."""
    rng = np.random.default_rng(14)
    features, masks = rng.normal(size=(2, *shape, 24)), rng.random((2, *shape)) < 0.8
    features[1] += 1.5 * features[0]
    query, templates = golden_problem(features[0], masks[0], features[1:], masks[1:])
    matches = match(query, templates, MatchConfig(ranking="cyclic", views=1, pairs=20, cycle=float("inf")))
    (distance,) = cyclic(query, templates)
    unit = np.asarray(query.features, np.float64) @ np.asarray(templates.patches.features[0], np.float64).T
    cosine = np.where(np.asarray(templates.patches.valid[0]), unit, -2).max(axis=1)
    order = np.lexsort((np.arange(len(distance)), -cosine, distance))[:20]
    np.testing.assert_array_equal(matches.query[0], order)
    np.testing.assert_allclose(matches.distance[0], distance[order], atol=1e-6)
    np.testing.assert_allclose(matches.similarity[0], cosine[order], atol=2e-6)


@given(st.integers(0, 2**31))
def test_permuting_views_permutes_the_ranking(templates, query, seed):
    order = np.random.default_rng(seed).permutation(8)
    shuffled = eqx.tree_at(lambda t: t.patches, templates, jax.tree.map(lambda x: x[order], templates.patches))
    plain, permuted = match(query, templates), match(query, shuffled)
    np.testing.assert_allclose(plain.ranking[order], permuted.ranking, atol=1e-6)
    np.testing.assert_array_equal(order[np.asarray(permuted.view)], plain.view)


@given(st.integers(0, 2**31))
def test_an_invalid_patch_is_absent(templates, query, seed):
    """What an invalid patch holds cannot matter, and it is in no pair."""
    rng = np.random.default_rng(seed)
    valid = np.asarray(query.valid) & (rng.random(64) < 0.7)
    noise = jnp.asarray(rng.normal(size=query.features.shape), jnp.float32)
    masked = eqx.tree_at(lambda q: q.valid, query, jnp.asarray(valid))
    changed = eqx.tree_at(lambda q: q.features, masked, jnp.where(valid[:, None], query.features, noise))
    one, other = match(masked, templates), match(changed, templates)
    np.testing.assert_array_equal(one.view, other.view)
    np.testing.assert_allclose(one.ranking, other.ranking, atol=1e-6)
    pairs = select(one, masked, templates)
    used = np.asarray(pairs.weight) > 0
    assert valid[np.asarray(one.query)[used]].all()


def test_thresholds_share_one_trace(templates, query):
    traces = []

    @jax.jit
    def run(query, config):
        traces.append(1)
        return match(query, templates, config)

    run(query, MatchConfig(cycle=1.0))
    run(query, MatchConfig(cycle=2.5))
    assert len(traces) == 1


def test_paper_keeps_fifty_pairs_of_one_view(templates, query):
    matches = match(query, templates, Config.paper().match)
    assert matches.view.shape == (1,) and matches.query.shape == (1, 50)


def test_channels_must_agree(templates, query):
    from jaxtyping import config

    config.update("jaxtyping_disable", True)
    try:
        short = eqx.tree_at(lambda q: q.features, query, query.features[:, :16])
        with pytest.raises(ValueError, match=r"16 channels.*same encoder"):
            match(short, templates)
    finally:
        config.update("jaxtyping_disable", False)


@given(st.integers(0, 2**31))
def test_a_shortlist_searches_the_likeliest_templates_only(templates, query, seed):
    """What it finds is what the exhaustive search finds among them; the others rank below, alike."""
    rng = np.random.default_rng(seed)
    masked = eqx.tree_at(lambda q: q.valid, query, jnp.asarray(np.asarray(query.valid) & (rng.random(64) < 0.8)))
    listed = np.sort(np.argsort(-np.asarray(pooled_similarity(templates.patches, masked)), kind="stable")[:3])
    fewer = jax.tree.map(lambda x: x[listed], templates.patches)
    reference = match(masked, eqx.tree_at(lambda t: t.patches, templates, fewer), MatchConfig(views=2))
    found = match(masked, templates, MatchConfig(views=2, shortlist=3))
    np.testing.assert_array_equal(found.view, listed[np.asarray(reference.view)])
    np.testing.assert_allclose(np.asarray(found.ranking)[listed], reference.ranking, atol=1e-6)
    for name in ("query", "template"):
        np.testing.assert_array_equal(getattr(found, name), getattr(reference, name))
    others = np.delete(np.asarray(found.ranking), listed)
    assert np.all(others < np.asarray(reference.ranking).min()) and np.all(np.isfinite(others))


def test_the_shortlist_holds_the_template_that_is_the_query(templates):
    """A template asked for itself resembles itself most, with other numbers of patches and in any order."""
    for view in range(8):
        patches = jax.tree.map(lambda x, view=view: x[view, ::-1], templates.patches)
        alike = np.asarray(pooled_similarity(templates.patches, patches))
        assert alike.argmax() == view and abs(alike[view] - 1) < 1e-5
        compacted = compact(templates, multiple=8).patches
        np.testing.assert_allclose(pooled_similarity(compacted, patches), alike, atol=1e-5)


def test_a_shortlist_as_long_as_the_object_changes_nothing(templates, query):
    plain, listed = (match(query, templates, MatchConfig(shortlist=n)) for n in (None, 8))
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(listed), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="at least one template"):
        match(query, templates, MatchConfig(shortlist=0))


@pytest.mark.parametrize("ranking", ["cyclic", "cosine"])
def test_compact_templates_give_the_same_matches(templates, query, ranking):
    small = compact(templates, multiple=8)
    count = small.patches.valid.shape[1]
    most = int(templates.patches.valid.sum(axis=1).max())
    assert count % 8 == 0 and most < count <= most + 8 and count < 64
    np.testing.assert_array_equal(small.patches.grid.max(axis=(1, 2)), 7)  # the grid's size can still be told
    config = MatchConfig(ranking=ranking)
    whole, cut = match(query, templates, config), match(query, small, config)
    np.testing.assert_array_equal(whole.view, cut.view)
    np.testing.assert_array_equal(whole.query, cut.query)
    np.testing.assert_allclose(whole.ranking, cut.ranking, atol=1e-6)
    used = np.isfinite(np.asarray(whole.distance))
    for name in ("points", "grid"):
        of = lambda t, m, name=name: np.asarray(getattr(t.patches, name))[np.asarray(m.view)[:, None], m.template]
        np.testing.assert_array_equal(of(templates, whole)[used], of(small, cut)[used])
    one, other = select(whole, query, templates, config), select(cut, query, small, config)
    np.testing.assert_allclose(one.weight, other.weight, atol=1e-6)


def test_compact_leaves_full_templates_alone_and_refuses_others(templates):
    full = eqx.tree_at(lambda t: t.patches.valid, templates, jnp.ones_like(templates.patches.valid))
    assert compact(full, multiple=8) is full
    none = compact(
        eqx.tree_at(lambda t: t.patches.valid, templates, jnp.zeros_like(templates.patches.valid)), multiple=8
    )
    assert none.patches.valid.shape == (8, 8) and not np.any(none.patches.valid)
    with pytest.raises(ValueError, match="positive multiple"):
        compact(templates, multiple=0)


def test_the_shortlist_needs_no_copy_of_the_templates():
    """Half-precision features of 200 templates are pooled one template at a time; the list's are copied."""
    if jax.default_backend() != "cpu":
        pytest.skip("a CPU takes one template at a time; GPUs take several, and their libraries want a workspace")
    views, patches, channels, listed = 200, 256, 384, 20
    shapes = jax.eval_shape(lambda: problems.blank_templates(views, patches, channels))
    query = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), shapes.patches)
    query = eqx.tree_at(lambda q: q.features, query, jax.ShapeDtypeStruct((patches, channels), jnp.float32))
    run = jax.jit(lambda q, t: match(q, t, MatchConfig(shortlist=listed)))
    memory = run.lower(query, shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < listed * patches * channels * 2 + 16 * 2**20
    assert memory.temp_size_in_bytes < views * patches * channels * 2 / 2
