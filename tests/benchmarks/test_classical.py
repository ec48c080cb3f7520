"""The classical baseline: what it needs is told, and where Open3D is installed it finds a pose."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.bop_roots import ERRORS, write_models

from benchmarks import classical
from ipjax.bop.records import MM, Frame
from ipjax.files.meshes.loading import load_mesh

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("trouble", "told"),
    [
        ("ModuleNotFoundError('not here')", "the classical baseline needs Open3D: pip install open3d"),
        (
            "OSError('libusb-1.0.so.0: cannot open')",
            "Open3D is installed but a system library that it needs does not load: libusb-1.0.so.0: cannot open",
        ),
    ],
)
def test_where_open3d_does_not_load_it_says_what_is_missing(tmp_path, trouble, told):
    (tmp_path / "open3d.py").write_text(f"raise {trouble}\n")
    roots = [str(tmp_path), str(ROOT), str(ROOT / "kernels"), *sys.path]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.classical", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        env=dict(os.environ, PYTHONPATH=os.pathsep.join(p for p in roots if p), OMP_NUM_THREADS="7"),
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.strip() == told


def test_masked_pixels_become_points_in_metres():
    depth, mask = np.zeros((4, 6), np.float32), np.zeros((4, 6), bool)
    depth[1:3, 1:5], mask[1:3, 1:4] = 0.5, True
    depth[1, 1] = 3.0  # the border of a mask sees what is behind
    K = np.array([[100.0, 0, 2], [0, 50, 1], [0, 0, 1]])
    points = classical.unproject(Frame(np.zeros((4, 6, 3), np.uint8), depth, K), mask)
    np.testing.assert_allclose(
        points, [[0, 0, 0.5], [0.005, 0, 0.5], [-0.005, 0.01, 0.5], [0, 0.01, 0.5], [0.005, 0.01, 0.5]]
    )
    nothing = Frame(np.zeros((4, 6, 3), np.uint8), None, K)
    assert classical.unproject(nothing, mask).shape == (0, 3)


def test_a_diameter_is_the_largest_distance():
    points = ERRORS["obj1_pts"].astype(float)
    assert classical.diameter(points) == pytest.approx(float(ERRORS["obj1_diameter"]), rel=1e-3)


def test_it_finds_a_known_pose_twice_the_same(tmp_path):
    pytest.importorskip("open3d", reason="the classical baseline is optional: pip install open3d")
    write_models(tmp_path)
    mesh = load_mesh(tmp_path / "models_eval" / "obj_000001.ply")
    body = classical.Body(mesh, MM, "golden")
    rotation, translation = ERRORS["R_gt"][3].astype(float), np.array([0.05, -0.02, 0.8])
    random = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces] * MM
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    face = random.choice(len(area), 6000, p=area / area.sum())
    weight = random.dirichlet([1, 1, 1], 6000)
    points = np.einsum("nk,nki->ni", weight, corners[face]) @ rotation.T + translation
    found = [classical.Classical({1: body}, seed=0).register(1, points) for _ in range(2)]
    assert found[0] is not None and found[1] is not None
    pose, fitness = found[0]
    np.testing.assert_allclose(pose[:3, :3], rotation, atol=0.05)
    np.testing.assert_allclose(pose[:3, 3], translation, atol=0.004)
    assert fitness > 0.9
    np.testing.assert_array_equal(found[1][0], pose)
