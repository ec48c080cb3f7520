"""Scores prefer the truth, ignore occluders, and stay in [0, 1]."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.cameras import project
from ipjax.config import ScoreConfig
from ipjax.estimation.scoring import (
    chroma_correlation,
    closeness,
    depth_agreement,
    drawn_agreement,
    feature_agreement,
    look_along,
    score,
    seen_share,
)
from ipjax.records import Camera
from ipjax.synthetic import problems
from ipjax.transforms import retract

CONFIG = ScoreConfig()
depth_score = jax.jit(depth_agreement)
feature_score = jax.jit(feature_agreement)
drawn_score = jax.jit(drawn_agreement)


@pytest.fixture(scope="module")
def templates():
    return eqx.tree_at(lambda t: t.surface, problems.make_templates(), problems.make_surface(2048))


@pytest.fixture(scope="module")
def case():
    query, truth = problems.make_query(6)
    camera = query.view.camera
    camera = Camera(camera.focal / 2, (camera.centre + 0.5) / 2 - 0.5)
    return query, query.view.depth[1::2, 1::2], query.view.mask[1::2, 1::2], camera, truth


def disturb(pose, seed, rotation=0.5, shift=0.15):
    rng = np.random.default_rng(seed)
    turn, move = rng.normal(size=(2, 3))
    step = [*(rotation * turn / np.linalg.norm(turn)), *(shift * move / np.linalg.norm(move)), 0.0]
    return retract(pose, jnp.asarray(step, jnp.float32))


@pytest.mark.parametrize("seed", range(20))
def test_the_truth_agrees_with_the_depth_and_others_less(templates, case, seed):
    """The rim of a smooth body is steeper than a cell, so even the truth does not agree everywhere."""
    _, depth, mask, camera, truth = case
    best = float(depth_score(templates.surface, depth, mask, camera, truth, CONFIG))
    other = float(depth_score(templates.surface, depth, mask, camera, disturb(truth, seed), CONFIG))
    assert 0 <= other < best <= 1
    assert best > 0.7


def test_an_occluder_counts_neither_way(templates, case):
    """Half of the object behind something near: the truth scores nearly as well as before."""
    _, depth, mask, camera, truth = case
    whole = float(depth_score(templates.surface, depth, mask, camera, truth, CONFIG))
    hidden = jnp.asarray(np.arange(56) < 28)[None, :]
    nearer = jnp.where(hidden, 0.5 * float(truth.translation[2]), depth)
    score = float(depth_score(templates.surface, nearer, mask & ~hidden, camera, truth, CONFIG))
    assert score > 0.85 * whole
    # The same half farther away than the object can be: it is not there.
    farther = jnp.where(hidden, 2 * float(truth.translation[2]), depth)
    assert float(depth_score(templates.surface, farther, mask & ~hidden, camera, truth, CONFIG)) < 0.6 * score


@pytest.mark.parametrize("seed", range(20))
def test_features_prefer_the_truth(templates, case, seed):
    query, *_, truth = case
    best = float(feature_score(templates, query, truth, CONFIG))
    far = disturb(truth, seed, rotation=0.9, shift=0.3)
    assert 0 <= float(feature_score(templates, query, far, CONFIG)) < best <= 1


def test_a_template_is_closest_to_its_own_viewpoint(templates):
    for view in range(8):
        pose = jax.tree.map(lambda x, view=view: x[view], templates.camera_from_object)
        angles = np.asarray(closeness(templates, pose))
        assert angles.argmin() == view and angles[view] < 1e-3


@given(seed=st.integers(0, 2**31))
def test_looking_along_a_ray_puts_it_on_the_axis(seed):
    ray = np.random.default_rng(seed).normal(size=3)
    ray[2] = abs(ray[2]) + 0.1
    ray /= np.linalg.norm(ray)
    turn = np.asarray(look_along(jnp.asarray(ray, jnp.float32)), np.float64)
    np.testing.assert_allclose(turn @ ray, [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)


def test_nothing_seen_scores_nothing(templates, case):
    query, depth, mask, camera, truth = case
    nothing = jnp.zeros_like(mask)
    assert float(depth_score(templates.surface, jnp.zeros_like(depth), nothing, camera, truth, CONFIG)) == 0
    blind = eqx.tree_at(lambda q: q.view.mask, query, jnp.zeros_like(query.view.mask))
    assert float(feature_score(templates, blind, truth, CONFIG)) == 0


@pytest.fixture(scope="module")
def drawn(case):
    """The score of a pose by what it looks like, and of one behind an occluder over the left half."""
    query, *_ = case
    encoder = problems.make_encoder()
    known = dataclasses.replace(problems.make_templates(), appearance=problems.make_appearance(20_000))

    def rate(pose, query=query):
        return float(drawn_score(encoder, known, query, pose, CONFIG)[0])

    return rate


@pytest.mark.parametrize("seed", range(10))
def test_drawing_prefers_the_truth(case, drawn, seed):
    *_, truth = case
    best = drawn(truth)
    assert 0 <= drawn(disturb(truth, seed)) < best <= 1
    assert best > 0.85  # splats are a pixel wider than the body


def test_what_is_hidden_is_not_drawn(case, drawn):
    """Half behind something near: as good as before. The same half with nothing before it: not there."""
    query, *_, truth = case
    side = query.view.depth.shape[0]
    hidden = jnp.asarray(np.arange(side) < side // 2)[None, :]

    def change(depth):
        view = query.view
        mask = view.mask & ~hidden
        view = type(view)(
            jnp.where(mask[..., None], view.rgb, 0), jnp.where(hidden, depth, view.depth), mask, view.camera
        )
        return type(query)(query.patches, view)

    behind = drawn(truth, change(0.5 * truth.translation[2]))
    assert behind > 0.9 * drawn(truth)
    assert drawn(truth, change(2 * truth.translation[2])) < 0.7 * behind


def test_out_of_sight_looks_like_nothing(case, drawn):
    *_, truth = case
    away = retract(truth, jnp.array([0, 0, 0, 50.0, 0, 0, 0], jnp.float32))
    assert drawn(away) == 0


def test_nothing_to_draw_is_said(templates, case):
    query, *_, truth = case
    with pytest.raises(ValueError, match="no appearance to draw"):
        drawn_agreement(problems.make_encoder(), templates, query, truth)


def test_colours_correlate_whatever_the_light():
    """A brighter, tinted copy is the same, opposite colours are the opposite, grey says nothing, nor does no patch."""
    rng = np.random.default_rng(0)
    colours = jnp.asarray(rng.uniform(0, 1, (40, 3)), jnp.float32)
    weight = jnp.asarray(rng.uniform(0, 1, 40), jnp.float32)
    grey = jnp.repeat(colours[:, :1], 3, axis=1) + jnp.asarray(rng.normal(0, 0.003, (40, 3)), jnp.float32)
    compare = lambda other, share=weight: float(chroma_correlation(colours, other, share))
    assert compare(colours) > 0.98 and compare(0.4 * colours + jnp.array([0.2, 0.1, 0.0])) > 0.9
    assert compare(2 * jnp.mean(colours, axis=-1, keepdims=True) - colours) < -0.98  # as bright, of the opposite hue
    assert compare(jnp.asarray(rng.uniform(0.4, 1, (40, 1)), jnp.float32) * colours) > 0.97  # shade
    assert abs(compare(grey)) < 0.2
    assert compare(colours, jnp.zeros(40)) == 0
    half = weight.at[:20].set(0)  # what does not count may be anything
    assert compare(colours.at[:20].set(0.5), half) == pytest.approx(compare(colours, half), abs=1e-6)


def test_colours_tell_what_features_cannot(case):
    """An encoder that sees nothing leaves the choice to colours: red left and blue right against the reverse."""
    query, *_, truth = case
    side = query.view.depth.shape[0]
    middle = float(np.median(np.nonzero(np.asarray(query.view.mask))[1]))
    left = (np.arange(side) < middle)[None, :, None]
    seen = jnp.where(
        query.view.mask[..., None], jnp.where(left, jnp.array([0.8, 0.2, 0.1]), jnp.array([0.1, 0.2, 0.8])), 0
    )
    painted = dataclasses.replace(query, view=dataclasses.replace(query.view, rgb=seen))
    appearance = problems.make_appearance(20_000)
    red = (project(query.view.camera, truth @ appearance.points)[:, :1]) < middle
    paint = lambda first, second: dataclasses.replace(
        problems.make_templates(),
        appearance=dataclasses.replace(appearance, colours=jnp.where(red, jnp.array(first), jnp.array(second))),
    )
    blind = lambda image: problems.make_encoder()(jnp.zeros_like(image))
    right = drawn_agreement(blind, paint([0.8, 0.2, 0.1], [0.1, 0.2, 0.8]), painted, truth, CONFIG)
    wrong = drawn_agreement(blind, paint([0.1, 0.2, 0.8], [0.8, 0.2, 0.1]), painted, truth, CONFIG)
    assert float(right[1]) > 0.7 and float(wrong[1]) < -0.7
    assert float(right[0]) == pytest.approx(float(wrong[0]), abs=1e-5)


def test_the_seen_share_of_a_half_guessed_body(templates, case):
    """Seen from its known side, from its guessed side, and from between them."""
    *_, truth = case
    surface = templates.surface
    eye = -(truth.rotation.T @ truth.translation) / truth.scale
    toward = surface.points @ eye > 0
    of = lambda seen: float(seen_share(dataclasses.replace(surface, seen=jnp.where(seen, 1.0, 0.0)), truth))
    assert of(toward) > 0.9 and of(~toward) < 0.1
    assert of(toward) + of(~toward) == pytest.approx(1, abs=1e-5)
    beside = jnp.cross(eye, jnp.array([0.3, 0.5, 0.7]))
    assert 0.35 < of(surface.points @ beside > 0) < 0.65
    assert of(jnp.ones_like(toward)) == pytest.approx(1, abs=1e-6)


def test_guessed_surface_is_judged_by_its_shape_alone(templates, case):
    """Painted in the wrong colours, a body that was seen loses to a guessed one; in the right ones it wins."""
    query, depth, mask, camera, truth = case
    encoder = problems.make_encoder()
    appearance = problems.make_appearance(20_000)
    wrong = dataclasses.replace(appearance, colours=appearance.colours[::-1])

    def rate(look, seen):
        surface = dataclasses.replace(templates.surface, seen=jnp.full(len(templates.surface.seen), seen))
        known = dataclasses.replace(templates, surface=surface, appearance=look)
        return float(score(encoder, known, query, depth, mask, camera, truth, CONFIG)[0])

    assert rate(wrong, 0.0) == pytest.approx(rate(appearance, 0.0), rel=1e-5)
    assert rate(wrong, 1.0) < rate(wrong, 0.0) < rate(appearance, 1.0)
