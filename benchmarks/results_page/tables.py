"""The numbers of the page as tables: their rows, and the page of them in Markdown."""

import time

from benchmarks.measure import commit, describe_device
from benchmarks.results_page.runs import HEADS, Study, knows_size, parts
from ipjax.bop.scoring.tables import FEW, SIZED


def overview(studies: list[Study]) -> list[list[str]]:
    """A row for each run of each study: the headline."""
    rows = [["data and meshes", "method", "targets", *HEADS.values(), "all frames: AR", "rotation °", "translation mm"]]
    rows[0] += ["scale %", "s per image"]
    for study in studies:
        for run in study.runs:
            part, seconds = run["one_frame_per_scene"], run["seconds_per_image"]
            cells = [percent(part["recalls"].get(n), part["intervals"].get(n) if n == "ar" else None) for n in HEADS]
            cells += [percent(run["all_frames"]["recalls"].get("ar"))]
            cells += [*median_cells(run), "–" if seconds is None else f"{seconds:.1f}"]
            rows.append([study.title, run["method"], str(part["targets"]), *cells])
    return rows


def median_cells(run: dict) -> list[str]:
    """Rotation, translation, scale; the last is no error of a method that was given the size."""
    m = run["medians"]
    cells = [f"{m[k]:.1f}" if k in m else "–" for k in ("rotation_deg", "translation_mm", "scale_percent")]
    return [*cells[:2], "given" if knows_size(run) else cells[2]]


def tables(study: Study) -> list[tuple[str, list[list[str]]]]:
    """Headings and rows, the first row being the columns' names."""
    runs, names = study.runs, study.metrics
    found = []
    for title in parts(runs[0]):
        rows = [["method", "images", "targets", *(HEADS[n] for n in names)]]
        for run in runs:
            part = parts(run).get(title)
            if part is not None:
                cells = [percent(part["recalls"].get(n), part["intervals"].get(n)) for n in names]
                rows.append([run["method"], str(part["images"]), str(part["targets"]), *cells])
        heading = title[0].upper() + title[1:] + (" (the headline)" if title == "one frame per scene" else "")
        found.append((heading + ": average recalls, %, with 95 % bootstrap intervals over images", rows))
    rows = [["method", "rotation °", "translation mm", "scale %", "not found", "ADD-S AUC", "ADD(-S) AUC"]]
    rows[0] += ["ADD-S < 0.1 d, %", "s per image"]
    for run in runs:
        a, seconds = run["add"], run["seconds_per_image"]
        cells = [*median_cells(run), str(run["missing"])]
        few = run["all_frames"]["targets"] < FEW
        cells += [percent(None if few else a.get(k)) for k in ("add_s_auc", "add_or_s_auc")]
        cells += [percent(a.get("add_s_01d"))]
        rows.append([run["method"], *cells, "–" if seconds is None else f"{seconds:.1f}"])
    found.append(("Medians of what was found, areas under the curve to 10 cm, time", rows))
    if any(run["all_frames"].get("sized") for run in runs):
        rows = [["method", *(name if "size" in name else f"AR {name}" for name in SIZED.values())]]
        for run in runs:
            sized = run["all_frames"].get("sized", {})
            cells = [
                "given" if knows_size(run) and name.startswith("size") else percent(sized.get(name)) for name in SIZED
            ]
            rows.append([run["method"], *cells])
        heading = (
            "The model at its estimated size, which BOP's recalls do not see, %, all frames; errors in true diameters"
        )
        found.append((heading, rows))
    metric = names[-1]
    rows = [["object", "targets", *(run["method"] for run in runs), "best"]]
    wins = dict.fromkeys(range(len(runs)), 0)
    for obj, entry in sorted(runs[0]["objects"].items(), key=lambda pair: int(pair[0])):
        values = [run["objects"].get(obj, {}).get(metric) for run in runs]
        best = max(v for v in values if v is not None)
        winners = [i for i, v in enumerate(values) if v == best]
        if len(winners) == 1:
            wins[winners[0]] += 1
        who = runs[winners[0]]["method"] if len(winners) == 1 else "tie"
        rows.append([obj, f"{entry['targets']:.0f}", *(percent(v) for v in values), who if len(runs) > 1 else ""])
    if len(runs) > 1:
        rows.append(["wins", "", *(str(wins[i]) for i in range(len(runs))), ""])
    found.append((f"{HEADS[metric]} per object, %, all frames", rows))
    return found


def preamble(studies: list[Study]) -> list[str]:
    """Where the numbers come from."""
    runs = [run for study in studies for run in study.runs]
    device = describe_device()
    lines = [
        "Masks as annotated; objects onboarded from normalised meshes, so that ipjax has their size to find. The "
        "classical baseline (FPFH, RANSAC, ICP) is told their true size.",
        f"Device of this page: {device['device']}, {device['cores']} cores, "
        + ("no GPU" if device["platform"] == "cpu" else str(device["platform"]))
        + f"; jax {device['jax']}, Python {device['python']}; commit {commit()}, {time.strftime('%Y-%m-%d')}. Seconds "
        "per image are for all of its targets, as measured, on whatever else the machine was doing.",
    ]
    lines += [
        f"Encoder: {e}." for e in dict.fromkeys(r["settings"]["encoder"] for r in runs if "encoder" in r["settings"])
    ]
    views = [o.get("onboarding", {}) for run in runs for o in run["settings"].get("objects", {}).values()]
    lines += [
        f"Templates: {d} directions × {r} rolls."
        for d, r in sorted({(v["directions"], v["rolls"]) for v in views if "directions" in v})
    ]
    if any(run["without"] for run in runs):
        lines.append("Without SCENE/IMAGE: its annotation is in doubt, by the data set's own notes.")
    if any(run["all_frames"]["targets"] < 500 for run in runs):
        lines.append("Mini sets: not to be compared with published figures of the full data sets.")
    return lines


def notes(study: Study) -> list[str]:
    """The notes of all runs, once each."""
    chosen = [note for run in study.runs for note in run["notes"] if "true size" not in note]
    return [f"{note}." for note in dict.fromkeys(chosen)]


def percent(value: float | None, interval=None) -> str:
    """A share in %, with its interval."""
    if value is None:
        return "–"
    text = f"{100 * value:.1f}"
    return text if not interval else f"{text} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def markdown(studies: list[Study]) -> str:
    """The page of numbers."""
    lines = ["# Accuracy", "", "Made by `python -m benchmarks.evaluation`; do not edit by hand.", ""]
    lines += [f"* {line}" for line in preamble(studies)]
    lines += ["", "## In short: one frame per scene", "", *markdown_table(overview(studies))]
    for study in studies:
        lines += ["", f"## {study.title}", *(f"\n{note}" for note in notes(study))]
        for title, rows in tables(study):
            lines += ["", f"### {title}", "", *markdown_table(rows)]
    return "\n".join(lines) + "\n"


def markdown_table(rows: list[list[str]]) -> list[str]:
    """Its lines; numbers to the right."""
    head = ["| " + " | ".join(rows[0]) + " |", "|" + " --- |" + " ---: |" * (len(rows[0]) - 1)]
    return head + ["| " + " | ".join(row) + " |" for row in rows[1:]]
