"""Frames to be labelled, with two objects and the stand-in encoder: the ellipsoid alone before a wall."""

import dataclasses
import functools

import equinox as eqx
import numpy as np
from builders.tiny_pipeline import TINY, two_objects

from ipjax.files.objects.record import ObjectInfo
from ipjax.labelling.batch import Labeller
from ipjax.labelling.records import Batch, LabelSettings
from ipjax.synthetic import problems

CONFIG = dataclasses.replace(TINY, score=dataclasses.replace(TINY.score, drawn=0))
HEIGHT, WIDTH = 96, 128


class NamedEncoder(problems.CoordinateEncoder):
    """The encoder with an identity, as object files want it."""

    identity: str = eqx.field(static=True, default="coordinates")


@functools.cache
def named_encoder() -> NamedEncoder:
    plain = problems.make_encoder()
    return NamedEncoder(plain.frequencies, plain.phases)


@functools.cache
def labelled_objects() -> tuple:
    """The ellipsoid twice, with more and fewer templates; both of 200 mm in the unit of their files."""
    found = []
    for index, templates in enumerate(two_objects()):
        patches = dataclasses.replace(templates.patches, encoder="coordinates")
        info = ObjectInfo(
            name=f"obj_{index + 1:06d}",
            encoder="coordinates",
            mesh_scale=1 / 200,
            mesh_centre=(10.0, -5.0, 3.0 * index),
            mesh_file="ellipsoid.ply",
            resolution=8 * problems.PATCH,
        )
        found.append((dataclasses.replace(templates, patches=patches), info))
    return tuple(found)


@functools.cache
def make_frames(count: int) -> tuple[problems.Frame, ...]:
    return tuple(problems.make_frame(seed, HEIGHT, WIDTH, share=(0.5, 0.6)) for seed in range(count))


def as_batch(frames, ids=None, object_of=lambda number: number % 2) -> Batch:
    """The frames as a batch; each shows one object, whose mask is given."""
    ids = [f"frame {number}" for number in range(len(frames))] if ids is None else ids
    return {
        "id": ids,
        "rgb": np.stack([one.rgb for one in frames]),
        "depth": np.stack([one.depth for one in frames]),
        "camera": np.stack([one.matrix for one in frames]),
        "mask": np.stack([one.mask for one in frames])[:, None],
        "object": np.array([[object_of(number)] for number in range(len(frames))]),
    }


@functools.cache
def labeller(**settings) -> Labeller:
    """One for each settings; what it compiles is kept for all tests."""
    return Labeller(named_encoder(), labelled_objects(), CONFIG, LabelSettings(**settings))
