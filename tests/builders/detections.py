"""Frames of several ellipsoids before a wall, and a detector for them that is compiled once."""

import dataclasses
import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from builders.tiny_pipeline import TINY

from ipjax.config import DetectConfig
from ipjax.detection.detector import Detector
from ipjax.files.objects.record import ObjectInfo
from ipjax.records import Similarity
from ipjax.synthetic import problems

HEIGHT, WIDTH = 240, 320
FOCAL, CENTRE = np.array([300.0, 300.0]), np.array([159.5, 119.5])
MATRIX = np.array([[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])


@dataclasses.dataclass(frozen=True)
class MadeFrame:
    """A frame, and the visible mask and the pose of each ellipsoid in it."""

    rgb: np.ndarray
    depth: np.ndarray
    masks: list[np.ndarray]
    poses: list[Similarity]


def place(x: float, y: float, z: float = 0.8, scale: float = 0.2, seed: int = 0) -> Similarity:
    """An ellipsoid ``scale`` metres long at a place in the camera's frame, randomly turned."""
    rotation = problems.random_rotation(np.random.default_rng(seed))
    single = lambda value: jnp.asarray(value, jnp.float32)
    return Similarity(single(rotation), single([x, y, z]), single(scale))


def make_frame(*poses: Similarity, wall: float = 1.3) -> MadeFrame:
    """Ellipsoids at these poses before a grey wall; the nearest hides what is behind it."""
    rng = np.random.default_rng(0)
    rgb = np.full((HEIGHT, WIDTH, 3), 0.45) + rng.normal(0, 0.01, (HEIGHT, WIDTH, 3))
    depth = np.full((HEIGHT, WIDTH), wall)
    ids = np.full((HEIGHT, WIDTH), -1)
    for number, pose in enumerate(poses):
        colours, far, mask = problems.draw_ellipsoid(pose, FOCAL, CENTRE, HEIGHT, WIDTH)
        nearer = mask & (far < depth)
        rgb[nearer], depth[nearer], ids[nearer] = colours[nearer], far[nearer], number
    rgb = np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    return MadeFrame(rgb, depth.astype(np.float32), [ids == i for i in range(len(poses))], list(poses))


@functools.cache
def ellipsoid():
    """The object, ready to be found, and what is known of it."""
    templates = dataclasses.replace(problems.make_templates(20, 4), appearance=problems.make_appearance(20_000))
    return templates, ObjectInfo("ellipsoid", "none", resolution=112)


@functools.cache
def stranger():
    """An object of the same shape whose features are those of nothing here."""
    templates, info = ellipsoid()
    templates = eqx.tree_at(lambda t: t.patches.features, templates, -templates.patches.features)
    flipped = eqx.tree_at(lambda t: t.appearance.colours, templates, 1 - templates.appearance.colours)
    return flipped, dataclasses.replace(info, name="stranger")


@functools.cache
def detector() -> Detector:
    """Of the ellipsoid and the stranger."""
    settings = DetectConfig(views=80, verified=3)
    return Detector([ellipsoid(), stranger()], problems.make_encoder(), TINY, detection=settings)
