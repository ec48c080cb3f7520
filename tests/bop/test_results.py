"""Result files come back byte for byte, and what is wrong with a line is said."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.bop.records import DatasetError, Estimate, check_rotation
from ipjax.bop.results import HEADER, as_row, format_row, read_results, write_results

GOLDEN_CSV = Path(__file__).resolve().parents[1] / "golden" / "ipjaxgolden_ycbv-test.csv"
R, T = "1 0 0 0 1 0 0 0 1", "0 0 1000"


def test_the_golden_csv_survives_byte_for_byte(tmp_path):
    rows = read_results(GOLDEN_CSV)
    assert len(rows) == 6
    written = write_results(tmp_path / "again.csv", rows)
    assert written.read_bytes() == GOLDEN_CSV.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["again.csv"]  # no temporary file stays


def test_an_estimate_becomes_millimetres():
    row = as_row(1, 2, Estimate(3, 0.5, np.eye(3), np.array([0.1, -0.2, 0.7])), 0.25)
    assert format_row(row).startswith("1,2,3,0.5,1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0,100.0 -200.0 700.0,0.25")
    with pytest.raises(ValueError, match="not finite"):
        format_row(as_row(1, 2, Estimate(3, np.nan, np.eye(3), np.zeros(3))))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (f"1,2,3,1.0,{R},{T}", "7 columns"),
        (f"1,2,3,1.0,{R[:-2]},{T},1", "R must hold 9 numbers, got 8"),
        (f"1,2,3,1.0,{R},0 1000,1", "t must hold 3 numbers, got 2"),
        (f"1,2,3,nan,{R},{T},1", "not finite"),
        (f"1,2,3,1.0,{R.replace('0', 'inf', 1)},{T},1", "not finite"),
        (f"1,2,3,high,{R},{T},1", "no number"),
        (f"1,2.5,3,1.0,{R},{T},1", "im_id must be a whole number"),
        (f"1,-2,3,1.0,{R},{T},1", "im_id must be a whole number"),
        (f"1,1,1,1.0,{R},{T},0.5", "same as that of line 2"),
        (f"1,1,2,1.0,{R},{T},0.7", "0.5 s in line 2"),
    ],
)
def test_a_damaged_row_is_named(tmp_path, line, says):
    path = tmp_path / "x_y-test.csv"
    good = f"1,1,1,1.0,{R},{T},0.5"
    path.write_text("\n".join([HEADER, good, line, f"1,9,1,1.0,{R},{T},0.5"]))
    with pytest.raises(DatasetError, match=says) as caught:
        read_results(path)
    assert str(caught.value).startswith(f"{path}, line 3: ")
    assert "\n" not in str(caught.value)
    problems: list[str] = []
    assert len(read_results(path, problems=problems)) == 2
    assert len(problems) == 1 and says in problems[0]


def test_a_wrong_header_or_file_is_named(tmp_path):
    path = tmp_path / "results.csv"
    for text in ("", "scene_id,im_id\n", "1,2,3\n"):
        path.write_text(text)
        with pytest.raises(DatasetError, match="line 1: the header must be"):
            read_results(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match="not a text file"):
        read_results(path)
    with pytest.raises(DatasetError, match="cannot be read"):
        read_results(tmp_path / "absent.csv")


@given(seed=st.integers(0, 1000), noise=st.floats(0.0, 5e-4))
def test_rotations_that_are_rounded_are_accepted(seed, noise):
    """Official files have determinants within 0.003 of 1."""
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    check_rotation((turn + noise * random.uniform(-1, 1, (3, 3))).ravel())
    check_rotation((1.001 * turn).ravel())
    for bad in (1.02 * turn, 0.98 * turn, -turn, turn @ np.diag([1, 1.02, 1]), 0 * turn):
        with pytest.raises(ValueError, match="R is no rotation"):
            check_rotation(bad.ravel())
