"""Folders appear whole or not at all."""

import pytest

from ipjax.files.storage.folders import writing_folder


def test_a_folder_appears_when_it_is_whole(tmp_path):
    with writing_folder(tmp_path / "deep" / "set") as inside:
        (inside / "one.txt").write_text("1")
        assert not (tmp_path / "deep" / "set").exists()
    assert (tmp_path / "deep" / "set" / "one.txt").read_text() == "1"
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["set"]


def test_a_failure_leaves_what_was_there(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "old.txt").write_text("old")
    with pytest.raises(RuntimeError), writing_folder(tmp_path / "set", replace=True) as inside:
        (inside / "new.txt").write_text("new")
        raise RuntimeError
    assert [path.name for path in tmp_path.rglob("*.txt")] == ["old.txt"]


def test_what_is_there_gives_way_only_when_told(tmp_path):
    (tmp_path / "set").mkdir()
    with writing_folder(tmp_path / "set") as inside:  # an empty folder is nothing
        (inside / "old.txt").write_text("old")
    with pytest.raises(FileExistsError, match="there already"), writing_folder(tmp_path / "set"):
        pass
    with writing_folder(tmp_path / "set", replace=True) as inside:
        (inside / "new.txt").write_text("new")
    assert [path.name for path in tmp_path.rglob("*.txt")] == ["new.txt"]


def test_what_a_killed_writer_left_is_removed(tmp_path):
    left = tmp_path / ".set.0123456789ab.part"
    left.mkdir()
    with writing_folder(tmp_path / "set"):
        pass
    assert not left.exists() and (tmp_path / "set").is_dir()
