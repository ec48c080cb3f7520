"""Several result files: what they are called, what is noted, and what is refused in a sentence."""

import json
import shutil

import pytest

from ipjax.bop.records import DatasetError
from ipjax.bop.results import HEADER
from ipjax.bop.scoring.benchmark.participants import compare


def test_names_come_from_files_and_columns_keep_their_order(compared):
    found = compared.found
    assert found.participants == ("sure", "rough") and found.datasets == ("real", "synthetic")
    assert [(e.dataset, e.participant) for e in found.entries] == [
        (title, name) for title in ("real", "synthetic") for name in ("sure", "rough")
    ]
    assert [e.score.dataset for e in found.of("synthetic")] == ["made-test"] * 2
    assert "rough on real: 1 of 6 targets have no estimate and count as infinitely wrong" in found.notes
    record = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert record["entries"][1]["objects"]["3"]["found"] == 2 and len(record["thresholds"]) == 201
    assert record["entries"][3]["mean"]["auc_add"] == found.entries[3].mean.auc_add


def test_equal_names_are_told_apart_by_their_folders(compared, tmp_path):
    dataset, (path, _) = compared.groups[0]
    copies = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        copies.append(shutil.copy(path, tmp_path / name / "results.csv"))
    assert compare([(dataset, copies)], ("mssd",), samples=0).participants == ("a/results", "b/results")


def test_what_does_not_fit_is_refused(compared, tmp_path):
    (dataset, (first, second)), other = compared.groups
    refuse = lambda groups, **more: compare(groups, ("mssd",), samples=0, **more)
    with pytest.raises(ValueError, match=r"sure_real-test\.csv is given twice"):
        refuse([(dataset, [first, first])])
    with pytest.raises(ValueError, match=r"made: every data set needs .* the first has 1, this one 2"):
        refuse([(dataset, [first]), other])
    with pytest.raises(ValueError, match="2 participants need as many names, got 1: A"):
        refuse([(dataset, [first, second])], names=["A"])
    with pytest.raises(ValueError, match="two participants have the same name, 'A'"):
        refuse([(dataset, [first, second])], names=["A", "A"])
    with pytest.raises(ValueError, match="nothing to score"):
        refuse([])
    # The second of two files is named by what is wrong with it.
    row = "0,0,2,1.0,1 0 0 0 1 0 0 0 1,{},0.5"
    for text, says in (
        (f"{HEADER}\n" + "0,0,77,1.0,1 0 0 0 1 0 0 0 1,0 0 700,0.5\n", "line 2: the data set has no object 77"),
        (f"{HEADER}\n{row.format('0 0 700')}\n{row.format('0 0 700')}\n", "line 3: the row is the same as that of"),
        (first.read_text().splitlines()[0], None),
        (f"{HEADER}\n{row.format('-0.075 0 0.7')}\n", "some 1000 times too small .* it seems to be in metres"),
        ("not a table", "line 1: the header must be"),
    ):
        (tmp_path / "bad.csv").write_text(text)
        if says is None:  # nothing is no mistake
            notes = refuse([(dataset, [first, tmp_path / "bad.csv"])]).all_notes()
            assert "bad: there are no estimates, so that every target is a miss" in notes
            assert "bad: the file tells no times" in notes
            continue
        with pytest.raises(DatasetError, match=rf"bad\.csv.*{says}"):
            refuse([(dataset, [first, tmp_path / "bad.csv"])])


def test_means_over_different_objects_are_noted(compared, tmp_path):
    (dataset, files), (other, others) = compared.groups
    root = tmp_path / "made"
    shutil.copytree(other.root, root)
    targets = json.loads((root / "test_targets_bop19.json").read_text())
    (root / "test_targets_bop19.json").write_text(json.dumps([t for t in targets if t["obj_id"] == 2]))
    fewer = type(other)(root)
    found = compare([(dataset, files[:1]), (fewer, others[:1])], ("mssd",), samples=0)
    assert "made-test has no targets of object 3, so that its means are of fewer objects" in found.notes
    assert found.objects() == [2, 3] and set(found.of("made-test")[0].objects) == {2}
