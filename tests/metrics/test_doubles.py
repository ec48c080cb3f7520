"""The same functions on the host, in NumPy's doubles: what scores are made of, and how exact it is."""

import hypothesis.extra.numpy as hnp
import jax.numpy as jnp
import numpy as np
import pytest
from builders.poses import CAMERA, ERRORS, OBJECTS, symmetries_of
from hypothesis import given
from hypothesis import strategies as st

from ipjax import metrics
from ipjax.transforms import Similarity

K = np.asarray(ERRORS["K"], np.float64)


def rigid(rotation, translation) -> Similarity[np.ndarray]:
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    return Similarity(rotation, translation, np.ones(rotation.shape[:-2]))


@pytest.mark.parametrize("number", OBJECTS)
def test_distances_are_bops_to_twelve_digits(number):
    points = ERRORS[f"obj{number}_pts"].astype(np.float64)
    symmetries = rigid(*symmetries_of(number))
    for row in np.flatnonzero(ERRORS["obj_id"] == number):
        truth, estimate = (rigid(ERRORS[f"R_{k}"][row], ERRORS[f"t_{k}"][row].reshape(3)) for k in ("gt", "est"))
        alike = truth @ symmetries
        found = {
            "mssd": metrics.surface_distance(points, alike, estimate).min(),
            "mspd": metrics.projection_distance(points, K, alike, estimate).min(),
            "add": metrics.add(points, truth, estimate),
            "te": metrics.translation_error(truth.translation, estimate.translation),
            "proj": metrics.reprojection_error(points, K, truth, estimate),
        }
        for name, value in found.items():  # mm, px; a perfect pose is 0 up to rounding
            np.testing.assert_allclose(value, ERRORS[name][row], rtol=1e-12, atol=2e-10, err_msg=name)
        # The golden rotations are rounded to float32; what uses their inverse sees it.
        np.testing.assert_allclose(metrics.add_s(points, truth, estimate, block=100), ERRORS["adi"][row], 1e-6, 1e-9)
        angle = np.degrees(metrics.rotation_error(truth.rotation, estimate.rotation))
        # The toolkit takes the arccos of the trace, which sees the rounding near 0 and 180 degrees.
        np.testing.assert_allclose(angle, ERRORS["re"][row], rtol=1e-4, atol=2e-4)
        diameter = float(ERRORS[f"obj{number}_diameter"])
        assert metrics.spheres_overlap(diameter, truth, estimate) == ERRORS["spheres_overlap_3d"][row]
        overlap = metrics.projections_overlap(diameter, truth, estimate)
        assert overlap == ERRORS["overlapping_sphere_projections"][row]


@given(seed=st.integers(0, 1000), scale=st.floats(0.5, 2.0), shift=hnp.arrays(float, 3, elements=st.floats(-0.1, 0.1)))
def test_the_graph_finds_the_same(seed, scale, shift):
    """Every error that is written once for both, with a size that may be wrong."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(60, 3)) * 0.05
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(2)]
    turns = [turn * np.linalg.det(turn) for turn in turns]
    truth = Similarity(turns[0], np.array([0, 0, 0.8]), np.ones(()))
    estimate = Similarity(turns[1], truth.translation + shift, np.asarray(scale))
    lens = CAMERA.to_matrix()
    points32, graph = jnp.asarray(points, jnp.float32), (truth.to_jax(), estimate.to_jax())
    for error in (metrics.surface_distance, metrics.add, metrics.add_s):
        host = error(points, truth, estimate)
        assert isinstance(host, np.ndarray) and host.dtype == np.float64
        np.testing.assert_allclose(error(points32, *graph), host, rtol=2e-4, atol=1e-6)
    for error in (metrics.projection_distance, metrics.reprojection_error):
        host = error(points, lens, truth, estimate)
        np.testing.assert_allclose(error(points32, CAMERA, *graph), host, rtol=1e-3, atol=1e-3)
    for error in (metrics.spheres_overlap, metrics.projections_overlap):
        assert bool(error(0.3, truth, estimate)) == bool(error(0.3, *graph))


def test_a_tree_finds_the_nearest_vertex_as_all_pairs_do():
    """What scores ask instead of comparing all vertices with all."""
    tree = pytest.importorskip("scipy.spatial").KDTree
    random = np.random.default_rng(0)
    points = random.normal(size=(500, 3))
    truth = rigid(np.eye(3), [0, 0, 5])
    estimate = Similarity(np.eye(3)[[1, 2, 0]], np.array([0.1, 0, 5.2]), np.asarray(1.1))
    nearest = lambda rows: tree(points).query(rows)[0]
    found = metrics.add_s(points, truth, estimate, nearest=nearest)
    np.testing.assert_allclose(found, metrics.add_s(points, truth, estimate, block=64), rtol=1e-12)


def test_nothing_in_the_plane_of_the_camera_overlaps():
    """As the toolkit has it: such a projection has no place."""
    there, here = rigid(np.eye(3), [0, 0, 0]), rigid(np.eye(3), [0, 0, 1])
    assert not metrics.projections_overlap(1.0, there, here) and not metrics.projections_overlap(1.0, here, there)
    assert metrics.projections_overlap(1.0, here, here)
