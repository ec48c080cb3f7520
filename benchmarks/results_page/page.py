"""The page: Markdown of the numbers, and HTML with curves, bars and pictures, from a template."""

import math
from pathlib import Path
from typing import Any

from benchmarks.results_page.pictures import pictures
from benchmarks.results_page.runs import HEADS, Study, knows_size
from benchmarks.results_page.tables import markdown, notes, overview, preamble, tables
from ipjax.files.pages import render_page
from ipjax.files.storage.writing import write_text

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_COLOURS = ("#1b6ca8", "#d1495b", "#2e8b57", "#b8860b", "#6a4c93")  # of the runs


def plot_errors(runs: list[dict], key: str, unit: float, limit: float, label: str) -> dict[str, Any]:
    """The share of all instances with an error below x, a line for each run: what the template draws."""
    width, height, left, bottom = 420, 260, 44, 36
    across, up = width - left - 10, height - bottom - 10
    rules = [{"y": 10 + up * (1 - k / 4), "label": f"{25 * k} %"} for k in range(5)]
    ticks = [{"x": left + across * k / 4, "label": f"{limit * k / 4:g}"} for k in range(5)]
    lines = []
    for colour, run in zip(_COLOURS, runs, strict=False):
        if key == "scale" and knows_size(run):
            continue
        values = [math.inf if i[key] is None else i[key] * unit for i in run["instances"]]
        points, total = [f"{left},{10 + up}"], len(values)
        for count, value in enumerate(sorted(v for v in values if v <= limit), start=1):
            x = left + across * value / limit
            points += [
                f"{x:.1f},{10 + up * (1 - (count - 1) / total):.1f}",
                f"{x:.1f},{10 + up * (1 - count / total):.1f}",
            ]
        points.append(f"{left + across},{points[-1].split(',')[1]}")
        lines.append({"points": " ".join(points), "colour": colour})
    frame = {"width": width, "height": height, "left": left, "right": left + across, "middle": left + across / 2}
    return {"label": label, "rules": rules, "ticks": ticks, "lines": lines, "tick_y": height - bottom + 16, **frame}


def plot_objects(study: Study) -> dict[str, Any]:
    """Every object's average recall, a bar for each run: what the template draws."""
    runs, metric = study.runs, study.metrics[-1]
    objects = sorted(runs[0]["objects"], key=int)
    step = max(14 * len(runs) + 8, 26)
    bars, labels = [], []
    for place, obj in enumerate(objects):
        for i, (colour, run) in enumerate(zip(_COLOURS, runs, strict=False)):
            value = run["objects"].get(obj, {}).get(metric) or 0.0
            tall = 180 * value
            bars.append(
                {
                    "x": 46 + place * step + 14 * i,
                    "y": f"{190 - tall:.1f}",
                    "height": f"{tall:.1f}",
                    "colour": colour,
                    "title": f"object {obj}, {run['method']}: {100 * value:.1f}",
                }
            )
        labels.append({"x": 46 + place * step + 7 * len(runs), "text": obj})
    rules = [{"y": 10 + 180 * (1 - k / 4), "label": 25 * k} for k in range(5)]
    return {"width": 50 + step * len(objects), "rules": rules, "bars": bars, "labels": labels, "name": HEADS[metric]}


def describe_study(study: Study) -> dict[str, Any]:
    """What the page shows of a study."""
    runs = study.runs
    curves = [
        plot_errors(runs, "rotation", 180 / math.pi, 60, "rotation error, degrees (nearest symmetric pose)"),
        plot_errors(runs, "translation", 1000, 60, "translation error, mm"),
    ]
    if runs[0]["add"]:
        curves.append(plot_errors(runs, "add_s", 1000, 40, "ADD-S, mm"))
    curves.append(plot_errors(runs, "scale", 100, 40, "scale error, % (methods that have to find it)"))
    return {
        "title": study.title,
        "notes": notes(study),
        "tables": tables(study),
        "key": [(run["method"], colour) for colour, run in zip(_COLOURS, runs, strict=False)],
        "curves": curves,
        "bars": plot_objects(study),
        "drawn": study.main["method"],
        "targets": pictures(study),
    }


def page(studies: list[Study]) -> str:
    """The whole page of HTML, in one file."""
    return render_page(
        _TEMPLATE,
        preamble=preamble(studies),
        overview=overview(studies),
        studies=[describe_study(study) for study in studies],
    )


def write_page(studies: list[Study], stem: Path) -> None:
    """PAGE.md and PAGE.html."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    for suffix, text in ((".md", markdown(studies)), (".html", page(studies))):
        path = stem.with_name(stem.name + suffix)
        write_text(path, text)
        print(f"{path}: {len(text.encode()) / 1024:.0f} KB")
