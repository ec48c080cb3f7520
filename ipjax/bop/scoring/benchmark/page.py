"""A benchmark as one HTML page that needs nothing else: accuracy curves, and every figure by object with bars."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipjax import metrics
from ipjax.bop.scoring.benchmark.figures import RECALLS, THRESHOLDS, Entry, Figures
from ipjax.bop.scoring.benchmark.participants import Benchmark
from ipjax.bop.scoring.benchmark.tables import DEFINITIONS, HEADS, SECONDS, SHARES, list_rows
from ipjax.bop.scoring.tables import percent
from ipjax.files.pages import render_page
from ipjax.files.storage.writing import write_text

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
# Told apart by people of all colour visions (Okabe and Ito), in this order; then again, dashed.
_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
_DASHES = ("none", "7 4", "2 3")
_LEFT, _TOP, _WIDTH, _HEIGHT = 38.0, 10.0, 420.0, 230.0  # of a plot, in SVG units


@dataclass(frozen=True)
class _Kind:
    """A figure as it is shown: its value, its words, what a full bar is, and which value is the best."""

    title: str
    value: Callable[[Figures], float | None]
    words: Callable[[float], str]
    full: float
    best: Callable[[Sequence[float]], float]


def write_page(found: Benchmark, path: str | Path) -> Path:
    """`render_benchmark` as a file, whole or not at all."""
    return write_text(path, render_benchmark(found), parents=True)


def render_benchmark(found: Benchmark) -> str:
    """The page: for each data set a plot of ADD and one of ADD-S; the means; and a table for each figure."""
    kinds = _list_kinds(found)
    means = [
        {"name": kind.title, "cells": _cells(found, kind, [entry.mean for entry in found.entries])} for kind in kinds
    ]
    tables = []
    for kind in kinds:
        columns = [dict(list_rows(entry, found.objects())) for entry in found.entries]
        rows = [
            {"name": name, "cells": _cells(found, kind, [column[name] for column in columns]), "sum": name == "mean"}
            for name in columns[0]
        ]
        tables.append({"title": kind.title, "rows": rows})
    return render_page(
        _TEMPLATE,
        title=", ".join(found.participants),
        lead=", ".join(f"{title}: {found.of(title)[0].all.targets} targets" for title in found.datasets),
        participants=[{"name": name, **_stroke(number)} for number, name in enumerate(found.participants)],
        datasets=found.datasets,
        notes=found.all_notes(),
        plots=[
            {"title": f"{name} on {title}", **_plot(found.of(title), curve, area)}
            for title in found.datasets
            for name, curve, area in (("ADD", "add_curve", "auc_add"), ("ADD-S", "add_s_curve", "auc_add_s"))
        ],
        means=means,
        tables=tables,
        definitions=DEFINITIONS,
    )


def _list_kinds(found: Benchmark) -> list[_Kind]:
    """The figures that there are, in the order of the page."""

    def share(title: str, value: Callable[[Figures], float | None]) -> _Kind:
        return _Kind(f"{title} (%)", value, percent, 1.0, max)

    kinds = [share(title, lambda one, key=key: getattr(one, key)) for key, title in SHARES.items()]
    for name in RECALLS:
        if any(name in entry.all.recalls for entry in found.entries):
            kinds.append(share(f"BOP's {HEADS[name]}", lambda one, name=name: one.recalls.get(name)))
    shown = [one for entry in found.entries for _, one in list_rows(entry) if one is not None]
    longest = max((one.seconds for one in shown if one.seconds is not None), default=None)
    if longest is not None:
        kinds.append(_Kind(SECONDS, lambda one: one.seconds, lambda x: f"{x:.2f}", longest or 1.0, min))
    return kinds


def _cells(found: Benchmark, kind: _Kind, line: Sequence[Figures | None]) -> list[dict[str, Any]]:
    """One cell for each entry: words, the width of its bar, and whether it is the best on its data set."""
    values = [None if one is None else kind.value(one) for one in line]
    cells, count = [], len(found.participants)
    for number, value in enumerate(values):
        first = number // count * count
        rivals = [x for x in values[first : first + count] if x is not None]
        cells.append(
            {
                "words": "–" if value is None else kind.words(value),
                "width": "0" if value is None else f"{100 * value / kind.full:.1f}",
                "best": len(rivals) > 1 and value == kind.best(rivals) and min(rivals) < max(rivals),
                "colour": _stroke(number % count)["colour"],
                "first": number == first,
            }
        )
    return cells


def _plot(entries: Sequence[Entry], curve: str, area: str) -> dict[str, Any]:
    """The share of all instances with a smaller error, over the threshold, of each participant: SVG units."""
    across = lambda x: _LEFT + _WIDTH * x / metrics.ADD_LIMIT
    up = lambda share: _TOP + _HEIGHT * (1 - share)
    return {
        "left": _LEFT,
        "right": _LEFT + _WIDTH,
        "top": _TOP,
        "bottom": _TOP + _HEIGHT,
        "rules": [{"y": up(tenths / 100), "label": str(tenths)} for tenths in range(0, 101, 20)],
        "ticks": [{"x": across(cm / 100), "label": f"{cm} cm"} for cm in range(0, 11, 2)],
        "grasp": across(metrics.GRASP_LIMIT),
        "curves": [
            {
                "name": entry.participant,
                "area": percent(getattr(entry.all, area)),
                "points": " ".join(
                    f"{across(x):.1f},{up(share):.1f}"
                    for x, share in zip(THRESHOLDS.tolist(), getattr(entry, curve), strict=True)
                ),
                **_stroke(number),
            }
            for number, entry in enumerate(entries)
        ],
    }


def _stroke(number: int) -> dict[str, str]:
    return {
        "colour": _COLOURS[number % len(_COLOURS)],
        "dash": _DASHES[number // len(_COLOURS) % len(_DASHES)],
    }
