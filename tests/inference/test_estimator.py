"""From the crop's camera to that of the whole image, everything that is told in camera axes turns along; and templates
are compacted before they are compared with anything."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from builders.estimates import make_estimate

from ipjax.config import Config
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.batching import compact
from ipjax.inference.estimator import MULTIPLE, Estimator, to_image_camera
from ipjax.inference.exporting import blank_query
from ipjax.records import Patches, Query, Similarity
from ipjax.synthetic import problems


def test_pose_alternatives_and_covariance_turn_together():
    rng = np.random.default_rng(0)
    turn, rotation = (problems.random_rotation(rng) for _ in range(2))
    single = lambda x: jnp.asarray(x, jnp.float32)
    found = make_estimate(Similarity(single(rotation), single([0.1, 0.0, 0.8]), single(0.2)))
    turned = to_image_camera(Similarity(single(turn), jnp.zeros(3), single(1.0)), found)
    np.testing.assert_allclose(turned.camera_from_object.rotation, turn @ rotation, atol=1e-6)
    np.testing.assert_allclose(turned.camera_from_object.translation, turn @ [0.1, 0.0, 0.8], atol=1e-6)
    np.testing.assert_allclose(turned.hypotheses.camera_from_object.rotation[0], turn @ rotation, atol=1e-6)
    # The spread along a direction that turns along stays what it was, for rotation and for translation.
    before, after = np.asarray(found.covariance, np.float64), np.asarray(turned.covariance, np.float64)
    for block in (slice(0, 3), slice(3, 6)):
        direction = rng.normal(size=3)
        moved = turn @ direction
        spread = moved @ after[block, block] @ moved
        np.testing.assert_allclose(spread, direction @ before[block, block] @ direction, rtol=1e-4)
    assert turned.scale_std is found.scale_std and turned.ambiguity is found.ambiguity


def spread_out(templates, cells: int):
    """The templates in the middle of a larger grid whose other cells are background."""
    views, count = templates.norm.shape
    side = int(np.sqrt(count))
    row, column = np.divmod(np.arange(count), side)
    place = (row + 1) * cells + column + 1

    def put(x):
        wide = np.zeros((views, cells * cells, *np.shape(x)[2:]), np.asarray(x).dtype)
        wide[:, place] = np.asarray(x)
        return jnp.asarray(wide)

    row, column = np.divmod(np.arange(cells * cells, dtype=np.float32), np.float32(cells))
    grid = jnp.broadcast_to(jnp.stack([column, row], -1), (views, cells * cells, 2))
    old = templates.patches
    patches = Patches(put(old.features), put(old.points), grid, put(old.valid), old.encoder)
    return dataclasses.replace(templates, patches=patches, norm=put(templates.norm), seen=put(templates.seen))


def test_the_estimator_compares_compacted_templates(monkeypatch):
    """What reaches the graph has no background to speak of, also where objects are added later or exchanged."""
    whole = spread_out(problems.make_templates(4), 16)
    info, query = ObjectInfo("ball", "none"), problems.make_query(3)[0]
    small = compact(whole, multiple=MULTIPLE)
    assert small.norm.shape[1] < whole.norm.shape[1] == 256
    still = Similarity(jnp.eye(3), jnp.zeros(3), jnp.asarray(1.0))
    given = []

    def ready(self, name, function, seconds, *arguments):
        given.append(arguments[1])
        seconds[name] = 0.0
        return lambda *_: make_estimate(still)

    monkeypatch.setattr(Estimator, "compiled", ready)
    estimator = Estimator([(whole, info)], None)
    for _ in range(2):
        result = estimator.run(0, query.view, still, patches=query.patches)
    estimator.objects.append((whole, info))
    estimator.run(1, query.view, still, patches=query.patches)
    estimator.objects = [(dataclasses.replace(whole, mean=whole.mean + 1), info)]
    estimator.run(0, query.view, still, patches=query.patches)
    assert [templates.norm.shape for templates in given] == [small.norm.shape] * 4
    assert given[0] is given[1] is result.templates and float(given[3].mean[0] - given[0].mean[0]) == 1
    assert isinstance(result.query, Query)


def test_what_compiles_quickly_answers_the_same():
    templates, (query, _) = problems.make_templates(4), problems.make_query(3)
    still = Similarity(jnp.eye(3), jnp.zeros(3), jnp.asarray(1.0))
    found = []
    for quick in (False, True):
        estimator = Estimator([(templates, ObjectInfo("ball", "none"))], None, Config.paper(), quick=quick)
        found.append(estimator.run(0, query.view, still, patches=query.patches).estimate)
    first, second = (x.camera_from_object for x in found)
    assert bool(found[0].success) and bool(found[1].success)
    np.testing.assert_allclose(second.rotation, first.rotation, atol=1e-4)
    np.testing.assert_allclose(second.translation, first.translation, atol=1e-4)
    np.testing.assert_allclose(second.scale, first.scale, rtol=1e-4)


def test_an_exported_query_has_the_whole_grid():
    whole = spread_out(problems.make_templates(4), 16)
    for templates in (whole, compact(whole)):
        assert blank_query(templates, 224).patches.valid.shape == (256,)
