"""From the crop's camera to that of the whole image: everything that is told in camera axes turns along."""

import jax.numpy as jnp
import numpy as np
import problems
from estimates import make_estimate

from ipjax.host.estimation import _turn
from ipjax.types import Similarity


def test_pose_alternatives_and_covariance_turn_together():
    rng = np.random.default_rng(0)
    turn, rotation = (problems.random_rotation(rng) for _ in range(2))
    single = lambda x: jnp.asarray(x, jnp.float32)
    found = make_estimate(Similarity(single(rotation), single([0.1, 0.0, 0.8]), single(0.2)))
    turned = _turn(Similarity(single(turn), jnp.zeros(3), single(1.0)), found)
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
