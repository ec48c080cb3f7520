"""Files in other conventions, of other things, or merely wrong."""

from dataclasses import replace

import numpy as np
import pytest
from builders.bop_roots import true_rows
from hypothesis import given, settings
from hypothesis import strategies as st

from ipjax.bop.records import DatasetError
from ipjax.bop.results import write_results
from ipjax.bop.scoring.scores import score
from ipjax.bop.scoring.tables import format_score


def transposed(row):
    return replace(row, rotation=tuple(np.reshape(row.rotation, (3, 3)).T.ravel()))


def inverted(row):
    """The camera's pose in the object's frame."""
    R = np.reshape(row.rotation, (3, 3)).T
    return replace(transposed(row), translation=tuple(-R @ row.translation))


@pytest.mark.parametrize("change", [transposed, inverted])
def test_poses_the_wrong_way_round_are_told(small, change):
    rows = [change(row) for row in true_rows(small)]
    says = "right when R is transposed: R and t must map the model into the camera's frame"
    with pytest.raises(DatasetError, match=f"results: the rotations are {says}"):
        score(rows, small, ("mssd",), samples=0)
    assert says in format_score(score(rows, small, ("mssd",), samples=0, on_error="skip"))


@given(seed=st.integers(0, 1000))
@settings(max_examples=10)
def test_rotations_that_are_merely_wrong_are_scored(small, seed):
    random = np.random.default_rng(seed)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in true_rows(small)]
    rows = [
        replace(row, rotation=tuple((turn * np.linalg.det(turn)).ravel()))
        for row, turn in zip(true_rows(small), turns, strict=True)
    ]
    score(rows, small, ("mssd",), samples=0)


def test_rows_of_things_that_do_not_exist(small, tmp_path):
    rows = true_rows(small)
    for bad, says in ((replace(rows[0], obj_id=77), "no object 77"), (replace(rows[0], im_id=500), "no image 500")):
        path = write_results(tmp_path / "x_small-test.csv", [rows[1], bad])
        with pytest.raises(DatasetError, match=f"line 3: the data set has {says}"):
            score(path, small, ("mssd",))
        found = score(path, small, ("mssd",), on_error="skip", samples=0)
        assert len(found.problems) == 1
        assert found.all_frames.recalls["mssd"] == 1 / 8
    with pytest.raises(ValueError, match="unknown metric"):
        score(rows, small, ("mssq",))


def test_estimates_of_no_target_are_counted(small):
    rows = true_rows(small)
    more = [replace(rows[0], obj_id=1), *rows]
    found = score(more, small, ("mssd",), samples=0)
    assert found.all_frames.recalls["mssd"] == 1.0
    assert any("1 of 9 estimates are of no target" in note for note in found.notes)
    with pytest.raises(DatasetError, match="line 2: R is no rotation: it scales by"):
        score([replace(r, rotation=tuple(np.multiply(r.rotation, 1.5))) for r in rows], small, ("mssd",))
