"""Things dropped onto a table rest on it, beside and on one another, and not in one another; the same again."""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from ipjax.capture.records import CaptureError
from ipjax.capture.views.settling import SettlingConfig, settle
from ipjax.files.meshes.mesh import make_mesh, move
from ipjax.synthetic.objects import KINDS, make_object

MESHES = [move(make_object(kind, 5), np.eye(3), np.array([0.02, 0, 0.01]), scale=0.13) for kind in KINDS[:5]]


def share_depth(first, second) -> float:
    """The radius of the largest ball in both of two convex hulls, metres; negative where they are apart."""
    rows = np.concatenate([ConvexHull(points).equations for points in (first, second)])
    found = linprog([0, 0, 0, -1], np.c_[rows[:, :3], np.ones(len(rows))], -rows[:, 3], bounds=[(None, None)] * 4)
    return float(found.x[3])


@pytest.fixture(scope="module")
def settled():
    return settle(MESHES, 3)


def test_all_rest_on_the_table_apart_from_one_another(settled):
    placed = [pose @ mesh.vertices for mesh, pose in zip(MESHES, settled.world_from_thing, strict=True)]
    for index, points in enumerate(placed):
        assert points[:, 2].min() > -0.0008 and (np.abs(points[:, :2]) < [0.6, 0.45]).all()
        for other in placed[index + 1 :]:
            assert share_depth(points, other) < 0.0004
    # Something touches the table; nothing hovers but on others.
    lowest = np.sort([points[:, 2].min() for points in placed])
    assert lowest[0] < 0.0015 and settled.deep < 0.0008
    np.testing.assert_allclose([np.linalg.det(pose.rotation) for pose in settled.world_from_thing], 1)


def test_follows_from_the_seed(settled):
    again, other = settle(MESHES, 3), settle(MESHES, 4)
    matrices = lambda found: np.stack([pose.to_matrix() for pose in found.world_from_thing])
    np.testing.assert_array_equal(matrices(again), matrices(settled))
    assert np.abs(matrices(other) - matrices(settled)).max() > 0.01


def test_what_cannot_rest_is_refused():
    with pytest.raises(CaptureError, match="is its unit right"):
        settle([move(MESHES[0], np.eye(3), scale=1000.0)])
    with pytest.raises(CaptureError, match="do not come to rest"):
        settle(MESHES[:1], config=SettlingConfig(longest=0.02, tries=1))
    flat = make_mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2]]))
    with pytest.raises(CaptureError, match="flat"):
        settle([flat])
    with pytest.raises(ValueError, match="nothing"):
        settle([])
