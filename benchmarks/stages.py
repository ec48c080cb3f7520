"""The whole estimate and its stages: 400 templates of an ellipsoid, one query and batches of them. No encoder."""

from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks.measure import compile_fresh, summarise, time_in_turns
from ipjax.config import Config, MatchConfig
from ipjax.estimation.alignment import align
from ipjax.estimation.matching import match, select
from ipjax.estimation.pipeline import apparent_diameter, comparable, estimate
from ipjax.estimation.refinement import refine
from ipjax.estimation.scene import SceneGrid
from ipjax.estimation.scoring import score
from ipjax.inference.batching import compact
from ipjax.synthetic import problems

BATCHES = (8,)  # queries at once
ACCELERATOR_BATCHES = (16, 64)


def rows(quick: bool):
    """Every stage and the estimate of both configurations at 16 × 16 patches; batches of queries; the front at 30²."""
    directions, rolls, channels = (8, 1, 32) if quick else (40, 10, 384)
    templates = problems.make_templates(directions, rolls, grid=16, channels=channels)
    templates = eqx.tree_at(lambda t: t.patches.features, templates, templates.patches.features.astype(jnp.float16))
    query, _ = problems.make_query(0, grid=16, channels=channels, noise=0.3)
    size = f"{directions * rolls} × 16² patches, {channels} channels"
    small = compact(templates)
    fewer = f"{directions * rolls} × {small.norm.shape[1]} of 16² patches, {channels} channels"
    key, repeats = jax.random.key(0), 5 if quick else 15
    poses = jax.jit(hypotheses)(small, query, key)
    short = Config(match=MatchConfig(shortlist=max(directions * rolls // 4, 1)))
    yield from measure(
        {
            ("match", size): (match_only, (templates, query, Config())),
            ("match, compact templates", fewer): (match_only, (small, query, Config())),
            (f"match, shortlist of {short.match.shortlist}", fewer): (match_only, (small, query, short)),
            ("match + select + align", size): (front, (templates, query, key, Config())),
            ("match + select + align, compact templates", fewer): (front, (small, query, key, Config())),
            (f"refine, {poses.scale.shape[0]} hypotheses", fewer): (refine_all, (small, query, poses, Config())),
            (f"score, {poses.scale.shape[0]} hypotheses", fewer): (score_all, (small, query, poses, Config())),
            ("estimate, Config.paper()", size): (estimate, (None, templates, query, key, Config.paper())),
            ("estimate, Config.fast(), compact templates", fewer): (estimate, (None, small, query, key, Config.fast())),
            ("estimate, Config(), compact templates", fewer): (estimate, (None, small, query, key, Config())),
        },
        repeats,
        seconds=60,
    )
    on_cpu = jax.default_backend() == "cpu"
    for batch in (2,) if quick else BATCHES if on_cpu else ACCELERATOR_BATCHES:
        queries = jax.tree.map(lambda x, batch=batch: jnp.broadcast_to(x, (batch, *x.shape)), query)
        many = (None, small, queries, jax.random.split(key, batch), Config())
        name = f"estimate, Config(), {batch} queries at once"
        for found in measure({(name, fewer): (jax.vmap(estimate, (None, None, 0, 0, None)), many)}, 5, seconds=20):
            found["queries_per_s"] = batch / (found["median_ms"] / 1e3)
            yield found
    if quick:
        return
    # Times do not depend on what the features are: forty templates, repeated.
    large = problems.make_templates(directions, 1, grid=30, channels=channels)
    large = eqx.tree_at(lambda t: t.patches.features, large, large.patches.features.astype(jnp.float16))
    repeated = lambda tree: jax.tree.map(lambda x: jnp.repeat(x, rolls, axis=0), tree)
    large = eqx.tree_at(VIEWS, large, repeated(VIEWS(large)))
    query, _ = problems.make_query(0, grid=30, channels=channels, noise=0.3)
    size = f"{directions * rolls} × 30² patches, {channels} channels"
    small = compact(large)
    fewer = f"{directions * rolls} × {small.norm.shape[1]} of 30² patches, {channels} channels"
    yield from measure(
        {
            ("match + select + align", size): (front, (large, query, key, Config())),
            ("match + select + align, compact templates", fewer): (front, (small, query, key, Config())),
            (f"match, shortlist of {short.match.shortlist}", fewer): (match_only, (small, query, short)),
        },
        5,
        seconds=30,
    )


VIEWS = lambda t: (t.patches, t.norm, t.seen, t.camera_from_object, t.camera)


def match_only(templates, query, config):
    """Both ways' neighbours, cycles, and the best templates."""
    return match(*comparable(templates, query.patches, config), config.match)


def front(templates, query, key, config):
    """From patches to hypotheses."""
    matches = match_only(templates, query, config)
    pairs = select(matches, query.patches, templates, config.match)
    return align(pairs, apparent_diameter(templates, query)[matches.view], key, config.align)


def hypotheses(templates, query, key):
    """What refinement starts from."""
    return front(templates, query, key, Config())[0]


def refine_all(templates, query, poses, config):
    """Every hypothesis fitted to the depth."""
    cloud = SceneGrid(query, config.score.resolution, config.refine.silhouette).cloud
    return jax.vmap(lambda pose: refine(templates.surface, cloud, pose, config.refine)[0])(poses)


def score_all(templates, query, poses, config):
    """Every hypothesis compared with the depth and the features."""
    scene = SceneGrid(query, config.score.resolution, config.refine.silhouette)
    rate = lambda pose: score(None, templates, query, scene.depth, scene.mask, scene.cloud.camera, pose, config.score)
    return jax.vmap(rate)(poses)


def write_trace(folder: Path):
    """A profile of a few warm estimates, one scope per stage, for Perfetto or TensorBoard."""
    templates = compact(problems.make_templates(40, 10, grid=16, channels=384))
    query, _ = problems.make_query(0, grid=16, channels=384, noise=0.3)
    run = jax.jit(estimate)
    arguments = None, templates, query, jax.random.key(0), Config()
    jax.block_until_ready(run(*arguments))
    with jax.profiler.trace(str(folder), create_perfetto_trace=True):
        for _ in range(3):
            jax.block_until_ready(run(*arguments))


def measure(forms, repeats, seconds):
    """Rows of ``(name, size): (function, arguments)``, in turns."""
    built = {}
    for (name, size), (form, arguments) in forms.items():
        built[name, size] = compile_fresh(form, *arguments)
        print(f"  compiled: {name}, {size}", flush=True)
    calls = {label: partial(built[label][0], *arguments) for label, (_, arguments) in forms.items()}
    for (name, size), times in time_in_turns(calls, repeats, seconds=seconds).items():
        yield row(name, size, built[name, size], times)


def row(name, size, built, seconds):
    """One row of the table."""
    _, compile_s, temporary = built
    return {
        "name": "estimate",
        "implementation": name,
        "size": size,
        "dtype": "float32",
        "compile_s": compile_s,
        "temporary_bytes": temporary,
        **summarise(seconds),
    }
