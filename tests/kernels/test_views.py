"""A view drawn from frames: the same as pixel by pixel, and what is seen where nothing stood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ipjax_kernels.reference import views as reference
from ipjax_kernels.views import Rules, Sources, draw_view

HEIGHT, WIDTH = 18, 24
FOCAL, CENTRE = jnp.full(2, 26.0), jnp.array([11.5, 8.5])
RULES = Rules(0.03, 0.2, 0.1)


def look(angles, rng=None):
    """A box of 0.2 m before a wall, from cameras that go around it: colours tell where a point is."""
    colours, depths, rotations, translations = [], [], [], []
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(columns - 11.5) / 26, (rows - 8.5) / 26, np.ones(columns.shape)], -1)
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])  # camera_from_world, about the point (0, 0, 1)
        translation = np.array([0, 0, 1.0]) - rotation @ [0, 0, 1.0]
        eye, ahead = -rotation.T @ translation, rays @ rotation
        wall = (1.3 - eye[2]) / ahead[..., 2]
        low, high = np.array([-0.1, -0.1, 0.9]), np.array([0.1, 0.1, 1.1])
        with np.errstate(divide="ignore"):
            near, far = (low - eye) / ahead, (high - eye) / ahead
        start, end = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
        depth = np.where(start < end, start, wall)
        points = eye + depth[..., None] * ahead
        if rng is not None:
            depth = np.where(rng.uniform(size=depth.shape) < 0.05, 0, depth * (1 + rng.normal(0, 0.003, depth.shape)))
        colours.append(np.where((start < end)[..., None], [0.9, 0.2, 0.1], 0.5 + 0.4 * np.sin(6 * points)))
        depths.append(depth)
        rotations.append(rotation)
        translations.append(translation)
    return np.stack(colours), np.stack(depths), np.stack(rotations), np.stack(translations)


def as_sources(seen, view, weights):
    """The frames as sources of a view, which is one of the same kind."""
    colours, depths, rotations, translations = seen
    turn = rotations @ view[2][0].T
    shift = translations - turn @ view[3][0]
    parts = (colours, depths, turn, shift, weights, FOCAL, CENTRE)
    return Sources(*(jnp.asarray(part, jnp.float32) for part in parts))


@pytest.fixture(scope="module")
def drawn():
    """Four views at once: of three frames, of one about which the others are silent, of none, and of noisy ones."""
    view = look([0.05])
    seen, same = look([-0.3, 0.5, 0.7]), look([0.05, 0.2, 0.5])
    same[1][1:] = 0.5  # nonsense
    noisy = look([-0.3, 0.1, 0.4], np.random.default_rng(0))
    batch = [
        as_sources(frames, view, np.array(weights))
        for frames, weights in ((seen, [1, 1, 1]), (same, [1, 0, 0]), (same, [0, 0, 0]), (noisy, [1, 0.7, 0.2]))
    ]
    draw = jax.vmap(lambda sources: draw_view(sources, RULES, FOCAL, CENTRE, HEIGHT, WIDTH))
    return view, jax.tree.map(np.asarray, draw(jax.tree.map(lambda *x: jnp.stack(x), *batch))), batch[3]


def test_as_pixel_by_pixel(drawn):
    _, (colours, depth, support), sources = drawn
    want_colours, want_depth, want_support = reference.draw_view(sources, RULES, FOCAL, CENTRE, HEIGHT, WIDTH)
    # Where rounding decides which guess is taken, or whether a point is in a pixel, the two may differ.
    same = np.abs(depth[3] - want_depth) < 1e-4
    assert same.mean() > 0.99 and (want_depth > 0).mean() > 0.8
    np.testing.assert_allclose(colours[3][same], want_colours[same], atol=2e-3)
    np.testing.assert_allclose(support[3][same], want_support[same], atol=2e-3)


def test_what_is_between_frames_is_drawn_and_the_rest_is_unknown(drawn):
    view, (colours, depth, support), _ = drawn
    known = depth[0] > 0
    off = np.abs(depth[0] - view[1][0])[known]
    assert 0.9 < known.mean() < 1 and np.median(off) < 1e-3 and (off < 0.01).mean() > 0.95
    wrong = np.abs(colours[0] - view[0][0]).max(-1)
    assert np.median(wrong[known]) < 0.02 and (depth[0] < 1.2)[known].sum() > 20
    assert (support[0][~known] == 0).all() and (support[0][known] > 0).all() and (colours[0][~known] == 0).all()


def test_a_source_without_weight_is_not_there(drawn):
    view, (colours, depth, _), _ = drawn
    np.testing.assert_allclose(depth[1], view[1][0], rtol=1e-4)
    np.testing.assert_allclose(colours[1], view[0][0], atol=1e-4)
    assert (depth[2] == 0).all()
