"""Umeyama: golden files in both precisions, laws, degenerate sets, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ipjax_kernels import reference
from ipjax_kernels.similarity import fit_batch_last, umeyama
from jaxtyping import config as jaxtyping_config

POINTS = 60
UNDETERMINED = {"collinear20", "nearcollinear20", "coincident10"}


def load(request):
    with np.load(request.path.parents[1] / "golden" / "umeyama.npz", allow_pickle=False) as file:
        return dict(file)


def pad(points, dtype):
    """One shape for every case; what weight 0 means is tested on the way."""
    padded = np.full((POINTS, 3), np.nan)
    padded[: len(points)] = points
    return jnp.asarray(padded.astype(dtype))


def random_rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def check_golden(request, dtype, tolerance):
    data = load(request)
    for name in data["names"]:
        source, target = data[f"{name}__src"], data[f"{name}__dst"]
        weight = jnp.asarray((np.arange(POINTS) < len(source)).astype(dtype))
        rotation, translation, scale, success = umeyama(pad(source, dtype), pad(target, dtype), weight)
        assert rotation.dtype == dtype
        np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-5)
        moved = np.asarray(scale) * source.astype(np.float64) @ np.asarray(rotation, np.float64).T
        rmse = np.sqrt(np.mean(np.sum((moved + np.asarray(translation) - target) ** 2, axis=1)))
        far = max(1.0, float(np.abs(target).max()), float(np.abs(source).max()))
        # No worse than the reference, to rounding (which for coincident points fits nothing at all).
        assert rmse <= data[f"{name}__zsp_rmse"] + 1e-5 * far, name
        if name in UNDETERMINED:
            assert not success or (dtype == np.float64 and name == "nearcollinear20")
            continue
        assert success, name
        size = float(data[f"{name}__zsp_s"])
        np.testing.assert_allclose(rotation, data[f"{name}__zsp_T"][:3, :3] / size, atol=tolerance, err_msg=name)
        np.testing.assert_allclose(scale, size, rtol=tolerance, err_msg=name)
        np.testing.assert_allclose(translation, data[f"{name}__zsp_T"][:3, 3], atol=tolerance * far, err_msg=name)
        rigid = umeyama(pad(source, dtype), pad(target, dtype), weight, with_scale=False)
        expected = data[f"{name}__zsp_rigid_T"]
        np.testing.assert_allclose(rigid[0], expected[:3, :3], atol=tolerance, err_msg=name)
        np.testing.assert_allclose(rigid[1], expected[:3, 3], atol=tolerance * far, err_msg=name)
        assert rigid[2] == 1


def test_golden(request):
    check_golden(request, np.float32, 2e-5)


def test_golden_double(request, x64):
    check_golden(request, np.float64, 2e-6)  # the golden numbers themselves are float32


@given(
    seed=st.integers(0, 2**31),
    log_scale=st.floats(-3, 3),
    noise=st.sampled_from([0.0, 0.05]),
    shape=st.sampled_from(["full", "planar", "mirrored", "needle", "duplicates"]),
)
def test_recovers_and_equals_twin(seed, log_scale, noise, shape):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(POINTS, 3))
    if shape == "planar":
        source[:, 2] = 0
    elif shape == "needle":
        source[:, 1:] *= 0.05
    elif shape == "duplicates":
        source[10:] = source[rng.integers(0, 10, POINTS - 10)]
    rotation, scale, translation = random_rotation(rng), 10**log_scale, rng.normal(size=3)
    image = source * np.array([1, 1, -1]) if shape == "mirrored" else source
    target = scale * (image @ rotation.T + translation + noise * rng.normal(size=source.shape))
    weight = rng.random(POINTS) * (rng.random(POINTS) < 0.8)
    source, target, weight = (x.astype(np.float32) for x in (source, target, weight))
    found = umeyama(jnp.asarray(source), jnp.asarray(target), jnp.asarray(weight))
    twin = reference.umeyama(source, target, weight)
    np.testing.assert_allclose(np.linalg.det(found[0]), 1, atol=1e-5)
    np.testing.assert_allclose(found[2], twin[2], rtol=1e-4)
    if shape != "mirrored":  # of mirror images the best rotation may be nearly ambiguous
        assert found[3]
        np.testing.assert_allclose(found[0], twin[0], atol=1e-3 if shape == "needle" and noise else 2e-4)
        if not noise:
            np.testing.assert_allclose(found[0], rotation, atol=2e-4)
            np.testing.assert_allclose(found[2], scale, rtol=1e-4)
            np.testing.assert_allclose(found[1], scale * translation, atol=1e-4 * scale * 5)


@given(seed=st.integers(0, 2**31))
def test_equivariance_permutation_and_absence(seed):
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, POINTS, 3)).astype(np.float32)
    target = source + 0.3 * target
    weight = rng.random(POINTS).astype(np.float32)
    weight[:20] = 0
    plain = umeyama(jnp.asarray(source), jnp.asarray(target), jnp.asarray(weight))
    order = rng.permutation(POINTS)
    permuted = umeyama(jnp.asarray(source[order]), jnp.asarray(target[order]), jnp.asarray(weight[order]))
    absent = umeyama(*(jnp.asarray(x).at[:20].set(jnp.nan) for x in (source, target)), jnp.asarray(weight))
    doubled = umeyama(jnp.asarray(source), jnp.asarray(target), jnp.asarray(3 * weight))
    for other in (permuted, absent, doubled):
        for mine, theirs in zip(plain, other, strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-5)
    turn, factor, shift = random_rotation(rng), 2.5, rng.normal(size=3)
    moved_target = (factor * target @ turn.T + shift).astype(np.float32)
    after = umeyama(jnp.asarray(source), jnp.asarray(moved_target), jnp.asarray(weight))
    np.testing.assert_allclose(after[0], turn @ np.asarray(plain[0]), atol=2e-5)
    np.testing.assert_allclose(after[2], factor * plain[2], rtol=2e-5)
    np.testing.assert_allclose(after[1], factor * turn @ np.asarray(plain[1]) + shift, atol=5e-5)
    moved_source = (factor * source @ turn.T + shift).astype(np.float32)
    before = umeyama(jnp.asarray(moved_source), jnp.asarray(target), jnp.asarray(weight))
    np.testing.assert_allclose(before[0], np.asarray(plain[0]) @ turn.T, atol=2e-5)
    np.testing.assert_allclose(before[2], plain[2] / factor, rtol=2e-5)


def test_batch_equals_loop_equals_vmap_equals_eager():
    source, target = np.random.default_rng(0).normal(size=(2, 3, 4, POINTS, 3)).astype(np.float32)
    weight = jnp.ones((3, 4, POINTS))
    batched = umeyama(jnp.asarray(source), jnp.asarray(target), weight)
    mapped = jax.vmap(jax.vmap(umeyama))(jnp.asarray(source), jnp.asarray(target), weight)
    with jax.disable_jit():
        eager = umeyama(jnp.asarray(source[1, 2]), jnp.asarray(target[1, 2]), weight[1, 2])
    for whole, many, one in zip(batched, mapped, eager, strict=True):
        np.testing.assert_allclose(whole, many, atol=2e-6)
        np.testing.assert_allclose(whole[1, 2], one, atol=5e-6)


@pytest.mark.parametrize("kind", ["coincident", "collinear", "two", "one", "weightless", "constant target", "nan"])
def test_degenerate_is_finite_and_said(kind):
    rng = np.random.default_rng(1)
    source = rng.normal(size=(POINTS, 3)).astype(np.float32)
    weight = np.ones(POINTS, np.float32)
    if kind == "coincident":
        source[:] = source[0]
    elif kind == "collinear":
        source[:] = source[0] * rng.normal(size=(POINTS, 1)) + 5
    target = source * 2 + 1
    if kind in ("two", "one", "weightless"):
        weight[{"two": 2, "one": 1, "weightless": 0}[kind] :] = 0
    elif kind == "constant target":
        target[:] = 3
    elif kind == "nan":
        target[:, 1] = np.nan
    arguments = jnp.asarray(source), jnp.asarray(target), jnp.asarray(weight)
    found = umeyama(*arguments)
    assert not found[3]
    assert all(np.all(np.isfinite(x)) for x in found[:3])
    np.testing.assert_allclose(np.linalg.det(found[0]), 1, atol=1e-5)
    gradient = GRADIENT(*arguments)
    assert np.all(np.isfinite(gradient))


def total(source, target, weight):
    rotation, translation, scale, _ = umeyama(source, target, weight)
    return jnp.sum(rotation * jnp.arange(9, dtype=source.dtype).reshape(3, 3)) + jnp.sum(translation) + scale


GRADIENT = jax.jit(jax.grad(total))


@pytest.mark.parametrize("shape", ["full", "cube", "planar", "mirrored"])
def test_gradient_equals_differences(shape, x64):
    # The cube's singular values are all equal, the square's two are, and the mirror image's third is negative.
    rng = np.random.default_rng(2)
    source = {
        "full": rng.normal(size=(8, 3)),
        "cube": np.array([[i, j, k] for i in (-1.0, 1) for j in (-1.0, 1) for k in (-1.0, 1)]),
        "planar": np.array([[i, j, 0] for i in (-1.0, 1) for j in (-1.0, 1)] * 2),
        "mirrored": rng.normal(size=(8, 3)) * [3, 2, 1],
    }[shape]
    image = source * [1, 1, -1] if shape == "mirrored" else source
    target = jnp.asarray(image @ random_rotation(rng).T * 0.3 + 1)
    direction, weight = rng.normal(size=source.shape), jnp.ones(8)
    slope = np.sum(np.asarray(GRADIENT(jnp.asarray(source), target, weight)) * direction)
    step = 1e-6
    ahead, behind = (total(jnp.asarray(source + sign * step * direction), target, weight) for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-7)


def test_lowered_text_calls_no_library():
    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((4, 3, 3), (4, 3, 3), (4, 3))]
    for platform in ("cpu", "cuda"):
        text = umeyama.trace(*shapes).lower(lowering_platforms=(platform,)).as_text()
        assert "custom_call" not in text


def test_refuses_wrong_shapes_in_words():
    jaxtyping_config.update("jaxtyping_disable", True)
    try:
        for source, target, weight in (((5, 3), (4, 3), (5,)), ((5, 2), (5, 2), (5,)), ((5, 3), (5, 3), (4,))):
            with pytest.raises(ValueError, match="umeyama needs"):
                umeyama(jnp.zeros(source), jnp.zeros(target), jnp.zeros(weight))
    finally:
        jaxtyping_config.update("jaxtyping_disable", False)


TRIANGLES = 64


@given(
    seed=st.integers(0, 2**31),
    log_scale=st.floats(-3, 3),
    kind=st.sampled_from(["exact", "any", "weights", "far", "thin", "mirrored", "one absent"]),
)
def test_triangles_equal_the_twin(seed, log_scale, kind):
    """Sets of three have a form of their own: the same numbers, batched, wherever the rotation is determined."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(TRIANGLES, 3, 3))
    target = rng.normal(size=(TRIANGLES, 3, 3))
    weight = np.ones((TRIANGLES, 3))
    rotation = random_rotation(rng)
    if kind == "thin":
        source[:, 2] = 0.5 * (source[:, 0] + source[:, 1]) + 0.2 * source[:, 2]
    if kind in ("exact", "far", "thin", "mirrored"):
        target = (source * [1, 1, -1] if kind == "mirrored" else source) @ rotation.T
    if kind == "weights":
        weight = rng.uniform(0.1, 1, weight.shape)
    elif kind == "one absent":
        weight[:, 1] = 0
        source[:, 1] = np.nan
    target = 10**log_scale * (target + (20 if kind == "far" else 1))
    source, target, weight = (x.astype(np.float32) for x in (source, target, weight))
    found = [np.asarray(x) for x in umeyama(jnp.asarray(source), jnp.asarray(target), jnp.asarray(weight))]
    np.testing.assert_allclose(found[0] @ np.swapaxes(found[0], 1, 2), np.tile(np.eye(3), (TRIANGLES, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(found[0]), 1, atol=1e-5)
    assert all(np.isfinite(x).all() for x in found[:3])
    if kind == "one absent":
        assert not found[3].any()
        return
    checked = 0
    for i in range(TRIANGLES):
        twin = reference.umeyama(source[i], target[i], weight[i])
        share = weight[i].astype(np.float64) / weight[i].sum()
        arms = [x[i].astype(np.float64) - share @ x[i] for x in (source, target)]
        values = np.linalg.svd((share[:, None] * arms[1]).T @ arms[0])[1]
        # Rounding turns a rotation by eps times this much; the twin has double precision.
        worth = values[0] / max(values[1], 1e-30) * (50 if kind == "far" else 1)
        if worth > 500:
            continue
        checked += 1
        assert found[3][i]
        np.testing.assert_allclose(found[0][i], twin[0], atol=1e-6 * (10 + worth))
        np.testing.assert_allclose(found[2][i], twin[2], rtol=1e-5 * (1 + worth / 10))
    assert checked > TRIANGLES / 8


@pytest.mark.parametrize("kind", ["coincident", "collinear", "two", "constant target"])
def test_degenerate_triangles_are_finite_and_said(kind):
    source = np.random.default_rng(1).normal(size=(3, 3)).astype(np.float32)
    if kind == "coincident":
        source[:] = source[0]
    elif kind == "collinear":
        source[2] = 2 * source[1] - source[0]
    target = source * 2 + 1
    if kind == "constant target":
        target[:] = 3
    weight = jnp.asarray([1.0, 1.0, 0.0 if kind == "two" else 1.0])
    found = umeyama(jnp.asarray(source), jnp.asarray(target), weight)
    assert not found[3]
    assert all(np.all(np.isfinite(x)) for x in found[:3])
    np.testing.assert_allclose(np.linalg.det(found[0]), 1, atol=1e-5)
    if kind in ("collinear", "two"):  # the best of the rotations that are left
        moved = found[2] * source[:2] @ np.asarray(found[0]).T + np.asarray(found[1])
        np.testing.assert_allclose(moved, target[:2], atol=1e-4)
    assert np.all(np.isfinite(GRADIENT(jnp.asarray(source), jnp.asarray(target), weight)))


@pytest.mark.parametrize("shape", ["full", "equilateral", "mirrored"])
def test_gradient_of_triangles_equals_differences(shape, x64):
    rng = np.random.default_rng(3)
    source = np.eye(3) if shape == "equilateral" else rng.normal(size=(3, 3))
    image = source * [1, 1, -1] if shape == "mirrored" else source
    target = jnp.asarray(image @ random_rotation(rng).T * 0.3 + 1)
    direction, weight = rng.normal(size=source.shape), jnp.asarray([1.0, 0.5, 2.0])
    slope = np.sum(np.asarray(GRADIENT(jnp.asarray(source), target, weight)) * direction)
    step = 1e-6
    ahead, behind = (total(jnp.asarray(source + sign * step * direction), target, weight) for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-7)


SHAPES = {  # what minimal sets look like where objects do: sides that are equal, corners that coincide
    "any": None,
    "equilateral": [[0, 0, 0], [1, 0, 0], [0.5, 0.75**0.5, 0]],
    "isosceles": [[0, 0, 0], [1, 0, 0], [0.5, 2, 0]],
    "right": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
    "twins": [[0, 0, 0], [0, 0, 0], [1, 0, 0]],
    "line": [[-1, 0, 0], [0, 0, 0], [1, 0, 0]],
    "cube": [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)],
}
fit_many = jax.jit(jax.vmap(fit_batch_last))
fit_one_by_one = jax.jit(fit_batch_last)


@pytest.mark.parametrize("shape", SHAPES)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5)
def test_what_is_fitted_is_a_rotation_whatever_is_mapped_over_it(shape, seed):
    """A fit of many sets under vmap is compiled into other programs than one of them alone: whatever these round, the
    answer is a rotation, and the same."""
    rng = np.random.default_rng(seed)
    views, count = 8, 256
    form = SHAPES[shape]
    if form is None:
        source, target = (rng.normal(size=(views, 3, 3, count)) for _ in range(2))
    else:
        turns = np.linalg.qr(rng.normal(size=(2, views, count, 3, 3)))[0]  # mirrored, too
        source, target = (np.einsum("vmij,nj->vnim", turn, form) for turn in turns)
        target = target + 1e-3 * rng.normal(size=target.shape)
    source, target = (jnp.asarray(0.1 * x, jnp.float32) for x in (source, target))
    weight = jnp.ones((views, source.shape[1], count), jnp.float32)
    rotation, _, _, _, success = (np.asarray(x) for x in fit_many(source, target, weight))
    matrices = np.moveaxis(rotation, -1, 1).astype(np.float64)
    np.testing.assert_allclose(
        matrices @ np.swapaxes(matrices, -1, -2), np.broadcast_to(np.eye(3), matrices.shape), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1, atol=1e-5)
    alone, _, _, spread, found = (np.asarray(x) for x in fit_one_by_one(source[0], target[0], weight[0]))
    np.testing.assert_array_equal(found, success[0])
    sure = found & (spread > 0.05)  # nearly collinear sets leave a turn to rounding
    if shape != "cube":  # whose mirror image has many best rotations
        np.testing.assert_allclose(rotation[0][..., sure], alone[..., sure], atol=1e-3)
