"""Depth images are drawn as the toolkit draws them, several objects at once."""

from pathlib import Path

import numpy as np

from ipjax.bop.scoring.discrepancy import render_depths
from ipjax.transforms import Similarity

VSD = np.load(Path(__file__).resolve().parents[2] / "golden" / "bop_vsd.npz")


def test_rendered_depth_follows_the_toolkits_pixels(small):
    """The golden depth maps sample the surface at pixel + ½, as the toolkit's renderers do."""
    rows = np.flatnonzero(VSD["obj_id"] == 2)[:3]
    poses = [Similarity(VSD["R_gt"][i].astype(float), VSD["t_gt"][i].astype(float) / 1000, np.ones(())) for i in rows]
    cameras = np.repeat(VSD["K"][None], len(rows), 0)
    golden = VSD["depth_gt"][rows]
    apart = {}
    for corner in (0.0, 0.5):
        drawn = 1000 * render_depths(small.mesh(2), poses, cameras, 96, 128, corner=corner)
        both = (drawn > 0) & (golden > 0)
        apart[corner] = np.abs(drawn - golden)[both].mean()
        if corner == 0.5:
            assert ((drawn > 0) != (golden > 0)).sum() <= 3  # of some thousand
    assert apart[0.5] < 0.05  # mm; the golden depths are rounded to 1/16 mm
    assert apart[0.0] > 2 * apart[0.5]


def test_several_objects_are_drawn_at_once(small):
    """Each image shows its own object alone, as if it had been drawn by itself."""
    truths = {t.obj_id: t for t in small.truths(0, 0)}
    numbers = sorted(truths)
    poses = [truths[n].camera_from_object for n in numbers]
    camera = small.camera(0, 0)[0][None]
    meshes = [small.mesh(n) for n in numbers]
    together = render_depths(
        meshes, poses[::-1], np.repeat(camera, len(poses), 0), 96, 128, which=list(range(len(poses)))[::-1]
    )
    for place, n in enumerate(reversed(numbers)):
        alone = render_depths(small.mesh(n), [poses[numbers.index(n)]], camera, 96, 128)[0]
        assert (alone > 0).any()
        np.testing.assert_array_equal(together[place] > 0, alone > 0)
        np.testing.assert_allclose(together[place], alone, atol=1e-6)
