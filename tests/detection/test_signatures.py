"""What crops are ranked by: raw features are found again in centred and cut templates, and colours in histograms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from builders.detections import ellipsoid

from ipjax.detection.colours import bin_of, histogram, template_histograms, to_lab
from ipjax.detection.signatures import crop_signature, similarity, template_signatures
from ipjax.estimation.features import centre, cut, principal_basis
from ipjax.synthetic import problems


def test_raw_features_are_pooled_whatever_the_templates_store():
    templates, _ = ellipsoid()
    raw = template_signatures(templates)
    patches, mean, norm = centre(templates.patches)
    centred = dataclasses.replace(templates, patches=patches, mean=mean, norm=norm)
    again = template_signatures(centred)
    np.testing.assert_allclose(again.whole, raw.whole, atol=1e-5)
    np.testing.assert_allclose(again.cells, raw.cells, atol=1e-5)
    basis = principal_basis(patches, 32)
    short, length = cut(patches.features, jnp.asarray(basis))
    reduced = dataclasses.replace(
        centred, patches=dataclasses.replace(patches, features=short), norm=norm * length, basis=jnp.asarray(basis)
    )
    np.testing.assert_allclose(template_signatures(reduced).cells, raw.cells, atol=1e-5)


def test_a_template_is_most_like_itself_and_absent_ones_count_nothing():
    templates, _ = ellipsoid()
    every = template_signatures(templates)
    first = jax.tree.map(lambda x: x[:5], every)
    itself = similarity(every, first, 1, 0.5)
    np.testing.assert_allclose(itself, 2.5, atol=1e-5)
    absent = dataclasses.replace(first, present=jnp.zeros(5, bool))
    assert (np.asarray(similarity(every, absent, 1, 0.5)) < -1).all()
    none = dataclasses.replace(every, present=every.present.at[5:].set(False))
    assert (np.asarray(similarity(none, jax.tree.map(lambda x: x[5:], every), 3, 0.5)) < 2.5).all()


def test_the_query_of_an_object_is_like_it():
    templates, _ = ellipsoid()
    query = problems.make_query(1)[0]
    one = jax.tree.map(lambda x: x[None], crop_signature(query.patches, query.view))
    assert float(similarity(template_signatures(templates), one, 3, 0.5)[0]) > 1.5


def test_colours_are_those_of_the_standard():
    known = {(1, 1, 1): (100, 0, 0), (1, 0, 0): (53.24, 80.09, 67.20), (0, 0, 1): (32.30, 79.19, -107.86)}
    for rgb, lab in known.items():
        np.testing.assert_allclose(to_lab(jnp.asarray(rgb, jnp.float32)), lab, atol=0.05)
    grey = jnp.full((10, 3), 0.5)
    only = histogram(bin_of(grey), jnp.ones(10))
    assert float(jnp.sum(only**2)) == 1.0 and int(jnp.sum(only > 0)) == 1
    assert not histogram(bin_of(grey), jnp.zeros(10)).any()


def test_colours_of_a_template_are_of_the_side_it_shows():
    templates, _ = ellipsoid()
    found = template_histograms(templates)
    np.testing.assert_allclose(jnp.sum(found**2, axis=1), 1, atol=1e-5)
    assert not template_histograms(dataclasses.replace(templates, appearance=None)).any()
