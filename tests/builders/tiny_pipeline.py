"""The smallest settings that estimate, compiled once for all tests, with objects and queries for them."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from builders.compilation import QUICKLY

import ipjax
from benchmarks.bias import rotation_error
from ipjax.config import AlignConfig, Config, MatchConfig, RefineConfig, ScoreConfig
from ipjax.records import Similarity
from ipjax.synthetic import problems

TINY = Config(
    match=MatchConfig(views=2, pairs=64),
    align=AlignConfig(count=128),
    refine=RefineConfig(steps=4, points=96),
    score=ScoreConfig(resolution=28, alternates=0),
)
TURNED = dataclasses.replace(TINY, score=ScoreConfig(resolution=28, alternates=1))
DRAWN = dataclasses.replace(TINY, score=ScoreConfig(resolution=28, alternates=0, drawn=2))
TRACES = []


@functools.partial(jax.jit, compiler_options=QUICKLY)
def estimate(templates, query, key, config, diameter=None):
    """Compiled once for each of the configurations above, not once per test."""
    TRACES.append(config)
    return ipjax.estimate(None, templates, query, key, config, diameter)


def two_objects():
    """The ellipsoid onboarded twice: more and fewer views, patches, and points of surface and appearance."""
    large = dataclasses.replace(problems.make_templates(), appearance=problems.make_appearance(20_000))
    few = jax.tree.map(lambda x: x[:6], (VIEWS(large)))
    small = eqx.tree_at(VIEWS, large, few)
    small = dataclasses.replace(small, surface=problems.make_surface(300), appearance=problems.make_appearance(14_000))
    return large, ipjax.compact(small, multiple=8)


VIEWS = lambda t: (t.patches, t.norm, t.seen, t.camera_from_object, t.camera)


def make_sized_query(seed: int, diameter: float):
    """As `problems.make_query`, of an object of that diameter, farther or nearer in proportion."""
    query, truth = problems.make_query(seed)
    factor = jnp.asarray(diameter, jnp.float32) / truth.scale
    sized = lambda q: (q.patches.points, q.view.depth)
    query = eqx.tree_at(sized, query, jax.tree.map(lambda x: x * factor, sized(query)))
    return query, Similarity(truth.rotation, truth.translation * factor, truth.scale * factor)


def assert_near(found, truth, diameters, share, degrees):
    """Its centre within so many diameters, its scale within a share, its rotation within degrees."""
    assert float(jnp.linalg.norm(found.translation - truth.translation)) < diameters * float(truth.scale)
    assert abs(float(found.scale / truth.scale) - 1) < share
    assert rotation_error(found, truth) < degrees
