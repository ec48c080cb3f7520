"""The depth camera, solved from points whose depth is known and from raw depth that frames have in common."""

import numpy as np
import pytest

from ipjax.cameras import unproject
from ipjax.capture.depth.depth_camera import Evidence, solve_rig
from ipjax.capture.depth.paper import find_scale
from ipjax.capture.depth.rigs import Rig, difference
from ipjax.synthetic.captures import make_capture
from ipjax.transforms import Similarity

NOWHERE = Similarity(np.eye(3), np.zeros(3), np.ones(()))


@pytest.fixture(scope="module")
def made():
    return make_capture(12, views=6, size=(160, 120), arc=200)


def gather(made, *, off=0.0, share=0.1) -> list[Evidence]:
    """True points of the table and what stands on it, as stereo would find some of them."""
    rng = np.random.default_rng(0)
    rows, columns = np.indices(made.true_depth.shape[1:])
    pixels = np.stack([columns, rows], -1).reshape(-1, 2).astype(float)
    evidence = []
    for index, depth in enumerate(made.true_depth):
        points = unproject(made.camera.to_matrix(), pixels, depth.reshape(-1).astype(float))
        chosen = points[(depth.reshape(-1) < 1.5) & (rng.uniform(size=len(points)) < share)]
        chosen = chosen * (1 + rng.normal(0, 0.002, (len(chosen), 1)) + off * rng.uniform(-1, 1, (len(chosen), 1)))
        poses = made.world_from_camera
        pose = poses.take(index)
        evidence.append(Evidence(made.raw_depth[index].astype(float), pose, chosen, np.ones(len(chosen))))
    return evidence


def rig(camera, pose) -> Rig:
    return Rig(np.asarray(camera.to_matrix(), float), pose)


def test_it_is_found_from_the_factory_and_from_nowhere(made):
    truth = rig(made.depth_camera, made.colour_from_depth)
    factory = rig(made.factory_depth_camera, made.factory_colour_from_depth)
    evidence = gather(made)
    for start, told in ((factory, True), (rig(made.factory_depth_camera, NOWHERE), False)):
        solved = solve_rig(evidence, start, told=told)
        apart = np.abs(difference(solved.rig, truth))
        assert solved.trusted and len(solved.notes) == 1
        assert np.rad2deg(apart[:3].max()) < 0.2 and apart[3:6].max() < 0.002 and apart[6:].max() < 0.004
        assert (apart < 5 * solved.deviation + 1e-4).all()
        assert solved.agreement > 0.95 and solved.spread < solved.spread_before


def test_where_stereo_and_depth_disagree_the_factory_is_kept(made):
    factory = rig(made.factory_depth_camera, made.factory_colour_from_depth)
    solved = solve_rig(gather(made, off=0.08), factory, told=True)
    assert not solved.trusted and solved.rig is factory and "disagree" in solved.notes[-1]
    assert "the factory's rig is kept" in solved.notes[-1]
    solved = solve_rig(gather(made, share=0.001), factory, told=True)
    assert solved.rig is factory and "too few" in solved.notes[0]


def test_one_frame_alone_is_weakly_determined(made):
    factory = rig(made.factory_depth_camera, made.factory_colour_from_depth)
    solved = solve_rig(gather(made, share=0.5)[:1], factory, told=True)
    assert not solved.trusted and "weakly determined" in solved.notes[-1]


def test_the_scale_is_voted_for():
    rng = np.random.default_rng(0)
    estimated = rng.uniform(1, 3, (40, 50))
    captured = np.where(rng.uniform(size=estimated.shape) < 0.4, rng.uniform(0.1, 2, estimated.shape), 0.25 * estimated)
    captured[:10] = 0
    scale, agreement = find_scale(captured, estimated)
    assert scale == pytest.approx(0.25, rel=1e-3) and 0.55 < agreement < 0.7
    assert find_scale(np.zeros((4, 5)), np.ones((4, 5))) == (1.0, 0.0)
