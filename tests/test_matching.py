"""Matching against the golden views, and its laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from conftest import GOLDEN
from hypothesis import given
from hypothesis import strategies as st

from ipjax.config import Config, MatchConfig
from ipjax.matching import match, select
from ipjax.types import Camera, Patches, Similarity, Surface, Templates


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


@pytest.mark.parametrize("name", ["zsp_views16", "zsp_views16_inplane"])
@pytest.mark.parametrize("ranking", ["cyclic", "cosine"])
def test_the_true_view_wins(shared, name, ranking):
    """Eq. 5 alone ties on up to 16 views here; broken by cosine it finds the true one, number 5."""
    data = np.load(shared / "golden" / f"{name}.npz")
    query, templates = golden_problem(data["feat_q"], data["mask_q"], data["feat_t"], data["mask_t"])
    matches = match(query, templates, MatchConfig(ranking=ranking, views=3, pairs=20))
    assert int(matches.view[0]) == 5


def test_non_square_grids_equal_the_specification(shared):
    data = np.load(shared / "golden" / "zsp_pair37x28.npz")
    query, templates = golden_problem(data["feat_q"], data["mask_q"], data["feat_r"][None], data["mask_r"][None])
    matches = match(query, templates, MatchConfig(ranking="cyclic", views=1, pairs=50, cycle=float("inf")))
    width = data["feat_q"].shape[1]
    np.testing.assert_array_equal(
        matches.query[0], data["spec_top50_q_ij"][:, 0] * width + data["spec_top50_q_ij"][:, 1]
    )


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
