"""Objects of a data set: which files are theirs."""

import pytest

from ipjax.bop.objects import parse_numbered


def test_numbered_files(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("")
    assert parse_numbered([f"5={path}"], "--mesh") == {5: path}
    for bad in ("5", f"x={path}", f"5={path}x"):
        with pytest.raises(ValueError, match="--mesh"):
            parse_numbered([bad], "--mesh")
