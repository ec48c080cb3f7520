"""Direct alignment: the loss is the slow twin's, poses come back without bias, and nothing to see moves nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ipjax_kernels.direct import Points, Prior, align_directly, make_picture
from ipjax_kernels.reference import direct_loss
from scipy.spatial.transform import Rotation

SIDE, FOCAL, DISTANCE = 96, 220.0, 0.6
align = jax.jit(align_directly, static_argnames="steps")


def paint(points, seed):
    """Colours of places: smooth waves, three channels, none of which repeats within the ball."""
    waves = np.random.default_rng([7, seed]).normal(0, 1, (3, 3, 4)) * 30
    phase = np.random.default_rng([8, seed]).uniform(0, 6.28, (3, 4))
    return np.stack([np.sin(points @ waves[c] + phase[c]).mean(axis=-1) for c in range(3)], axis=-1)


def scene(seed):
    """A painted ball before a camera that is turned anyhow: what the camera sees, the ball's points, the true pose."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    translation = np.array([0.01, -0.02, DISTANCE])
    radius = 0.1
    rays = (np.indices((SIDE, SIDE))[::-1].transpose(1, 2, 0) - (SIDE - 1) / 2) / FOCAL
    rays = np.concatenate([rays, np.ones((SIDE, SIDE, 1))], axis=-1)
    a, b = (rays**2).sum(-1), rays @ translation
    root = b**2 - a * (translation @ translation - radius**2)
    depth = (b - np.sqrt(np.maximum(root, 0))) / a
    inside = root > 0
    seen = (rays * depth[..., None] - translation) @ rotation
    image = np.where(inside[..., None], paint(seen, seed), 0)
    lens = jnp.full(2, FOCAL), jnp.full(2, (SIDE - 1) / 2)
    picture = make_picture(jnp.asarray(image, jnp.float32), jnp.asarray(inside), *lens)
    # Another camera measured one side of the ball, which the photo sees most of.
    normals = np.random.default_rng(seed).normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    away = Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix() @ (rotation.T @ [0, 0, -1.0])
    normals = normals[normals @ away > 0.2]
    arrays = radius * normals, normals, paint(radius * normals, seed), np.ones(len(normals))
    padded = (np.concatenate([x, np.zeros((1500 - len(x), *x.shape[1:]))]) for x in arrays)
    return Points(*(jnp.asarray(x, jnp.float32) for x in padded)), picture, rotation, translation


def turned(rotation, seed, degrees):
    axis = np.random.default_rng([seed, 1]).normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix() @ rotation


def test_loss_is_the_slow_twins():
    points, picture, rotation, translation = scene(0)
    for degrees in (0, 4, 25):
        start = turned(rotation, 3, degrees)
        found = align(jnp.asarray(start, jnp.float32), jnp.asarray(translation, jnp.float32), points, picture, steps=0)
        expected = direct_loss(start, translation, points, picture)
        np.testing.assert_allclose(float(found.loss), expected, atol=2e-3)
        np.testing.assert_allclose(np.asarray(found.rotation), start, atol=1e-6)


def test_a_pose_some_degrees_off_comes_back_without_bias():
    turns, shifts = [], []
    for seed in range(12):
        points, picture, rotation, translation = scene(seed)
        start = turned(rotation, seed, 5.0)
        shift = translation + np.random.default_rng(seed).normal(0, 0.003, 3)
        found = align(jnp.asarray(start, jnp.float32), jnp.asarray(shift, jnp.float32), points, picture, steps=20)
        turns.append(Rotation.from_matrix(np.asarray(found.rotation, np.float64) @ rotation.T).as_rotvec(degrees=True))
        shifts.append(1e3 * (np.asarray(found.translation, np.float64) - translation))
    turns, shifts = np.array(turns), np.array(shifts)
    lengths = np.linalg.norm(turns, axis=1)
    assert np.median(lengths) < 0.25 and lengths.max() < 1.5
    assert np.abs(turns.mean(axis=0)).max() < 0.25
    aside = np.linalg.norm(shifts[:, :2], axis=1)
    assert np.median(aside) < 0.3 and aside.max() < 2
    assert np.abs(shifts[:, 2]).max() < 5
    assert np.abs(shifts.mean(axis=0)).max() < 0.5


