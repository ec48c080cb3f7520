"""``ipjax demo``: what it compares, and what it refuses. The whole of it is what ``make demo`` runs."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders.command_lines import run

from ipjax.commands.demo_scene import compare
from ipjax.records import Similarity
from ipjax.synthetic.objects import make_object


def test_a_comparison_tells_what_was_changed():
    mesh = make_object("wedge")
    true = Similarity(jnp.eye(3), jnp.asarray([0.0, 0.0, 0.8]), jnp.asarray(0.2))
    same = compare(true, true, mesh)
    assert same.good and same.add < 1e-6 and same.rotation < 0.1 and same.translation == 0
    angle = np.radians(30)
    turn = jnp.asarray([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], jnp.float32)
    moved = Similarity(turn, true.translation + jnp.asarray([0.06, 0.0, 0.0]), jnp.asarray(0.25))
    found = compare(moved, true, mesh)
    assert found.rotation == pytest.approx(30, abs=0.1) and found.translation == pytest.approx(0.06, rel=1e-5)
    assert (found.true_size, found.size) == (pytest.approx(0.2), pytest.approx(0.25))
    assert not found.good and found.adds <= found.add
    told = found.as_json()
    assert told["translation_mm"] == pytest.approx(60, rel=1e-5) and told["diameter_mm"] == pytest.approx(250)
    assert all(np.isfinite(x) for x in told.values())


def test_a_file_in_the_way_is_told(tmp_path, capfd):
    (tmp_path / "out").write_text("")
    assert run(["demo", "-o", str(tmp_path / "out")]) == 2
    assert "a file of this name is in the way" in capfd.readouterr().err
