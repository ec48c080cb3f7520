"""A whole query from its crop on, as `ipjax estimate` makes it: 224 pixels described by DINOv2 S/14, estimated, drawn.

Its weights are random, for times do not depend on them. So that the poses are sensible ones all the same, the features
that count are those of the tests' encoder; DINOv2's are computed and added with a weight of 1e-12.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks.measure import compile_fresh, summarise, time_in_turns
from ipjax.config import Config
from ipjax.estimation.features import describe
from ipjax.estimation.pipeline import estimate
from ipjax.networks.dinov2 import DinoV2, DinoV2Config, Encoder, find_preset
from ipjax.records import Query
from ipjax.synthetic import problems

BLOCK = 8  # of the encoder whose features are used
PRESET = "vits14"


class StandInWithDinov2(eqx.Module):
    """The tests' encoder, with the cost of DINOv2: its features are computed and added with a weight of 1e-12."""

    stand_in: problems.CoordinateEncoder
    dinov2: Encoder

    def __call__(self, image):
        features = self.stand_in(image)
        return features + 1e-12 * self.dinov2(image)[..., : features.shape[-1]]


def rows(quick: bool):
    """The presets of `Config`, with a free and a known size, in float32; `Config()` in bfloat16, too."""
    directions, rolls, channels = (8, 1, 32) if quick else (40, 10, 384)
    tiny = DinoV2Config(width=32, depth=2, heads=2, hidden=64, grid=4)
    templates = problems.make_templates(directions, rolls, grid=16, channels=channels)
    templates = dataclasses.replace(
        templates,
        patches=eqx.tree_at(lambda p: p.features, templates.patches, templates.patches.features.astype(jnp.float16)),
        surface=problems.make_surface(2048),
        appearance=problems.make_appearance(4096 if quick else 65536),
    )
    query, truth = problems.make_query(0, grid=16, channels=channels)
    key, calls = jax.random.key(0), {}
    forms = [("Config()", Config(), "float32", None), ("Config.fast()", Config.fast(), "float32", None)]
    if not quick:
        forms += [
            ("Config(), size given", Config(), "float32", truth.scale),
            ("Config.paper()", Config.paper(), "float32", None),
            ("Config(), bfloat16 encoder", Config(), "bfloat16", None),
        ]
    for name, config, dtype, size in forms:
        shape = dataclasses.replace(tiny, dtype=dtype) if quick else find_preset(PRESET, dtype)
        model = DinoV2(shape, rngs=nnx.Rngs(0))
        encoder = StandInWithDinov2(problems.make_encoder(channels), Encoder(model, min(BLOCK, shape.depth - 1)))
        arguments = encoder, templates, query.view, key, config, size
        print(f"  compiling: {name}, {dtype}", flush=True)
        function, compile_s, temporary = compile_fresh(whole, *arguments)
        calls[name, dtype] = partial(function, *arguments), compile_s, temporary
    timed = time_in_turns({label: call for label, (call, _, _) in calls.items()}, 5 if quick else 15, seconds=120)
    for (name, dtype), seconds in timed.items():
        _, compile_s, temporary = calls[name, dtype]
        yield {
            "name": "whole query",
            "implementation": name,
            "size": f"224² pixels, {directions * rolls} templates, {channels} channels",
            "dtype": dtype,
            "compile_s": compile_s,
            "temporary_bytes": temporary,
            **summarise(seconds),
        }


def whole(encoder, templates, view, key, config, diameter):
    """Describe a crop and estimate: the function that is measured."""
    query = Query(describe(encoder, view), view)
    return estimate(encoder, templates, query, key, config, diameter)
