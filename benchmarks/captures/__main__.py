"""How good the steps from a capture to a data set are.

    python -m benchmarks.captures poses --seeds 101 102 … [--factory 0]    made captures of 24 views
    python -m benchmarks.captures poses --real ../shared/data/captures     those whose poses are known
    python -m benchmarks.captures refine --seeds 201 202 … [--ways global]  the same, and --real
    python -m benchmarks.captures depth --seeds 301 302 …                  depth, by disturbed poses; and --real
    python -m benchmarks.captures page                                     benchmarks/results/captures.md

A line of build/captures.jsonl for each capture and way; lines that are there are not made again.
"""

import argparse
from pathlib import Path

from benchmarks.captures import depth, poses, refinement
from benchmarks.measure import commit, describe_device
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text

STEPS = {"poses": poses, "refine": refinement, "depth": depth}
PAGE = Path("benchmarks/results/captures.md")


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.captures", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=(*STEPS, "page"))
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of made captures")
    parser.add_argument("--views", type=int, default=24, help="of each made capture")
    parser.add_argument("--factory", type=float, default=1.0, help="error of the factory's calibration; 0 = none")
    parser.add_argument("--ways", nargs="*", default=list(refinement.WAYS[:2]), help="refine: how, among all ways")
    parser.add_argument("--real", type=Path, metavar="FOLDER", help="real captures, a folder each")
    parser.add_argument("--output", type=Path, default=Path("build/captures.jsonl"))
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    rows = [parse_json(line) for line in read_lines(options.output)] if options.output.exists() else []
    if options.what != "page":
        state = {**describe_device(), "commit": commit()}
        done = {tuple(row["key"]) for row in rows}
        for row in STEPS[options.what].measure(options, done):
            rows.append({"step": options.what, **row, **state})
            append_json(options.output, rows[-1])
            print(row, flush=True)
    lines = tell(rows)
    print("\n".join(lines))
    if options.what == "page":
        write_text(options.page, "\n".join(lines) + "\n")


def tell(rows: list[dict]) -> list[str]:
    """The page: of each step its tables, and where and at which commits they were measured."""
    lines = ["# From a capture to a data set, step by step", ""]
    lines += ["Made by `python -m benchmarks.captures page`; do not edit by hand.", ""]
    for name, step in STEPS.items():
        mine = [row for row in rows if row["step"] == name]
        if mine:
            states = dict.fromkeys(f"{row['device']}, jax {row['jax']}, commit {row['commit']}" for row in mine)
            lines += [*step.tell(mine), "", f"Measured on: {'; '.join(states)}.", ""]
    return lines[:-1]


if __name__ == "__main__":
    main()
