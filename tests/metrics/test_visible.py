"""VSD against the toolkit's own numbers."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from builders.poses import CAMERA

from ipjax import metrics
from ipjax.records import Camera

VSD = np.load(Path(__file__).resolve().parents[1] / "golden" / "bop_vsd.npz")


def test_vsd_is_bops_up_to_a_pixel_of_the_union():
    camera = Camera.from_matrix(VSD["K"])
    taus = jnp.asarray(VSD["taus"], jnp.float32)

    def one(seen, truth, estimate, diameter):
        error = metrics.vsd(seen, truth, camera, estimate, diameter=diameter, delta=15.0, tolerances=taus)
        distances = [metrics.distances_from_camera(camera, depth) for depth in (seen, truth, estimate)]
        return error, *metrics.visibility(*distances, 15.0)

    depths = [jnp.asarray(VSD[f"depth_{name}"]) for name in ("test", "gt", "est")]
    error, visible_truth, visible_estimate = jax.jit(jax.vmap(one))(
        *depths, jnp.asarray(VSD["diameter"], dtype=jnp.float32)
    )
    union = np.maximum((VSD["visib_gt"] | VSD["visib_est"]).sum((1, 2)), 1)
    assert (np.abs(np.asarray(error) - VSD["vsd"]) * union[:, None]).max() < 1.01
    assert (np.asarray(visible_truth) != VSD["visib_gt"]).sum((1, 2)).max() <= 1
    assert (np.asarray(visible_estimate) != VSD["visib_est"]).sum((1, 2)).max() <= 1


def test_vsd_of_nothing_is_one_and_of_the_truth_zero():
    depth = jnp.zeros((8, 8)).at[2:5, 2:5].set(0.5)
    far = jnp.full((8, 8), 1.0)
    call = lambda seen, truth, estimate: metrics.vsd(seen, truth, CAMERA, estimate, diameter=0.1, delta=0.015)
    np.testing.assert_array_equal(call(far, jnp.zeros((8, 8)), jnp.zeros((8, 8))), np.ones(10))
    np.testing.assert_array_equal(call(far, depth, depth), np.zeros(10))
    np.testing.assert_array_equal(call(jnp.full((8, 8), jnp.nan), depth, depth), np.zeros(10))  # nothing measured
    np.testing.assert_array_equal(call(jnp.full((8, 8), 0.2), depth, depth), np.ones(10))  # hidden
    np.testing.assert_array_equal(call(far, depth, jnp.zeros((8, 8))), np.ones(10))  # estimate outside the image
