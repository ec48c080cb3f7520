"""Similarities are a group that acts on points: in JAX and NumPy, float32 and float64, jitted, and in batches."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.transforms import (
    Similarity,
    difference,
    retract,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)

KINDS = ["numpy float64", "numpy float32", "jax float32", "jax float64"]
TOLERANCE = {"float32": 1e-5, "float64": 2e-14}


def law(statement):
    """Test a law: a function whose two results must be the same, given what its arguments name.

    ``a``, ``b``, ``c`` are similarities, ``step`` is a tangent, ``points`` are points; all of them in batches, and of
    every size down to nothing. NumPy's arrays are calculated with as they are, JAX's in a jitted function.
    """
    jitted = jax.jit(statement)

    @given(seed=st.integers(0, 2**31), power=st.sampled_from([-30, -8, -4, -3, -2, -1, 0]))
    def check(kind, shape, seed, power):
        rng = np.random.default_rng(seed)
        library, precision = kind.split()

        def draw(name):
            if name == "points":
                return made(rng.uniform(-1, 1, (*shape, 5, 3)).astype(precision))
            turn = rng.normal(size=(*shape, 3))
            turn *= rng.uniform(0, 0.99 * np.pi, (*shape, 1)) / np.linalg.norm(turn, axis=-1, keepdims=True)
            rest = rng.uniform(-1, 1, (*shape, 4))
            step = made((10.0**power * np.concatenate([turn, rest], axis=-1)).astype(precision))
            if name == "step":
                return step
            pose = Similarity.exp(np.asarray(step))
            return pose if library == "numpy" else pose.to_jax(precision)

        with jax.enable_x64(precision == "float64"):
            made = np.asarray if library == "numpy" else jnp.asarray
            given = [draw(name) for name in inspect.signature(statement).parameters]
            one, other = (statement if library == "numpy" else jitted)(*given)
            assert jax.tree.structure(one) == jax.tree.structure(other)
            for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
                assert isinstance(x, np.ndarray if library == "numpy" else jax.Array)
                assert x.dtype == y.dtype == precision and x.shape[: len(shape)] == shape
                np.testing.assert_allclose(x, y, rtol=TOLERANCE[precision], atol=TOLERANCE[precision])

    check.__name__, check.__doc__ = statement.__name__, statement.__doc__
    shapes = pytest.mark.parametrize("shape", [(), (2, 3)], ids=str)
    return pytest.mark.parametrize("kind", KINDS)(shapes(check))


def product(one, other):
    """A matrix product by its definition."""
    return (one[..., :, :, None] * other[..., None, :, :]).sum(-2)


@law
def test_closure(a, b):
    """A product is a similarity: its rotation is one, its scale the product of scales."""
    made = a @ b
    back = Similarity.exp(made.log())
    return (made.rotation, made.scale), (back.rotation, a.scale * b.scale)


@law
def test_identity(a):
    one = Similarity.exp(a.log() * 0)
    return (one @ a, a @ one, one), (a, a, a @ a.inverse())


@law
def test_inverse(a):
    one = Similarity.exp(a.log() * 0)
    return (a @ a.inverse(), a.inverse() @ a, a.inverse().inverse()), (one, one, a)


@law
def test_associativity(a, b, c):
    return (a @ b) @ c, a @ (b @ c)


@law
def test_the_inverse_of_a_product(a, b):
    return (a @ b).inverse(), b.inverse() @ a.inverse()


@law
def test_a_product_is_a_product_of_matrices(a, b):
    return (a @ b).to_matrix(), product(a.to_matrix(), b.to_matrix())


@law
def test_points_are_mapped_one_after_another(a, b, points):
    return (a @ b) @ points, a @ (b @ points)


@law
def test_an_inverse_maps_points_back(a, points):
    return a.inverse() @ (a @ points), points


@law
def test_points_are_mapped_as_the_matrix_says(a, points):
    linear, shift = a.to_matrix()[..., :3, :3], a.to_matrix()[..., :3, 3]
    return a @ points, product(points, linear.swapaxes(-1, -2)) + shift[..., None, :]


@law
def test_a_matrix_says_all_of_it(a):
    return Similarity.from_matrix(a.to_matrix()), a


@law
def test_log_is_the_inverse_of_exp(step):
    return Similarity.exp(step).log(), step


@law
def test_exp_is_the_inverse_of_log(a):
    return Similarity.exp(a.log()), a


@law
def test_a_tangent_of_six_keeps_the_size(a, step):
    moved = retract(a, step[..., :6])
    return (moved, moved.scale), (retract(a, step * np.array([1] * 6 + [0], step.dtype)), a.scale)


@law
def test_retracting_the_difference_arrives(a, b, step):
    """And the step that retracts is the difference."""
    return (retract(a, difference(a, b)), difference(a, retract(a, step))), (b, step)


@law
def test_retract_is_exp_about_the_centre(a, step):
    """In the frame with the camera's axes, the object's centre as origin, and its diameter as unit."""
    one = Similarity.exp(step * 0)
    centred = Similarity(one.rotation, a.translation, a.scale)
    return retract(a, step), centred @ Similarity.exp(step) @ centred.inverse() @ a


@law
def test_steps_from_the_identity_are_exp(step):
    return retract(Similarity.exp(step * 0), step), Similarity.exp(step)


def random_pose(seed: int, shape=()) -> Similarity:
    """In JAX, float32."""
    rng = np.random.default_rng(seed)
    return Similarity.exp(jnp.asarray(rng.uniform(-1, 1, (*shape, 7)), jnp.float32))


def test_one_composes_with_many_and_batches_are_vmaps():
    one, many = random_pose(0), random_pose(1, (4,))
    points = jnp.asarray(np.random.default_rng(2).normal(size=(4, 5, 3)), jnp.float32)
    for f, left, right in (
        (lambda a, b: a @ b, one, many),
        (lambda a, b: b @ a, one, many),
        (lambda a, p: a @ p, one, points),
        (lambda a, b: difference(a, b), one, many),
    ):
        for found, wanted in zip(
            jax.tree.leaves(f(left, right)), jax.tree.leaves(jax.vmap(f, (None, 0))(left, right)), strict=True
        ):
            np.testing.assert_allclose(found, wanted, atol=1e-6)
    for f in (lambda a: a.inverse(), lambda a: a.log(), lambda a: a.to_matrix(), lambda a: retract(a, a.log())):
        for found, wanted in zip(jax.tree.leaves(f(many)), jax.tree.leaves(jax.vmap(f)(many)), strict=True):
            np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_allclose((many @ points[0])[2], jax.tree.map(lambda x: x[2], many) @ points[0], atol=1e-6)
    assert Similarity.identity((2, 3)).rotation.shape == (2, 3, 3, 3)
    assert eqx.tree_equal(Similarity.identity((4,)) @ many, many)


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-6, 1e-3, 0.1, 3.0])
def test_derivatives_are_finite_and_right(length, x64):
    """At the identity and beside it; ``log`` of ``exp`` has the identity for its derivative."""
    direction = np.array([0.6, -0.48, 0.64, 0.2, -0.1, 0.3, 0.4])
    step = jnp.asarray(length * direction)
    for slopes in THERE_AND_BACK:
        np.testing.assert_allclose(slopes(step), np.eye(7), atol=1e-9)
    pose = Similarity.exp(np.asarray(step)).to_jax(jnp.float64)
    for slopes in SLOPES:
        for x in jax.tree.leaves((slopes(pose), slopes(pose.to_numpy().to_jax()))):
            assert np.isfinite(x).all()
    assert np.isfinite(CURVATURE(pose, jnp.zeros(7))).all()


THERE_AND_BACK = [jax.jit(d(lambda step: Similarity.exp(step).log())) for d in (jax.jacfwd, jax.jacrev)]
SLOPES = [
    jax.jit(jax.jacfwd(lambda a: (a @ a.inverse(), a.to_matrix()))),
    jax.jit(jax.jacrev(lambda a: difference(a, a))),
    jax.jit(jax.jacrev(lambda a: a.log())),
]
CURVATURE = jax.jit(jax.hessian(lambda pose, step: jnp.sum(retract(pose, step).to_matrix() ** 2), argnums=1))


def test_composing_is_differentiable_as_differences_say(x64):
    a, b, c = (jax.tree.map(lambda x: x.astype(jnp.float64), random_pose(seed)) for seed in range(3))
    points = jnp.asarray(np.random.default_rng(3).normal(size=(6, 3)))
    told = jax.jit(lambda step: (retract(a, step).inverse() @ b @ retract(c, step) @ points).reshape(-1))
    slopes = jax.jit(jax.jacfwd(told))(jnp.zeros(7))
    for k, unit in enumerate(np.eye(7)):
        np.testing.assert_allclose(slopes[:, k], (told(1e-6 * unit) - told(-1e-6 * unit)) / 2e-6, atol=1e-7)


@given(seed=st.integers(0, 2**31), power=st.integers(-8, 0))
def test_rotations_are_rotations(seed, power):
    vector = jnp.asarray(np.random.default_rng(seed).normal(size=3) * 10.0**power, jnp.float32)
    matrix = np.asarray(rotation_from_vector(vector), np.float64)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=2e-6)
    np.testing.assert_allclose(matrix @ np.asarray(vector), vector, atol=1e-5)
    assert bool(jnp.all(jnp.isfinite(jax.jacfwd(rotation_from_vector)(vector))))


@given(seed=st.integers(0, 2**31), short=st.sampled_from([0.0, 1e-12, 1e-7, 1e-4, 1e-2]))
def test_half_turns_have_a_vector(seed, short):
    """Where the sine of the angle says nothing: the axis is found all the same, and either of its signs will do."""
    axis = np.random.default_rng(seed).normal(size=3)
    axis *= (np.pi - short) / np.linalg.norm(axis)
    found = vector_from_rotation(rotation_from_vector(axis))
    np.testing.assert_allclose(rotation_from_vector(found), rotation_from_vector(axis), atol=1e-13)
    assert np.linalg.norm(found) <= np.pi + 1e-15
    single = vector_from_rotation(rotation_from_vector(jnp.asarray(axis, jnp.float32)))
    np.testing.assert_allclose(rotation_from_vector(single), rotation_from_vector(axis), atol=2e-6)
    for axis in np.eye(3):  # where three of the quaternion's parts are zero
        half = 2 * np.diag(axis) - np.eye(3)
        np.testing.assert_allclose(abs(vector_from_rotation(half)), np.pi * axis)


def test_the_host_has_doubles_and_the_graph_singles():
    pose = random_pose(5)
    host = pose.to_numpy()
    assert {x.dtype for x in jax.tree.leaves(host @ host.inverse())} == {np.dtype(np.float64)}
    assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves((host @ host, host.inverse(), host.log())))
    assert eqx.tree_equal(host.to_jax(), pose)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(host.to_jax()))
    # What a graph holds fast is NumPy's until it meets what is traced.
    constant = jax.tree.map(lambda x: x.astype(np.float32), host)
    for found, wanted in zip(
        jax.tree.leaves(jax.jit(lambda a: constant @ a)(pose)), jax.tree.leaves(pose @ pose), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m * np.nan, "not finite"),
        (lambda m: m + np.eye(4)[[3, 0, 1, 2]], "last row|shears"),
        (lambda m: m * [[1], [1], [1], [2]], "last row"),
        (lambda m: m * [0, 0, 0, 1], "one point"),
        (lambda m: m * [1, 1, 1.1, 1], "shears"),
        (lambda m: m * [1, 1, -1, 1], "mirrors"),
        (lambda m: m[:3], "4 x 4"),
    ],
)
def test_what_is_no_similarity_is_refused_in_words(change, words):
    with pytest.raises(ValueError, match=words):
        Similarity.from_matrix.__wrapped__(change(random_pose(6).to_numpy().to_matrix()))


def test_wrong_shapes_are_refused_in_words():
    with pytest.raises(ValueError, match="rows of 3"):
        random_pose(0) @ jnp.zeros((3, 4))
    with pytest.raises(ValueError, match="rows of 3"):
        random_pose(0) @ jnp.zeros(3)
    with pytest.raises(ValueError, match="7 numbers"):
        retract(random_pose(0), jnp.zeros(5))
    with pytest.raises(ValueError, match="7 numbers"):
        Similarity.exp(jnp.zeros(8))


def test_what_is_no_array_is_refused_in_words():
    for pose in (random_pose(0), random_pose(0).to_numpy()):
        with pytest.raises(TypeError, match="'Similarity' and 'list'"):
            pose @ [[0.0, 0.0, 1.0]]
        with pytest.raises(TypeError, match="'Similarity'"):
            np.zeros((4, 3)) @ pose


def test_a_scale_may_be_a_plain_number():
    host = Similarity(np.eye(3), np.array([0.0, 0.0, 2.0]), 2.0)
    assert isinstance(host.scale, np.ndarray) and host.scale.dtype == np.float64
    np.testing.assert_array_equal((host.inverse() @ host).to_matrix(), np.eye(4))
    graph = Similarity(jnp.eye(3), jnp.zeros(3), 1)
    assert isinstance(graph.scale, jax.Array) and graph.scale.dtype == jnp.float32
    assert (graph @ jnp.ones((2, 3))).dtype == jnp.float32


def test_poses_are_picked_and_stacked():
    many = Similarity[np.ndarray].exp(np.random.default_rng(3).normal(0, 0.5, (4, 7)))
    again = Similarity[np.ndarray].stack([many.take(index) for index in range(4)])
    jax.tree.map(np.testing.assert_array_equal, again, many)
    assert isinstance(many.take(2).scale, np.ndarray) and many.take(2).scale.shape == ()
    mask = np.array([False, True, False, True])
    jax.tree.map(np.testing.assert_array_equal, many.take(mask), many.take(np.array([1, 3])))
    jax.tree.map(np.testing.assert_array_equal, many.take(slice(1, 2)).take(0), many.take(1))
    jax.tree.map(
        lambda x: np.testing.assert_array_equal(x[1], x[0]), jax.jit(Similarity.stack)([many.take(0).to_jax()] * 2)
    )
    with pytest.raises(ValueError, match="no pose"):
        Similarity.stack([])


def test_rotations_that_drifted_are_made_exact():
    pose = Similarity[np.ndarray].exp(np.random.default_rng(4).normal(0, 0.5, (5, 7)))
    drifted = Similarity(pose.rotation + 1e-6, pose.translation, pose.scale)
    found = drifted.orthonormal()
    np.testing.assert_allclose(
        found.rotation @ np.swapaxes(found.rotation, -1, -2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-15
    )
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=2e-6)
    assert found.translation is pose.translation and found.scale is pose.scale


def test_quaternions_turn_as_their_vectors_do():
    """x, y, z, w = (axis · sin, cos) of half the angle, of any length and either sign; four zeros turn nothing."""
    rng = np.random.default_rng(3)
    vector = rng.normal(size=(20, 3))
    half = np.linalg.norm(vector, axis=1, keepdims=True) / 2
    quaternion = np.concatenate([vector / (2 * half) * np.sin(half), np.cos(half)], 1)
    for factor in (1.0, -1.0, 1e200, 1e-200):
        found = rotation_from_quaternion(factor * quaternion)
        np.testing.assert_allclose(found, rotation_from_vector(vector), atol=1e-13)
    single = rotation_from_quaternion(jnp.asarray(quaternion, jnp.float32))
    np.testing.assert_allclose(single, rotation_from_vector(vector), atol=1e-6)
    np.testing.assert_array_equal(rotation_from_quaternion(np.zeros(4)), np.eye(3))
