"""A trajectory that was written is read as it was, and what is no trajectory is refused in a sentence."""

import json

import numpy as np
import pytest

from ipjax.capture.records import CaptureError, Trajectory
from ipjax.capture.trajectories import read_trajectory, write_trajectory
from ipjax.transforms import Similarity, rotation_from_vector


def make_trajectory(**changes) -> Trajectory:
    rng = np.random.default_rng(5)
    rotation, translation = rotation_from_vector(rng.normal(size=(3, 3))), rng.normal(size=(3, 3))
    rotation[1], translation[1] = np.eye(3), 0
    poses = Similarity(rotation, translation, np.ones(3))
    known = {"covariance": rng.normal(size=(3, 6, 6)), "scale": 0.2, "agreement": 0.9} | changes
    return Trajectory(("a", "b", "c"), poses, np.array([True, False, True]), "structure from motion", **known)


@pytest.mark.parametrize("changes", [{}, {"covariance": None, "scale": None, "agreement": None}])
def test_comes_back_as_it_was(tmp_path, changes):
    made = make_trajectory(**changes)
    found = read_trajectory(write_trajectory(tmp_path / "poses.json", made))
    assert (found.names, found.source, found.scale, found.agreement) == (
        made.names,
        made.source,
        made.scale,
        made.agreement,
    )
    assert (found.registered == made.registered).all()
    np.testing.assert_allclose(found.world_from_camera.to_matrix(), made.world_from_camera.to_matrix(), atol=1e-14)
    assert (found.covariance is None) == (made.covariance is None)
    if made.covariance is not None:
        np.testing.assert_array_equal(found.covariance, made.covariance)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.update(format="other"), "no trajectory of ipjax"),
        (lambda d: d.update(version=2), "version 2"),
        (lambda d: d["names"].pop(), "do not belong together"),
        (lambda d: d["world_from_camera"].__setitem__(0, None), "registered has no pose"),
        (lambda d: d["world_from_camera"].__setitem__(0, [1, 2]), "damaged"),
        (lambda d: d["world_from_camera"][0][0].__setitem__(0, 3.0), "damaged"),
        (lambda d: d.pop("source"), "damaged"),
    ],
)
def test_what_is_none_is_refused(tmp_path, change, said):
    path = write_trajectory(tmp_path / "poses.json", make_trajectory())
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(CaptureError, match=said):
        read_trajectory(path)
    path.unlink()
    with pytest.raises(CaptureError, match="no such file of poses"):
        read_trajectory(path)