def test_where_nothing_has_texture_the_prior_decides_and_texture_outweighs_a_weak_one():
    points, picture, rotation, translation = scene(2)
    start, shift = jnp.asarray(turned(rotation, 2, 5.0), jnp.float32), jnp.asarray(translation, jnp.float32)
    expected = jnp.asarray(turned(rotation, 2, 2.0), jnp.float32)
    off = lambda found, to: Rotation.from_matrix(np.asarray(found.rotation, np.float64) @ np.asarray(to).T).magnitude()
    plain = points._replace(colours=0 * points.colours), picture._replace(values=picture.values.at[..., :9].set(0))
    middle = jnp.sum(points.weight[:, None] * points.places, axis=0) / jnp.sum(points.weight)
    strong = Prior(expected, shift, jnp.diag(jnp.array([10.0, 10, 10, 1e3, 1e3, 1e3])), middle)
    assert np.degrees(off(align(start, shift, *plain, strong, steps=20), expected)) < 0.1
    weak = strong._replace(information=1e-3 * strong.information)
    found = align(start, shift, points, picture, weak, steps=20)
    assert np.degrees(off(found, rotation)) < 0.5
    # The loss that is told is that of the image alone.
    alone = align(found.rotation, found.translation, points, picture, steps=0)
    np.testing.assert_allclose(float(found.loss), float(alone.loss), atol=1e-3)


def test_a_prior_is_about_its_own_middle_wherever_the_points_lie():
    """One that knows where its middle is, and no turn, lets the camera turn about that and about nothing else."""
    points, picture, rotation, translation = scene(2)
    plain = points._replace(colours=0 * points.colours), picture._replace(values=picture.values.at[..., :9].set(0))
    middle = np.array([0.03, -0.02, 0.01])
    start = turned(rotation, 2, 4.0)
    shift = translation + (rotation - start) @ middle
    knows = jnp.diag(jnp.array([0.0, 0, 0, 1e3, 1e3, 1e3]))
    single = lambda x: jnp.asarray(x, jnp.float32)
    prior = Prior(single(rotation), single(translation), knows, single(middle))
    found = align(single(start), single(shift), *plain, prior, steps=20)
    np.testing.assert_allclose(np.asarray(found.rotation), start, atol=1e-4)
    np.testing.assert_allclose(np.asarray(found.translation), shift, atol=1e-5)


@pytest.mark.parametrize("fault", ["no points", "no normals", "no image", "one colour", "behind"])
def test_where_nothing_is_to_be_seen_the_pose_stays_and_slopes_are_finite(fault):
    points, picture, rotation, translation = scene(1)
    shift = jnp.asarray(translation, jnp.float32)
    if fault == "no points":
        points = points._replace(weight=0 * points.weight)
    elif fault == "no normals":
        points = points._replace(normals=0 * points.normals)
    elif fault == "no image":
        picture = picture._replace(values=0 * picture.values)
    elif fault == "one colour":
        points = points._replace(colours=0 * points.colours)
        picture = picture._replace(values=picture.values.at[..., :9].set(0))
    else:
        shift = -shift
    turn = jnp.asarray(rotation, jnp.float32)
    run = lambda turn, shift, points: align_directly(turn, shift, points, picture, steps=3)
    found = run(turn, shift, points)
    np.testing.assert_allclose(np.asarray(found.rotation), rotation, atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.translation), np.asarray(shift), atol=1e-5)
    assert 0 <= float(found.loss) <= 1
    total = lambda *x: sum(jnp.sum(leaf) for leaf in run(*x))
    slopes = jax.jit(jax.jacrev(total, argnums=(0, 1, 2)))(turn, shift, points)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(slopes))
