"""A whole query from its crop on, as `ipjax estimate` makes it: 224 pixels described by DINOv2 S/14, estimated, drawn.

Its weights are random, for times do not depend on them. So that the poses are sensible ones all the same, the features
that count are those of the tests' encoder; DINOv2's are computed and added with a weight of 1e-12.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from benchmarks.measure import compile_fresh, summarise, time_in_turns
from ipjax.config import Config, OnboardConfig
from ipjax.estimation.features import describe
from ipjax.estimation.pipeline import estimate
from ipjax.inference.frames import frame_turned
from ipjax.networks.dinov2 import DinoV2, DinoV2Config, Encoder, find_preset
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import onboard_photo
from ipjax.records import Query, Templates, View
from ipjax.synthetic import problems
from ipjax.transforms import rotation_from_vector

FROM_PHOTO = "object from a photo without depth"
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
    """The presets of `Config`, with a free and a known size, in float32; `Config()` in bfloat16, too; of an object from
    a photo without depth, its default and its fast settings."""
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
            (f"Config(), {FROM_PHOTO}", Config(), "float32", None),
            (f"Config.fast(), {FROM_PHOTO}", Config.fast(), "float32", None),
            ("Config(), size given", Config(), "float32", truth.scale),
            ("Config.paper()", Config.paper(), "float32", None),
            ("Config(), bfloat16 encoder", Config(), "bfloat16", None),
        ]
    for name, config, dtype, size in forms:
        shape = dataclasses.replace(tiny, dtype=dtype) if quick else find_preset(PRESET, dtype)
        model = DinoV2(shape, rngs=nnx.Rngs(0))
        encoder = StandInWithDinov2(problems.make_encoder(channels), Encoder(model, min(BLOCK, shape.depth - 1)))
        if FROM_PHOTO in name:
            made, view = photographed(encoder)
            arguments = encoder, made, view, key, config, size
        else:
            arguments = encoder, templates, query.view, key, config, size
        print(f"  compiling: {name}, {dtype}", flush=True)
        function, compile_s, temporary = compile_fresh(whole, *arguments)
        calls[name, dtype] = partial(function, *arguments), compile_s, temporary
    timed = time_in_turns({label: call for label, (call, _, _) in calls.items()}, 5 if quick else 15, seconds=120)
    for (name, dtype), seconds in timed.items():
        _, compile_s, temporary = calls[name, dtype]
        views = 60 if FROM_PHOTO in name else directions * rolls
        yield {
            "name": "whole query",
            "implementation": name,
            "size": f"224² pixels, {views} templates, {channels} channels",
            "dtype": dtype,
            "compile_s": compile_s,
            "temporary_bytes": temporary,
            **summarise(seconds),
        }


def photographed(encoder) -> tuple[Templates, View]:
    """The ellipsoid as an object from one image without depth, and a crop of another that sees it 30° from there."""
    photo = problems.make_frame(0)
    config = OnboardConfig(directions=1, rolls=1, surface=2048, appearance=0)
    made = onboard_photo(
        Photo(photo.rgb), encoder, config, mask=photo.mask, camera=photo.matrix, lrm="inflate", progress=False
    )
    turn = rotation_from_vector(np.deg2rad(30) * np.array([0.6, 0.8, 0.0]))
    frame = problems.make_frame(1, rotation=turn @ photo.camera_from_object.to_numpy().rotation)
    view, _ = frame_turned(frame.rgb, frame.depth, frame.mask, frame.matrix, resolution=224)
    return made.templates, view


def whole(encoder, templates, view, key, config, diameter):
    """Describe a crop and estimate: the function that is measured."""
    query = Query(describe(encoder, view), view)
    return estimate(encoder, templates, query, key, config, diameter)
