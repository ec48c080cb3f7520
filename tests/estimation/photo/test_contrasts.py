"""Colours of photo and query compared pixel by pixel: exposure does not matter, and poses come back without bias."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.photo_pairs import PhotoPair, make_photo_pair
from ipjax_kernels.direct import Prior
from scipy.spatial.transform import Rotation

from ipjax.cameras import point_map
from ipjax.config import ResectConfig
from ipjax.estimation.photo.contrasts import align_colours, align_drawn, contrast, prepare_comparison
from ipjax.estimation.photo.resection import measure_sight
from ipjax.synthetic.problems import AXES

CONFIG = ResectConfig()


@pytest.fixture(scope="module")
def pairs() -> list[PhotoPair]:
    """Six objects, each seen 35° from its photo, painted finely: light that turns with the camera is not texture."""
    return [painted(make_photo_pair(seed, 35.0), seed) for seed in range(6)]


def painted(pair: PhotoPair, seed: int) -> PhotoPair:
    """The pair with the colours of each place of the ellipsoid's surface replaced, in both images."""
    waves = np.random.default_rng([7, seed]).normal(0, 12, (3, 3, 4))
    phase = np.random.default_rng([8, seed]).uniform(0, 6.28, (3, 4))

    def paint(places):
        return 0.5 + 0.25 * np.stack([np.sin(places @ waves[c] + phase[c]).mean(axis=-1) for c in range(3)], axis=-1)

    def on_surface(pose, view):
        """Where each pixel's ray meets the ellipsoid, in its own unit; of a ray that misses, the nearest to it."""
        rays = np.asarray(point_map(view.camera, jnp.ones_like(view.depth)), np.float64)
        inverse = pose.inverse()
        eye, ahead = inverse.translation / AXES, (inverse.scale * rays @ inverse.rotation.T) / AXES
        a, b, c = (ahead**2).sum(-1), ahead @ eye, eye @ eye - 1
        along = (-b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        return (eye + along[..., None] * ahead) * AXES

    changed = pair
    for view, pose in (("photo", pair.photo_from_ellipsoid), ("query", pair.crop_from_ellipsoid)):
        where = (lambda p: p.templates.reference.view) if view == "photo" else (lambda p: p.query.view)
        old = where(changed)
        rgb = np.where(np.asarray(old.mask)[..., None], paint(on_surface(pose, old)), 0)
        new = dataclasses.replace(old, rgb=jnp.asarray(rgb, jnp.float32))
        if view == "photo":
            reference = dataclasses.replace(changed.reference, view=new)
            changed = dataclasses.replace(
                changed, templates=dataclasses.replace(changed.templates, reference=reference)
            )
        else:
            changed = dataclasses.replace(changed, query=dataclasses.replace(changed.query, view=new))
    return changed


@pytest.fixture(scope="module")
def align():
    def run(reference, query, turn, shift):
        comparison = prepare_comparison(reference, query)
        anywhere = Prior(turn, shift, jnp.zeros((6, 6)), comparison.middle)
        wide = align_colours(comparison, anywhere, CONFIG)
        sight = measure_sight(reference, query)
        return wide, align_drawn(reference, query, wide.rotation, wide.translation, anywhere, sight, CONFIG)

    return jax.jit(run)


def degrees(found, true) -> np.ndarray:
    return Rotation.from_matrix(np.asarray(found, np.float64) @ np.asarray(true, np.float64).T).as_rotvec(degrees=True)


def test_brighter_and_tinted_images_have_the_same_contrasts():
    rng = np.random.default_rng(0)
    image = np.asarray(rng.uniform(0.2, 0.6, (64, 64, 3)), np.float32)
    mask = np.zeros((64, 64), bool)
    mask[8:56, 12:50] = True
    plain = np.asarray(contrast(jnp.asarray(image), jnp.asarray(mask), 0.03))
    brighter = np.asarray(contrast(jnp.asarray(1.3 * image + 0.1), jnp.asarray(mask), 0.03))
    assert np.abs(plain).max() > 0.5
    assert np.abs(brighter - plain).mean() < 0.25 * np.abs(plain).mean()
    # What lies outside of the mask has none, and no say.
    assert (plain[~mask] == 0).all()
    changed = np.where(mask[..., None], image, 1 - image)
    np.testing.assert_allclose(np.asarray(contrast(jnp.asarray(changed), jnp.asarray(mask), 0.03)), plain, atol=1e-5)


def test_candidates_some_degrees_off_come_back_without_bias(pairs, align):
    """Ten degrees off about any axis: they end within some, drawn within two, and signed errors cancel."""
    errors, coarse = [], []
    for seed, pair in enumerate(pairs):
        true = pair.reference_from_query
        for k in range(2):
            axis = np.random.default_rng([seed, k]).normal(size=3)
            turn = Rotation.from_rotvec(np.radians(10) * axis / np.linalg.norm(axis)).as_matrix() @ true.rotation
            middle = prepare_comparison(pair.reference, pair.query).middle
            shift = np.asarray(true.translation) + (np.asarray(true.rotation) - turn) @ np.asarray(middle)
            start = jnp.asarray(turn, jnp.float32), jnp.asarray(shift, jnp.float32)
            wide, close = align(pair.reference, pair.query, *start)
            assert 0 <= float(wide.loss) <= 1 and 0 <= float(close.loss) <= 1
            coarse.append(degrees(wide.rotation, true.rotation))
            errors.append(degrees(close.rotation, true.rotation))
    lengths, before = np.linalg.norm(errors, axis=1), np.linalg.norm(coarse, axis=1)
    assert before.max() < 7 and np.median(before) < 3.5
    assert lengths.max() < 3 and np.median(lengths) < 1.5
    assert np.abs(np.mean(errors, axis=0)).max() < 1


def test_without_depth_or_colour_nothing_moves(pairs, align):
    pair = pairs[0]
    true = pair.reference_from_query
    start = jnp.asarray(true.rotation, jnp.float32), jnp.asarray(true.translation, jnp.float32)
    empty = eqx.tree_at(lambda q: q.view.depth, pair.query, jnp.zeros_like(pair.query.view.depth))
    for found in align(pair.reference, empty, *start):
        assert float(found.loss) == 1
        assert np.linalg.norm(degrees(found.rotation, true.rotation)) < 1e-2
    black = eqx.tree_at(lambda q: q.view.rgb, pair.query, jnp.zeros_like(pair.query.view.rgb))
    found = align(pair.reference, black, *start)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(found))
