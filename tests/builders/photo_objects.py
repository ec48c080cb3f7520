"""Objects from one exact photo without depth, and exact queries of them: what is found through the photo's camera.

The encoder is the stand-in that knows what it sees from its colours, so that what is measured is geometry.
"""

import functools

import jax
import numpy as np
from builders.compilation import QUICKLY

import ipjax
from ipjax.config import Config, OnboardConfig, ResectConfig
from ipjax.estimation.features import observe
from ipjax.inference.frames import frame_turned
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import onboard_photo
from ipjax.synthetic import problems
from ipjax.transforms import Similarity, rotation_from_vector

CONFIG = Config(resect=ResectConfig(views=6, count=256))
ONBOARD = OnboardConfig(directions=1, rolls=1, resolution=112, surface=512, appearance=0)
encoder = problems.make_encoder()
estimate = jax.jit(ipjax.estimate, compiler_options=QUICKLY)
look = jax.jit(observe)


@functools.cache
def photograph(seed):
    """An object from one exact image, and the true pose in it, a unit being the distance of the object's centre."""
    whole = problems.make_frame(seed)
    made = onboard_photo(
        Photo(whole.rgb), encoder, ONBOARD, mask=whole.mask, camera=whole.matrix, lrm="inflate", progress=False
    )
    true = whole.camera_from_object.to_numpy()
    distance = true.translation[2]
    return made, Similarity(true.rotation, true.translation / distance, true.scale / distance), whole


def see(seed, rotation, angle, resolution=112):
    """An exact image of the object turned by so many degrees from there: the query, its truth, and its crop's turn."""
    rng = np.random.default_rng(1000 + seed)
    axis = rng.normal(size=3)
    turned = rotation_from_vector(np.deg2rad(angle) * axis / np.linalg.norm(axis)) @ rotation
    whole = problems.make_frame(1000 + seed, rotation=turned)
    view, camera_from_crop = frame_turned(whole.rgb, whole.depth, whole.mask, whole.matrix, resolution=resolution)
    return look(encoder, view), whole.camera_from_object.to_numpy(), camera_from_crop.to_numpy()


def known(seed=0, angle=30):
    """Templates of an object from a photo, and a query of it that is found."""
    made, _, whole = photograph(seed)
    query, *_ = see(10 * seed + 3, whole.camera_from_object.to_numpy().rotation, angle)
    return made.templates, query
