"""Consensus: golden index tables, the slow twin, laws of drawing, gates and refits."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ipjax_kernels import reference
from ipjax_kernels.consensus import consensus, draw_minimal_sets, residuals, score_batch_last, score_sets
from ipjax_kernels.similarity import umeyama
from jaxtyping import config as jaxtyping_config

PAIRS, COUNT, KEEP = 40, 512, 4
CASES = ("out30_n100", "out60_n100", "out80_n100", "out60_n50", "out80_n200")


def golden(request, case):
    with np.load(request.path.parents[1] / "golden" / "ransac.npz", allow_pickle=False) as file:
        return {key.removeprefix(f"{case}__"): file[key] for key in file if key.startswith(case)}


def pad(points):
    """One shape for every case: the added pairs have weight 0."""
    return jnp.asarray(np.pad(points, ((0, 200 - len(points)), (0, 0))))


@pytest.mark.parametrize("size", [3, 4])
@pytest.mark.parametrize("case", CASES)
def test_golden_tables(case, size, request):
    data = golden(request, case)
    pairs, threshold = len(data["src"]), data["thr"]
    source, target = pad(data["src"]), pad(data["dst"])
    weight = jnp.asarray((np.arange(200) < pairs).astype(np.float32))
    table = jnp.asarray(data[f"m{size}_idx"])
    rotation, translation, scale, success = umeyama(source[table], target[table], jnp.ones(table.shape))
    squared = np.asarray(residuals(rotation, translation, scale, source, target))[:, :pairs]
    distance = np.sqrt(squared)
    count = np.sum(distance < threshold, axis=1)
    # The reference adds 1e-6 to every coordinate's difference: up to 1.7e-6 of distance, and float32 rounding.
    near = np.sum(np.abs(distance - threshold) < 2e-6, axis=1)
    judged = np.asarray(success)
    assert judged.mean() > 0.99
    assert np.all((np.abs(count - data[f"m{size}_count"]) <= near)[judged])
    np.testing.assert_allclose(squared.sum(axis=1)[judged], data[f"m{size}_ssr"][judged], rtol=2e-3)

    fixed = dict(sets=table, keep=KEEP, rank="count")
    best = consensus(jax.random.key(0), source, target, weight, jnp.asarray(threshold), refits=0, **fixed)
    expected = data[f"m{size}_best_T"]
    np.testing.assert_allclose(best.scale[0] * best.rotation[0], expected[:3, :3], atol=2e-5)
    np.testing.assert_allclose(best.translation[0], expected[:3, 3], atol=2e-5)
    np.testing.assert_array_equal(best.inliers[0, :pairs], data[f"m{size}_best_inliers"])
    assert not np.any(best.inliers[:, pairs:])
    np.testing.assert_allclose(best.score[0] * pairs, data[f"m{size}_count"].max(), rtol=1e-6)

    refit = umeyama(source, target, jnp.where(best.inliers[0], weight, 0))
    np.testing.assert_allclose(refit[2] * refit[0], data[f"m{size}_refit_T"][:3, :3], atol=2e-5)
    np.testing.assert_allclose(refit[2], data[f"m{size}_refit_s"], rtol=2e-5)
    refined = consensus(jax.random.key(0), source, target, weight, jnp.asarray(threshold), refits=1, **fixed)
    assert refined.score[0] >= best.score[0]


@pytest.mark.parametrize("case", CASES)
def test_golden_problems_are_solved(case, request):
    data = golden(request, case)
    source, target = pad(data["src"]), pad(data["dst"])
    weight = jnp.asarray((np.arange(200) < len(data["src"])).astype(np.float32))
    found = consensus(jax.random.key(0), source, target, weight, 0.01, count=1000, keep=16, refits=3)
    cosine = (np.trace(np.asarray(found.rotation[0]).T @ data["gt_R"]) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 10
    assert abs(found.scale[0] / data["gt_s"] - 1) < 0.1


def problem(seed, outliers, scale=0.2, noise=0.0):
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation = q * np.sign(np.diag(r))
    rotation = rotation * np.linalg.det(rotation)
    source = rng.uniform(-0.5, 0.5, (PAIRS, 3))
    translation = np.array([0.1, -0.1, 1.0]) * scale * 5
    target = scale * (source @ rotation.T) + translation + noise * scale * rng.normal(size=source.shape)
    wrong = rng.permutation(PAIRS)[: int(outliers * PAIRS)]
    target[wrong] = translation + scale * rng.uniform(-0.5, 0.5, (len(wrong), 3))
    inside = np.ones(PAIRS, bool)
    inside[wrong] = False
    weight = rng.uniform(0.2, 1, PAIRS)
    arrays = (jnp.asarray(x.astype(np.float32)) for x in (source, target, weight))
    return (*arrays, rotation, translation, inside)


def solve(source, target, weight, threshold=0.02, key=0, **options):
    options = dict(count=COUNT, keep=KEEP, refits=2, relative=True) | options
    gates = dict(scale_bounds=(0.0, np.inf), edge_ratio=0.0, spread=0.0)  # all of them always: one trace
    gates = {name: jax.tree.map(jnp.float32, options.pop(name, value)) for name, value in gates.items()}
    return consensus(jax.random.key(key), source, target, weight, jnp.float32(threshold), **gates, **options)


@given(seed=st.integers(0, 2**31), outliers=st.sampled_from([0, 0.3, 0.6]), log_scale=st.floats(-3, 3))
def test_recovers(seed, outliers, log_scale):
    scale = 10**log_scale
    source, target, weight, rotation, translation, inside = problem(seed, outliers, scale, noise=0.002)
    found = solve(source, target, weight)
    assert found.success[0]
    np.testing.assert_allclose(found.rotation[0], rotation, atol=0.03)
    np.testing.assert_allclose(found.scale[0], scale, rtol=0.03)
    np.testing.assert_allclose(found.translation[0], translation, atol=0.02 * scale)
    assert np.all(np.asarray(found.inliers[0])[inside])
    assert np.all(np.diff(found.score) <= 0)


@given(seed=st.integers(0, 2**31))
def test_laws(seed):
    source, target, weight, *_ = problem(seed, 0.5, noise=0.005)
    found = solve(source, target, weight, key=seed)
    again = solve(source, target, weight, key=seed)
    for mine, theirs in zip(found, again, strict=True):  # the same key, the same answer
        np.testing.assert_array_equal(mine, theirs)
    # Weight 0 is absent, even as NaN.
    fewer = weight.at[:5].set(0)
    plain = solve(source, target, fewer, key=seed)
    absent = solve(source.at[:5].set(jnp.nan), target.at[:5].set(1e6), fewer, key=seed)
    for mine, theirs in zip(plain, absent, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert not np.any(plain.inliers[:, :5])
    # Permuted pairs, with the table of sets permuted alike.
    table = draw_minimal_sets(jax.random.key(seed), weight, COUNT, 3)
    order = np.random.default_rng(seed).permutation(PAIRS)
    place = jnp.asarray(np.argsort(order), jnp.int32)
    mine = solve(source, target, weight, sets=table)
    # Refits never lower the best score.
    assert mine.score[0] >= solve(source, target, weight, sets=table, keep=COUNT, refits=0).score[0]
    theirs = solve(source[order], target[order], weight[order], sets=place[table])
    np.testing.assert_allclose(mine.score, theirs.score, atol=1e-4)
    # The target's frame and unit do not matter.
    turn = jnp.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = solve(source, jnp.matmul(4 * target, turn.T, precision="highest"), weight, sets=table)
    np.testing.assert_allclose(moved.score[0], mine.score[0], atol=1e-4)
    np.testing.assert_allclose(moved.scale[0], 4 * mine.scale[0], rtol=1e-3)


@pytest.mark.parametrize("rank", ["msac", "count"])
@pytest.mark.parametrize("relative", [False, True])
def test_twin(rank, relative):
    source, target, weight, *_ = problem(5, 0.5, noise=0.01)
    rng = np.random.default_rng(5)
    table = np.stack([rng.permutation(PAIRS)[:3] for _ in range(COUNT)]).astype(np.int32)
    threshold = 0.05 if relative else 0.01
    twin = reference.consensus(source, target, weight, threshold, table, refits=2, rank=rank, relative=relative)
    found = solve(source, target, weight, threshold, sets=jnp.asarray(table), rank=rank, relative=relative)
    np.testing.assert_allclose(found.score[0], twin[3], atol=1e-5)
    np.testing.assert_allclose(found.rotation[0], twin[0], atol=1e-4)
    np.testing.assert_allclose(found.translation[0], twin[1], atol=1e-4)
    np.testing.assert_allclose(found.scale[0], twin[2], rtol=1e-4)
    np.testing.assert_array_equal(found.inliers[0], twin[4])


def test_gates():
    source, target, weight, *_ = problem(3, 0.5, scale=0.2, noise=0.01)
    table = draw_minimal_sets(jax.random.key(0), weight, COUNT, 3)
    every = dict(sets=table, keep=COUNT, refits=0)
    free = solve(source, target, weight, **every)
    gated = solve(source, target, weight, scale_bounds=(0.15, 0.25), **every)
    scale = np.asarray(gated.scale)[np.asarray(gated.success)]
    assert 0 < len(scale) < np.sum(free.success) and scale.min() >= 0.15 and scale.max() <= 0.25
    rejected = ~np.asarray(gated.success)
    assert np.all(np.asarray(gated.score)[rejected] == -1) and not np.any(np.asarray(gated.inliers)[rejected])

    edges = [np.linalg.norm(np.asarray(x)[table] - np.roll(np.asarray(x)[table], 1, axis=1), axis=-1)
             for x in (source, target)]  # fmt: skip
    growth = edges[1] / edges[0]
    alike = growth.min(axis=1) >= 0.8 * growth.max(axis=1)
    assert 0 < alike.sum() < COUNT
    assert np.sum(solve(source, target, weight, edge_ratio=0.8, **every).success) == alike.sum()

    spread = solve(source, target, weight, spread=0.1, **every)
    assert 0 < np.sum(spread.success) < np.sum(free.success)
    nothing = solve(source, target, weight, scale_bounds=(50.0, 60.0))
    assert not np.any(nothing.success) and np.all(nothing.score == -1)
    assert all(np.all(np.isfinite(x)) for x in nothing)


@pytest.mark.parametrize("kind", ["weightless", "two pairs", "collinear", "coincident", "nan"])
def test_degenerate_is_finite_and_said(kind):
    source, target, weight, *_ = problem(0, 0)
    if kind == "weightless":
        weight = jnp.zeros_like(weight)
    elif kind == "two pairs":
        weight = weight.at[2:].set(0)
    elif kind == "collinear":
        source = source * jnp.array([1.0, 0, 0])
        target = source * 0.2 + 1
    elif kind == "coincident":
        source = jnp.ones_like(source)
    else:
        target = target.at[:, 0].set(jnp.nan)
    found = solve(source, target, weight)
    assert not np.any(found.success)
    assert all(np.all(np.isfinite(x)) for x in found)


@given(seed=st.integers(0, 2**31))
def test_drawn_indices_differ_and_have_weight(seed):
    rng = np.random.default_rng(seed)
    weight = (10 ** rng.uniform(-6, 3, PAIRS) * (rng.random(PAIRS) < 0.3)).astype(np.float32)
    weight[rng.permutation(PAIRS)[:4]] = 1
    sets = np.sort(draw_minimal_sets(jax.random.key(seed), jnp.asarray(weight), COUNT, 4), axis=1)
    assert np.all(sets[:, 1:] > sets[:, :-1])
    assert np.all(weight[sets] > 0)


def test_drawn_in_proportion():
    weight = np.array([0, 1, 2, 3, 4, 0, 10], np.float32)
    ours = np.asarray(draw_minimal_sets(jax.random.key(0), jnp.asarray(weight), 20000, 3))
    theirs = reference.draw_minimal_sets(np.random.default_rng(0), weight, 20000, 3)
    for place in range(3):  # each place of a set has its own distribution
        counts = [np.bincount(x[:, place], minlength=7) / 20000 for x in (ours, theirs)]
        np.testing.assert_allclose(*counts, atol=0.02)  # four standard deviations of the difference
    np.testing.assert_allclose(np.bincount(ours[:, 0], minlength=7) / 20000, weight / 20, atol=0.015)


def test_vmap_equals_loop():
    problems = [problem(seed, 0.4, noise=0.005)[:3] for seed in range(2)]
    stacked = [jnp.stack(x) for x in zip(*problems, strict=True)]
    batched = jax.vmap(lambda *arrays: solve(*arrays, key=3))(*stacked)
    for i, arrays in enumerate(problems):
        single = solve(*arrays, key=3)
        np.testing.assert_allclose(single.score, batched.score[i], atol=1e-5)
        np.testing.assert_allclose(single.rotation[0], batched.rotation[i, 0], atol=1e-4)
        np.testing.assert_array_equal(single.inliers[0], batched.inliers[i, 0])


def test_one_trace_for_all_thresholds():
    arguments = problem(0, 0.5)[:3]
    solve(*arguments)
    before = consensus._cache_size()
    for threshold in (0.01, 0.03):
        for bound in (0.1, 0.15):
            solve(*arguments, threshold, key=1, scale_bounds=(bound, 1.0), edge_ratio=bound, spread=bound / 2)
    assert consensus._cache_size() == before


def test_lowered_text_calls_no_library():
    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((PAIRS, 3), (PAIRS, 3), (PAIRS,))]
    function = jax.jit(lambda *a: tuple(consensus(jax.random.key(0), *a, 0.1, count=64, keep=4)))
    exported = jax.export.export(function, platforms=("cpu", "cuda", "tpu"))(*shapes)
    text = exported.mlir_module()
    assert not re.findall(r"custom_call @\w*(?:callback|lapack|cusolver)", text)


def test_refuses_wrong_shapes_in_words():
    jaxtyping_config.update("jaxtyping_disable", True)
    try:
        source, target, weight, *_ = problem(0, 0)
        with pytest.raises(ValueError, match="consensus needs source"):
            solve(source, target[:-1], weight)
        with pytest.raises(ValueError, match="keep <= n"):
            solve(source, target, weight, count=2)
        with pytest.raises(ValueError, match="consensus needs sets"):
            solve(source, target, weight, size=2)
        with pytest.raises(ValueError, match="draw_minimal_sets"):
            draw_minimal_sets(jax.random.key(0), weight[:2], 5, 3)
    finally:
        jaxtyping_config.update("jaxtyping_disable", False)


@given(seed=st.integers(0, 2**31))
def test_scores_are_the_same_by_pairs_and_at_once(seed):
    """The CPU's sums, a few pairs at a time, against those of all residuals."""
    rng = np.random.default_rng(seed)
    source, target = (jnp.asarray(rng.normal(size=(PAIRS, 3)), jnp.float32) for _ in range(2))
    rotation = jnp.asarray(rng.normal(size=(16, 3, 3)), jnp.float32)
    translation, scale = (jnp.asarray(rng.normal(size=n), jnp.float32) for n in ((16, 3), (16,)))
    weight = jnp.asarray(rng.random(PAIRS) * (rng.random(PAIRS) < 0.8), jnp.float32)
    threshold = jnp.asarray(rng.uniform(0.5, 3, 16) * (rng.random(16) < 0.9), jnp.float32)
    squared = residuals(rotation, translation, scale, source, target)
    expected = score_sets(squared, weight, threshold)
    found = BATCH_LAST(jnp.moveaxis(rotation, 0, -1), translation.T, scale, source, target, weight, threshold)
    on_edge = np.any(np.abs(np.asarray(squared) - np.square(threshold)[:, None]) < 1e-5, axis=1)
    for index, (mine, theirs) in enumerate(zip(found, expected, strict=True)):
        compared = ~on_edge if index == 1 else np.ones(16, bool)
        np.testing.assert_allclose(np.asarray(mine)[compared], np.asarray(theirs)[compared], rtol=2e-5, atol=2e-6)


BATCH_LAST = jax.jit(score_batch_last)


def test_residuals_are_never_in_memory():
    """4096 hypotheses × 512 pairs would be 8 MiB of residuals; sets, fits and scores take a few numbers a set."""
    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((512, 3), (512, 3), (512,))]
    key = jax.eval_shape(lambda: jax.random.key(0))
    memory = consensus.lower(key, *shapes, 0.01, count=4096, keep=16).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 120 * 4 * 4096
