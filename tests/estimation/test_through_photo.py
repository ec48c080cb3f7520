"""An object from a photo without depth is found through the photo: rotation, place and size, without bias.

The whole way of a user: one exact image becomes the object, another the query. The encoder is the stand-in that knows
what it sees from its colours, so that what is measured is geometry.
"""

import jax
import numpy as np
import pytest

import ipjax
from ipjax.config import Config, OnboardConfig, ResectConfig
from ipjax.estimation.features import observe
from ipjax.inference.frames import frame_turned
from ipjax.inference.reports import relative_pose
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import onboard_photo
from ipjax.synthetic import problems
from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation

CONFIG = Config(resect=ResectConfig(views=6, count=256))
ONBOARD = OnboardConfig(directions=1, rolls=1, resolution=112, surface=512, appearance=0)
encoder = problems.make_encoder()
estimate = jax.jit(ipjax.estimate)
look = jax.jit(observe)


def photograph(seed):
    """An object from one exact image, and the true pose in it, a unit being the distance of the object's centre."""
    whole = problems.make_frame(seed)
    made = onboard_photo(
        Photo(whole.rgb), encoder, ONBOARD, mask=whole.mask, camera=whole.matrix, lrm="inflate", progress=False
    )
    true = whole.camera_from_object.to_numpy()
    distance = true.translation[2]
    return made, Similarity(true.rotation, true.translation / distance, true.scale / distance), whole


def see(seed, rotation, angle):
    """An exact image of the object turned by so many degrees from there: the query, its truth, and its crop's turn."""
    rng = np.random.default_rng(1000 + seed)
    axis = rng.normal(size=3)
    turned = rotation_from_vector(np.deg2rad(angle) * axis / np.linalg.norm(axis)) @ rotation
    whole = problems.make_frame(1000 + seed, rotation=turned)
    view, camera_from_crop = frame_turned(whole.rgb, whole.depth, whole.mask, whole.matrix, resolution=112)
    return look(encoder, view), whole.camera_from_object.to_numpy(), camera_from_crop.to_numpy()


def errors(made, reference, found, truth, camera_from_crop):
    """Turn (degrees, about the camera's axes), shift of the centre (% of the size) and size (%)."""
    pose = relative_pose(camera_from_crop @ found.camera_from_object.to_numpy(), made.info) @ reference
    turned = np.degrees(np.asarray(vector_from_rotation(pose.rotation @ truth.rotation.T)))
    shift = 100 * (pose.translation - truth.translation) / truth.scale
    return np.array([*turned, *shift, 100 * (pose.scale / truth.scale - 1)])


@pytest.fixture(scope="module")
def found():
    """Errors, confidences and angles of queries of four objects, with the encoder."""
    rows = []
    for seed in range(4):
        made, reference, whole = photograph(seed)
        for turn in range(5):
            angle = 10 + 10 * turn
            query, truth, camera_from_crop = see(10 * seed + turn, whole.camera_from_object.to_numpy().rotation, angle)
            estimated = estimate(encoder, made.templates, query, jax.random.key(0), CONFIG)
            assert bool(estimated.success)
            rows.append(errors(made, reference, estimated, truth, camera_from_crop))
    return np.array(rows)


def test_rotations_are_found_whatever_was_guessed(found):
    angle = np.linalg.norm(found[:, :3], axis=1)
    print(np.round(found, 1), np.round(angle, 1))
    assert np.mean(angle < 15) >= 0.9
    assert np.median(angle) < 5
