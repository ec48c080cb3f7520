"""A reconstructed mesh is scored in the model's frame, and the table says so."""

import json

import numpy as np
import pytest
from builders.bop_roots import ERRORS

from ipjax.bop.alignments import align, read_alignment
from ipjax.bop.records import DatasetError, Estimate
from ipjax.bop.results import as_row
from ipjax.bop.scoring.scores import score
from ipjax.bop.scoring.tables import format_score


def test_an_alignment_moves_the_mesh_and_is_named(small, tmp_path):
    turn = ERRORS["R_gt"][5].astype(float)
    path = tmp_path / "mesh_to_model.json"
    path.write_text(json.dumps({"scale": 250.0, "R": turn.tolist(), "t": [3.0, -4.0, 5.0]}))
    model_from_mesh = read_alignment(path)
    assert model_from_mesh.scale == 0.25
    shift = np.array([0.003, -0.004, 0.005])
    truth = small.truths(0, 0)[0]
    # camera_from_mesh = camera_from_model ∘ model_from_mesh
    of_mesh = Estimate(2, 1.0, truth.rotation @ turn, truth.rotation @ shift + truth.translation, 0.25)
    moved = align(of_mesh, model_from_mesh)
    np.testing.assert_allclose(moved.rotation, truth.rotation, atol=1e-6)
    np.testing.assert_allclose(moved.translation_m, truth.translation, atol=1e-7)
    assert moved.scale == pytest.approx(1.0)
    rows = [as_row(0, 0, of_mesh)]
    found = score(
        rows, small, ("mssd",), objects=[2], alignments={2: model_from_mesh}, aligned_by={2: path.name}, samples=0
    )
    assert found.all_frames.recalls["mssd"] == 1 / 4
    assert "mesh_to_model.json" in format_score(found)
    for bad, says in ((-1.0, "it mirrors"), (1.3, "it scales by 1.3")):
        path.write_text(json.dumps({"scale": 250.0, "R": (bad * turn).tolist(), "t": [0, 0, 0]}))
        with pytest.raises(DatasetError, match=f"mesh_to_model.json: R is no rotation: {says}"):
            read_alignment(path)
    path.write_text('{"scale": 1}')
    with pytest.raises(DatasetError, match="an alignment is JSON"):
        read_alignment(path)
