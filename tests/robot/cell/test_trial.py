"""A trial tells how far the pose was off, and picks by what was estimated, not by the truth."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders.cells import SIDES, lie, make_block

from ipjax.files.meshes.mesh import normalise
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.objects.record import ObjectInfo
from ipjax.records import Surface
from ipjax.robot.cell.camera import look
from ipjax.robot.cell.cell import make_cell
from ipjax.robot.cell.picking import PickConfig
from ipjax.robot.cell.trial import compare_poses, true_pose, try_pick
from ipjax.transforms import Similarity, rotation_from_vector


@pytest.fixture(scope="module")
def seen():
    cell = make_cell([make_block()], 3, arm="gantry", base_from_object=[lie()], masses=[0.4])
    return cell, look(cell, oversample=1)


def test_true_poses_are_those_of_the_object_file(seen):
    _, sight = seen
    model = normalise(make_block())
    info = ObjectInfo("block", "", mesh_scale=1e-3 * model.scale, mesh_centre=(0.0, 0.0, 0.0))  # of a file in mm
    pose = true_pose(sight, info, 1e-3)
    there = sight.camera_from_object[0] @ make_block().vertices
    assert np.abs(pose @ model.vertices - there).max() < 1e-6
    moved = Similarity(
        pose.rotation @ rotation_from_vector(np.array([0, 0.1, 0])), pose.translation + 0.003, pose.scale
    )
    error = compare_poses(moved.to_jax(), pose)
    assert error.rotation == pytest.approx(0.1, abs=1e-5) and error.centre == pytest.approx(0.003 * 3**0.5, abs=1e-6)
    assert error.as_json()["size_error"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("off, holds", [(0.0, True), (0.2, False)])
def test_the_hand_goes_to_the_estimated_pose(seen, off, holds):
    cell, sight = seen
    model = normalise(make_block())
    surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(model, 2048, seed=0)))
    size = Similarity(np.eye(3), np.zeros(3), np.asarray(1 / model.scale))
    shift = Similarity(np.eye(3), np.array([0, off, 0]), np.ones(()))
    camera_from_base = sight.base_from_camera.inverse()
    pose = camera_from_base @ shift @ sight.base_from_camera @ sight.camera_from_object[0] @ size
    trial = try_pick(cell, surface, sight, pose.to_jax(), config=PickConfig(frames=0))
    assert trial.planned > 0 and trial.pick.possible
    assert trial.pick.success == holds, trial.pick.why
    if not holds:
        assert trial.pick.fingers == 0
    assert SIDES[1] == pytest.approx(trial.pick.opening, abs=0.002) or not holds
