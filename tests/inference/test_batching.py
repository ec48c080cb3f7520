"""Objects padded to one size: those from photos without depth keep the view through which their pose is found."""

import dataclasses

import jax
import numpy as np
import pytest
from builders.objects import make_object, with_reference
from builders.tiny_pipeline import TINY

import ipjax
from ipjax.files.objects.deviations import with_deviations
from ipjax.inference.exporting import estimate_dictionaries, to_dictionary
from ipjax.synthetic import problems


def two_photos():
    """Two objects from photos, of more and fewer views; the photos are of one size."""
    return [with_reference(make_object(views=views, seed=views)[0], seed=views) for views in (5, 3)]


def test_reference_views_are_stacked():
    objects = two_photos()
    padded = ipjax.pad_templates(objects)
    assert padded.norm.shape == (2, 5, 4) and padded.reference.view.rgb.shape == (2, 28, 28, 3)
    assert padded.reference.patches.encoder == padded.patches.encoder == "dinov2 vits14 block=8"
    for index, one in enumerate(objects):
        found = jax.tree.map(lambda x, index=index: x[index], padded.reference)
        jax.tree.map(np.testing.assert_array_equal, found, one.reference)
    unnamed = dataclasses.replace(objects[1], patches=dataclasses.replace(objects[1].patches, encoder=None))
    assert ipjax.pad_templates([objects[0], unnamed]).reference.patches.encoder == "dinov2 vits14 block=8"


def test_deviations_of_points_are_padded_where_all_objects_have_them():
    objects = [with_reference(make_object(points=count, seed=count)[0]) for count in (7, 5)]
    known = [dataclasses.replace(o, surface=with_deviations(o.surface, "inflate")) for o in objects]
    surface = ipjax.pad_templates(known).surface
    assert surface.along_std is not None and surface.along_std.shape == (2, 7)
    np.testing.assert_array_equal(surface.along_std[1, :5], known[1].surface.along_std)
    assert ipjax.pad_templates([known[0], objects[1]]).surface.along_std is None


def test_compact_leaves_the_reference_view_whole():
    templates = problems.make_templates()
    whole = with_reference(templates, side=112)
    small = ipjax.compact(whole, multiple=8)
    assert small.norm.shape[1] < whole.norm.shape[1]
    jax.tree.map(np.testing.assert_array_equal, small.reference, whole.reference)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: dataclasses.replace(t, reference=None), "from a photo without depth, .* and some were not"),
        (lambda t: with_reference(t, side=14), r"differ in size, \[14, 14\] pixels .* \[28, 28\] pixels"),
        (
            lambda t: dataclasses.replace(t, reference=with_reference(make_object(patches=6, seed=1)[0]).reference),
            "differ in size, .* with 4 patches and .* with 6 patches",
        ),
        (
            lambda t: dataclasses.replace(
                t,
                reference=dataclasses.replace(
                    t.reference, patches=dataclasses.replace(t.reference.patches, encoder="b")
                ),
            ),
            "different encoders: 'b', 'dinov2",
        ),
    ],
)
def test_reference_views_that_are_not_alike_are_not_padded(change, message):
    first, second = two_photos()
    with pytest.raises(ValueError, match=message):
        ipjax.pad_templates([first, change(second)])


def test_an_exported_graph_takes_the_reference_view(monkeypatch):
    """It goes through the dictionaries of an exported estimate and is whole again where the estimate is made."""
    templates = with_reference(problems.make_templates(), side=112)
    query, _ = problems.make_query(0)
    given = []

    def estimate(encoder, templates, query, key, config):
        given.append(templates)
        return query

    monkeypatch.setattr("ipjax.inference.exporting.estimate", estimate)
    key = jax.random.key_data(jax.random.key(0))
    for one in (templates, dataclasses.replace(templates, reference=None)):
        found = estimate_dictionaries(to_dictionary(one), to_dictionary(query), key, TINY)
        jax.tree.map(np.testing.assert_array_equal, given[-1], one)
        jax.tree.map(np.testing.assert_array_equal, found, to_dictionary(query))


def test_photos_with_depth_are_padded_only_beside_their_like():
    """They only choose among poses, so that an object from a mesh may stand beside one of them."""
    first, second = (measured(templates) for templates in two_photos())
    both = ipjax.pad_templates([first, second])
    assert both.reference is not None and both.reference.measured
    assert ipjax.pad_templates([first, dataclasses.replace(second, reference=None)]).reference is None
    with pytest.raises(ValueError, match=r"from a photo without depth, .* and some were not"):
        ipjax.pad_templates([first, two_photos()[1]])


def test_an_exported_graph_takes_deviations_of_photos_without_depth_only():
    guessed = with_reference(problems.make_templates(), side=112)
    guessed = dataclasses.replace(guessed, surface=with_deviations(guessed.surface, "inflate"))
    assert set(to_dictionary(guessed)["surface"]) == {"points", "normals", "seen", "along_std"}
    assert set(to_dictionary(measured(guessed))["surface"]) == {"points", "normals", "seen"}


def test_an_exported_graph_leaves_out_a_photo_with_depth():
    """Nothing is drawn in it that the photo could judge."""
    given = to_dictionary(measured(with_reference(problems.make_templates(), side=112)))
    wanted = to_dictionary(problems.make_templates())
    assert jax.tree.structure(given) == jax.tree.structure(wanted)


def measured(templates):
    return dataclasses.replace(templates, reference=dataclasses.replace(templates.reference, measured=True))
