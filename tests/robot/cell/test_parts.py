"""Convex parts fill what the mesh fills, and are made once."""

import numpy as np
import pytest
from builders.cells import SIDES, make_block

from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.robot.cell import parts
from ipjax.robot.cell.parts import make_parts


def make_corner(size=0.1, thick=0.03) -> Mesh:
    """An L, extruded, closed: its hull is far larger than itself."""
    outline = np.array([[0, 0], [size, 0], [size, thick], [thick, thick], [thick, size], [0, size]])
    n = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (0, thick)])
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[[i, (i + 1) % n, n + (i + 1) % n], [i, n + (i + 1) % n, n + i]] for i in range(n)]
    return make_mesh(vertices, np.concatenate([caps[:, ::-1], caps + n, np.array(sides).reshape(-1, 3)]))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path))
    return tmp_path


def test_a_convex_mesh_is_its_hull(cache):
    found = make_parts(make_block())
    assert found.method == "hull" and len(found.corners) == 1 and not found.notes
    assert found.volume == pytest.approx(np.prod(SIDES)) and found.filled == pytest.approx(1)
    assert not list(cache.rglob("*.npz"))


def test_a_hollow_mesh_is_several_parts_kept_by_content(cache, monkeypatch):
    pytest.importorskip("coacd")
    mesh = make_corner()
    found = make_parts(mesh, "an L")
    true = 0.03 * (0.1**2 - 0.07**2)
    assert found.method == "coacd" and len(found.corners) > 1 and not found.notes
    assert found.volume == pytest.approx(true, rel=0.1) and found.filled == pytest.approx(found.volume / true, rel=1e-6)
    low, high = (np.concatenate(found.corners).min(0), np.concatenate(found.corners).max(0))
    assert np.abs(low - mesh.vertices.min(0)).max() < 0.002 and np.abs(high - mesh.vertices.max(0)).max() < 0.002

    def never(*_):
        raise AssertionError("made again")

    monkeypatch.setattr(parts, "_decompose", never)
    again = make_parts(mesh)
    assert all((a == b).all() for a, b in zip(found.corners, again.corners, strict=True))
    (kept,) = cache.rglob("*.npz")
    whole = kept.read_bytes()
    for damaged in (b"broken", b"", whole[: len(whole) // 2]):
        kept.write_bytes(damaged)
        with pytest.raises(AssertionError, match="made again"):
            make_parts(mesh)


def test_parts_that_fill_the_hollow_are_told(monkeypatch):
    pytest.importorskip("coacd")
    mesh = make_corner(thick=0.02)
    monkeypatch.setattr(parts, "_decompose", lambda *_: iter([mesh.vertices]))
    found = make_parts(mesh, "an L")
    assert found.filled > 1.5 and "an L are 1.9 times its volume: hollows" in found.notes[0]
    monkeypatch.setattr(parts, "_decompose", lambda *_: iter([2 * mesh.vertices]))
    found = make_parts(make_corner(thick=0.03), "an L")
    assert found.method == "hull" and "cannot be: it collides as its convex hull" in found.notes[0]


def test_without_coacd_it_is_the_hull(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "coacd", None)
    found = make_parts(make_corner(), "an L")
    assert found.method == "hull" and "pip install 'ipjax[robot]'" in found.notes[0]
    with pytest.raises(ValueError, match="CoACD is not installed"):
        make_parts(make_corner(), method="coacd")


def test_flat_meshes_are_refused():
    flat = make_mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    with pytest.raises(ValueError, match="a sheet is flat"):
        make_parts(flat, "a sheet")
    with pytest.raises(ValueError, match="auto, hull or coacd"):
        make_parts(make_block(), method="boxes")
