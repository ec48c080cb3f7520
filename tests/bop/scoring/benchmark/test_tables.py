"""A benchmark as text and as CSV: every figure stands where its heads say."""

import csv
import io
import re
from dataclasses import replace

from ipjax.bop.scoring.benchmark.tables import format_benchmark, format_csv, write_csv


def test_the_text_has_a_table_for_each_figure_and_a_column_for_each_entry(compared):
    lines = format_benchmark(compared.found).splitlines()
    start = lines.index("AUC of ADD-S, 0 to 10 cm (%):")
    assert lines[start + 1].split() == ["real", "synthetic"]
    assert lines[start + 2].split() == ["object", "sure", "rough", "sure", "rough"]
    for line, name in zip(lines[start + 3 : start + 7], ("2", "3", "mean", "all"), strict=True):
        figures = [e.objects[int(name)] if name.isdigit() else getattr(e, name) for e in compared.found.entries]
        assert line.split() == [name, *(f"{100 * one.auc_add_s:.1f}" for one in figures)]
    # Each data set's title stands over its first column.
    assert lines[start + 1].index("synthetic") >= lines[start + 2].index("rough")
    assert "BOP's recalls on synthetic" in "\n".join(lines) and "AR_MSSD" in "\n".join(lines)
    assert "Note: rough on real: 1 of 6 targets have no estimate and count as infinitely wrong." in lines


def test_one_entry_is_one_table(compared):
    found, entry = compared.found, compared.found.entries[1]
    alone = replace(found, participants=("rough",), datasets=("real",), entries=(entry,), notes=())
    lines = format_benchmark(alone).splitlines()
    assert re.split("  +", lines[1]) == [
        "object",
        "found",
        "AUC ADD",
        "AUC ADD-S",
        "ADD-S < 2 cm",
        "5° 5 cm",
        "seconds",
    ]
    assert lines[3].split()[:3] == ["3", "2/3", f"{100 * entry.objects[3].auc_add:.1f}"]
    assert lines[4].split()[-1] == f"{entry.mean.seconds:.2f}"


def test_the_csv_has_all_figures_whole(compared, tmp_path):
    rows = list(csv.DictReader(io.StringIO(format_csv(compared.found))))
    assert len(rows) == 4 * (2 + 2)
    entries = {(e.dataset, e.participant): e for e in compared.found.entries}
    for row in rows:
        entry, name = entries[row["dataset"], row["participant"]], row["object"]
        one = entry.objects[int(name)] if name.isdigit() else getattr(entry, name)
        for key in ("targets", "found", "auc_add", "auc_add_s", "add_s_2cm", "pose_5deg_5cm", "seconds"):
            assert float(row[key]) == getattr(one, key)
        assert float(row["AR_MSSD"]) == one.recalls["mssd"]
    assert write_csv(compared.found, tmp_path / "t.csv").read_text() == format_csv(compared.found)
