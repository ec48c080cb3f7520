"""A benchmark as text and as CSV."""

import csv
import io
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

from ipjax.bop.scoring.benchmark.figures import RECALLS, Entry, Figures
from ipjax.bop.scoring.benchmark.participants import Benchmark
from ipjax.bop.scoring.tables import in_columns, percent
from ipjax.files.storage.writing import write_text

SHARES = {
    "auc_add": "AUC of ADD, 0 to 10 cm",
    "auc_add_s": "AUC of ADD-S, 0 to 10 cm",
    "add_s_2cm": "ADD-S below 2 cm",
    "pose_5deg_5cm": "Within 5° and 5 cm",
}
HEADS = {"ar": "AR", "vsd": "AR_VSD", "mssd": "AR_MSSD", "mspd": "AR_MSPD"}
PRECISIONS = {"ap_mssd": "AP_MSSD", "ap_mspd": "AP_MSPD", "map": "mAP", "ap_mssd_mm": "AP_MSSD, mm"}
SECONDS = "Seconds per image"
DEFINITIONS = (
    "AUC: the exact area under the share of targets with a smaller error, from 0 to 10 cm (PoseCNN, arXiv:1711.00199; "
    "its toolbox's sum is higher by up to 1 / targets); ADD knows no symmetries. ADD-S below 2 cm: DenseFusion "
    "(arXiv:1901.04780). 5° and 5 cm: of the symmetric poses, the one whose rotation is nearest counts. A target "
    "without an estimate is infinitely wrong. Seconds: the file's own time of an image, for all objects in it."
)


def format_benchmark(found: Benchmark) -> str:
    """Tables for people: of one column, all figures of an object in a line; of several, a table for each figure, with a
    column for each participant on each data set."""
    lines: list[str] = []
    if len(found.entries) == 1:
        entry = found.entries[0]
        rows = [["object", "found", "AUC ADD", "AUC ADD-S", "ADD-S < 2 cm", "5° 5 cm", "seconds"]]
        for name, figures in list_rows(entry):
            assert figures is not None  # the objects are the entry's own
            shares = [percent(getattr(figures, key)) for key in SHARES]
            rows.append([name, f"{figures.found}/{figures.targets}", *shares, format_seconds(figures)])
        lines += ["By object (%):", *in_columns(rows)]
    else:
        for title in found.datasets:
            lines += [*_format_recalls(found.of(title), title), ""]
        for key, title in SHARES.items():
            lines += [f"{title} (%):", *_beside(found, lambda figures, key=key: percent(getattr(figures, key))), ""]
        lines += [f"{SECONDS}:", *_beside(found, format_seconds)]
    # The notes on a single score stand in its own table.
    notes = found.notes if len(found.entries) == 1 else found.all_notes()
    return "\n".join([*lines, "", *textwrap.wrap(DEFINITIONS, 110), *(f"Note: {note}." for note in notes)])


def list_rows(entry: Entry, objects: Sequence[int] | None = None) -> list[tuple[str, Figures | None]]:
    """The lines of a table: every object (None where the data set lacks it), the mean over objects, all targets."""
    rows: list[tuple[str, Figures | None]] = [
        (str(obj), entry.objects.get(obj)) for obj in (entry.objects if objects is None else objects)
    ]
    return [*rows, ("mean", entry.mean), ("all", entry.all)]


def format_seconds(figures: Figures) -> str:
    """The time of an image, or a dash where it is not known."""
    return "–" if figures.seconds is None else f"{figures.seconds:.2f}"


def _beside(found: Benchmark, show: Callable[[Figures], str]) -> list[str]:
    columns = [["", "object", *(name for name, _ in list_rows(found.entries[0], found.objects()))]]
    for entry in found.entries:
        cells = ["–" if one is None else show(one) for _, one in list_rows(entry, found.objects())]
        first = entry.participant == found.participants[0]
        columns.append([entry.dataset if first else "", entry.participant, *cells])
    rows = [list(row) for row in zip(*columns, strict=True)]
    return in_columns(rows if len(found.datasets) > 1 else rows[1:])


def _format_recalls(entries: Sequence[Entry], title: str) -> list[str]:
    """BOP's recalls of every participant on a data set."""
    names = [name for name in RECALLS if all(name in entry.all.recalls for entry in entries)]
    precisions = [name for name in PRECISIONS if all(name in entry.score.precision for entry in entries)]
    heads = [*(HEADS[name] for name in names), *(PRECISIONS[name] for name in precisions)]
    rows = [["", "images", "targets", "missing", *heads]]
    for entry in entries:
        for part, summary in entry.score.parts().items():
            cells = [percent(summary.recalls[n], summary.intervals.get(n)) for n in names]
            missing = str(entry.score.missing) if part == "all frames" else ""
            cells += [percent(entry.score.precision[n]) if part == "all frames" else "" for n in precisions]
            rows.append([f"{entry.participant}, {part}", str(summary.images), str(summary.targets), missing, *cells])
    return [f"BOP's recalls on {title} (%; brackets: 95 % bootstrap over images):", *in_columns(rows)]


def format_csv(found: Benchmark) -> str:
    """A line for each participant, data set and object, for their mean and for all targets; shares are from 0 to 1."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [name for name in RECALLS if any(name in entry.all.recalls for entry in found.entries)]
    writer.writerow(
        ["dataset", "participant", "object", "targets", "found", *SHARES, "seconds", *map(HEADS.get, names)]
    )
    for entry in found.entries:
        for name, one in list_rows(entry):
            assert one is not None  # the objects are the entry's own
            shares = [repr(getattr(one, key)) for key in SHARES]
            seconds = "" if one.seconds is None else repr(one.seconds)
            recalls = [repr(one.recalls[n]) if n in one.recalls else "" for n in names]
            writer.writerow(
                [entry.dataset, entry.participant, name, one.targets, one.found, *shares, seconds, *recalls]
            )
    return text.getvalue()


def write_csv(found: Benchmark, path: str | Path) -> Path:
    """`format_csv` as a file, whole or not at all."""
    return write_text(path, format_csv(found), parents=True)
