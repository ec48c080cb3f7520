"""The query's surface as other cameras see it: where its points are, what is filled, and what sticks out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.photo_pairs import ENCODER, PhotoPair, make_photo_pair

from ipjax.config import ResectConfig
from ipjax.estimation.features import object_features
from ipjax.estimation.photo.drawing import contained_share, draw_query, look_from_beside, splat_query
from ipjax.estimation.photo.resection import measure_sight
from ipjax.synthetic.problems import AXES
from ipjax.transforms import rotation_from_vector

CONFIG = ResectConfig()


@pytest.fixture(scope="module")
def pairs() -> list[PhotoPair]:
    """Six objects, each seen 35° from its photo."""
    return [make_photo_pair(seed, 35.0) for seed in range(6)]


@pytest.fixture(scope="module")
def looks(pairs):
    """What each query looks like from beside."""
    beside = jax.jit(lambda templates, query, sight: look_from_beside(ENCODER, templates, query, sight, CONFIG))
    return [beside(pair.templates, pair.query, measure_sight(pair.reference, pair.query)) for pair in pairs]


def test_from_beside_points_stay_where_they_were_measured(pairs, looks):
    """Each patch remembers points of the query's surface: on the ellipsoid that it is, within it and outside alike."""
    off, count = [], []
    for pair, look in zip(pairs, looks, strict=True):
        assert look.patches.valid.shape == (CONFIG.beside, pair.query.patches.valid.shape[0])
        places = np.asarray(look.patches.points, np.float64)[np.asarray(look.patches.valid)]
        inside = pair.crop_from_ellipsoid.inverse() @ places
        off.append(np.linalg.norm(inside / AXES, axis=1) - 1)
        count.append(len(places) / CONFIG.beside)
    assert min(count) > 20  # patches of each look
    # A patch's mean lies a little under a curved surface.
    off = np.concatenate(off)
    assert abs(off.mean()) < 0.02 and np.quantile(np.abs(off), 0.9) < 0.05


def test_normals_from_beside_are_the_surfaces_own(pairs, looks):
    """Known ones face the query's camera, and are the ellipsoid's at that place: no lean, 10° of spread."""
    lean = []
    for pair, look in zip(pairs, looks, strict=True):
        normals, places = (np.asarray(x, np.float64) for x in (look.normals, look.patches.points))
        known = np.linalg.norm(normals, axis=-1) > 0.5
        assert known.sum() > 60 and (np.sum(normals * places, axis=-1)[known] < 0).all()
        pose = pair.crop_from_ellipsoid
        inside = pose.inverse() @ places[known]
        outwards = inside / AXES**2 @ pose.rotation.T
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        lean.append(np.degrees(np.cross(outwards, normals[known])))
    lean = np.concatenate(lean)
    assert (np.abs(lean.mean(axis=0)) < 3).all() and np.linalg.norm(lean, axis=1).mean() < 10


def test_the_points_seen_from_beside_are_features_of_the_same_surface(pairs, looks):
    """A patch drawn from beside is most like the patch of the query that shows the same surface."""
    apart = []
    for pair, look in zip(pairs, looks, strict=True):
        own = pair.query.patches
        features = np.asarray(object_features(own.features, pair.templates), np.float64)
        valid = np.asarray(own.valid)
        drawn = np.asarray(look.patches.features, np.float64)[np.asarray(look.patches.valid)]
        there = np.asarray(look.patches.points)[np.asarray(look.patches.valid)]
        best = np.argmax(np.where(valid, drawn @ features.T, -np.inf), axis=1)
        distance = np.linalg.norm(np.asarray(own.points)[best] - there, axis=1)
        apart.append(distance / float(pair.crop_from_ellipsoid.scale))
    assert np.median(np.concatenate(apart)) < 0.08  # a patch is 0.06 of the size


def test_all_of_the_query_lies_behind_the_outline_at_the_truth_only(pairs):
    """At the true pose nothing sticks out; turned in the image or moved aside, much does."""
    for pair in pairs:
        true = pair.reference_from_query
        rotation, translation = jnp.asarray(true.rotation, jnp.float32), jnp.asarray(true.translation, jnp.float32)
        share = lambda turn, shift, pair=pair: float(contained_share(pair.reference, pair.query, turn, shift))
        assert share(rotation, translation) > 0.99
        aside = translation.at[0].add(0.3 * float(pair.crop_from_ellipsoid.scale))
        assert share(rotation, aside) < 0.9
        behind = translation.at[2].add(-10.0)  # the camera is past it
        assert share(rotation, behind) == 0


def test_a_surface_drawn_larger_than_it_was_seen_has_no_pepper(pairs):
    """From half as far, points lie apart: within the drawing no pixel stays empty, and the outline does not grow."""
    pair = pairs[0]
    true = pair.reference_from_query
    middle = np.asarray(pair.photo_from_ellipsoid.translation)
    near = jnp.asarray(true.translation - np.array([0, 0, middle[2] * 0.45]), jnp.float32)
    sight = measure_sight(pair.reference, pair.query)
    _, depth = splat_query(pair.reference, pair.query, jnp.asarray(true.rotation, jnp.float32), near, sight)
    shown = np.asarray(depth) > 0
    inner = shown.copy()
    for _ in range(6):  # away from the rim
        inner = inner & np.roll(inner, 1, 0) & np.roll(inner, -1, 0) & np.roll(inner, 1, 1) & np.roll(inner, -1, 1)
    import cv2

    closed = cv2.morphologyEx(shown.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    assert shown.sum() > 1000 and (closed > shown).sum() < 0.01 * shown.sum()


def test_without_measured_depth_all_is_finite_and_nothing_is_valid(pairs):
    pair = pairs[0]
    empty = eqx.tree_at(lambda q: q.view.depth, pair.query, jnp.zeros_like(pair.query.view.depth))
    sight = measure_sight(pair.reference, empty)
    look = look_from_beside(ENCODER, pair.templates, empty, sight, CONFIG)
    assert not np.asarray(look.patches.valid).any()
    for leaf in jax.tree.leaves(look):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()


def test_a_turned_candidate_scores_below_the_truth(pairs):
    """Overlap and containment together fall with the error."""
    for pair in pairs[:3]:
        true, sight = pair.reference_from_query, measure_sight(pair.reference, pair.query)
        scores = []
        for degrees in (0, 25, 60):
            turn = rotation_from_vector(np.deg2rad(degrees) * np.array([0.0, 0.0, 1.0]))
            middle = np.asarray(pair.photo_from_ellipsoid.translation)
            rotation = turn @ true.rotation
            translation = turn @ (true.translation - middle) + middle
            pose = (jnp.asarray(x, jnp.float32) for x in (rotation, translation))
            drawn = draw_query(ENCODER, pair.templates, pair.query, *pose, sight, CONFIG)
            scores.append(float(drawn.overlap * drawn.contained))
        assert scores[0] > scores[1] > scores[2], scores
