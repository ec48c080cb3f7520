"""``python -m benchmarks.table results.json … [--into README.md]``: results as Markdown.

All rows are written next to each results file (``results.md``). With ``--into`` the main ones replace the text
between ``<!-- benchmarks -->`` and ``<!-- /benchmarks -->`` of that file.
"""

import argparse
from pathlib import Path

from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text

BEGIN, END = "<!-- benchmarks -->", "<!-- /benchmarks -->"
COLUMNS = {
    "what": lambda row: row["name"],
    "how": lambda row: row["implementation"],
    "size": lambda row: row["size"],
    "dtype": lambda row: row["dtype"],
    "median": lambda row: milliseconds(row.get("median_ms")),
    "fastest": lambda row: milliseconds(row.get("fastest_ms")),
    "quartiles": lambda row: (
        f"{milliseconds(row['quartile_1_ms'])} – {milliseconds(row['quartile_3_ms'])}" if "quartile_1_ms" in row else ""
    ),
    "compile": lambda row: f"{row['compile_s']:.2g} s" if "compile_s" in row else "",
    "temporary": lambda row: f"{row['temporary_bytes'] / 2**20:.3g} MiB" if "temporary_bytes" in row else "",
    "GFLOP/s": lambda row: f"{row['gflop_per_s']:.0f}" if "gflop_per_s" in row else "",
    "ratio": lambda row: ratio(row),
}


SHORT = ("what", "how", "size", "median", "compile", "temporary", "ratio")
SIZES = ("400 × 256² × 384", "50 × 576² × 384", "25 × 900² × 384")


def is_headline(row: dict) -> bool:
    """Whether a row is a main one; of "neighbours" only the kernel, its product and einsum, float32, at three sizes."""
    if row["name"] != "neighbours":
        return True
    plain = row["implementation"] in ("product, view by view", "nearest (xla)", "einsum + argmax")
    return plain and row["size"] in SIZES and row["dtype"] == "float32"


def render(results: dict, short: bool = False) -> str:
    """One device's results as a heading and a table, of all rows or the main ones; ``results["stale"]`` says
    what has changed since, where something has."""
    columns = {name: cell for name, cell in COLUMNS.items() if not short or name in SHORT}
    rows = [row for row in results["rows"] if not short or is_headline(row)]
    lines = [
        f"**{results['device']}** ({results['platform']}, {results['cores']} cores), jax {results['jax']}, "
        f"Python {results['python']}, {results['date']}, commit {results.get('commit', 'unknown')}"
        + (" — quick run, small sizes" if results["quick"] else ""),
        *([f"\n**Stale**: {results['stale']}"] if "stale" in results else []),
        *(
            []
            if short
            else ["\nMeasured by `python -m benchmarks --json FILE`, written by `python -m benchmarks.table FILE`."]
        ),
        "",
        "| " + " | ".join(columns) + " |",
        "|" + " --- |" * len(columns),
    ]
    lines += ["| " + " | ".join(cell(row) for cell in columns.values()) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def milliseconds(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3g} ms" if value < 1000 else f"{value / 1000:.3g} s"


def ratio(row: dict) -> str:
    if "ratio_to_product" in row:
        return f"{row['ratio_to_product']:.2f} × product, {row['ratio_to_large_product']:.2f} × large product"
    if "ratio_to_kernel" in row:
        return f"{row['ratio_to_kernel']:.3g} × kernel"
    if "queries_per_s" in row:
        return f"{row['queries_per_s']:.3g} queries/s"
    return f"{100 * row['disagreement']:.2g} %" if "disagreement" in row else ""


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.table", description=__doc__)
    parser.add_argument("results", type=Path, nargs="+")
    parser.add_argument("--into", type=Path, metavar="FILE")
    options = parser.parse_args()
    found = {path: read_json(path) for path in options.results}
    if options.into is None:
        print("\n".join(render(results) for results in found.values()))
        return
    text = "\n".join(render(results, short=True) for results in found.values())
    page = options.into.read_text()
    if BEGIN not in page or END not in page:
        parser.error(f"{options.into} has no {BEGIN} … {END}")
    for path, results in found.items():
        write_text(path.with_suffix(".md"), render(results))
    before, rest = page.split(BEGIN, 1)
    write_text(options.into, before + BEGIN + "\n" + text + END + rest.split(END, 1)[1])


if __name__ == "__main__":
    main()
