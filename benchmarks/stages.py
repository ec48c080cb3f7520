"""The whole estimate and its stages: 400 templates of an ellipsoid, one query and batches of them. No encoder."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from benchmarks.measure import compile_fresh, summarise, time_in_turns
from ipjax.alignment import align
from ipjax.config import Config
from ipjax.matching import match, select
from ipjax.pipeline import apparent_diameter, estimate

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))  # the synthetic problems are the tests'
import problems

BATCHES = (4, 16)


def rows(quick: bool):
    """match + select + align, and the estimate of both configurations, at 16 × 16 patches; batches of queries."""
    directions, rolls, channels = (8, 1, 32) if quick else (40, 10, 384)
    templates = problems.make_templates(directions, rolls, grid=16, channels=channels)
    query, _ = problems.make_query(0, grid=16, channels=channels, noise=0.3)
    key = jax.random.key(0)
    size = f"{directions * rolls} × 16² patches, {channels} channels"

    def front(templates, query, key, config):
        matches = match(query.patches, templates, config.match)
        pairs = select(matches, query.patches, templates, config.match)
        return align(pairs, apparent_diameter(templates, query)[matches.view], key, config.align)

    forms = {
        "match + select + align": (front, Config()),
        "estimate, Config.paper()": (estimate, Config.paper()),
        "estimate, Config()": (estimate, Config()),
    }
    arguments = (templates, query, key)
    built = {name: compile_fresh(form, *arguments, config) for name, (form, config) in forms.items()}
    calls = {name: lambda run=run, c=forms[name][1]: run(*arguments, c) for name, (run, *_) in built.items()}
    times = time_in_turns(calls, repeats=5 if quick else 15, seconds=60)
    for name, seconds in times.items():
        yield row(name, size, built[name], seconds)
    for batch in (2,) if quick else BATCHES:
        queries = jax.tree.map(lambda x, batch=batch: jnp.broadcast_to(x, (batch, *x.shape)), query)
        many = (templates, queries, jax.random.split(key, batch))
        made = compile_fresh(jax.vmap(estimate, (None, 0, 0, None)), *many, Config())
        seconds = time_in_turns({"batch": lambda made=made, many=many: made[0](*many, Config())}, 5, seconds=40)[
            "batch"
        ]
        found = row(f"estimate, {batch} queries at once", size, made, seconds)
        print(f"  {batch / (found['median_ms'] / 1e3):.2f} queries/s")
        yield found


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
