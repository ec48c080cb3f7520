"""``python -m benchmarks [--only NAME] [--json FILE] [--quick]``: measure on this machine, print the table."""

import argparse
import json
import time
from pathlib import Path

from benchmarks.measure import describe_device
from benchmarks.table import render


def benchmarks():
    """Name → function of ``quick`` that yields rows."""
    from benchmarks import geometry, neighbours, stages

    return {
        "neighbours": neighbours.rows,
        "umeyama": geometry.umeyama_rows,
        "consensus": geometry.consensus_rows,
        "estimate": stages.rows,
    }


def main():
    available = benchmarks()
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", choices=list(available), action="append", help="measure this one; may be repeated")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results here")
    parser.add_argument("--quick", action="store_true", help="small sizes, few runs: does it work?")
    options = parser.parse_args()
    results = {**describe_device(), "date": time.strftime("%Y-%m-%d"), "quick": options.quick, "rows": []}
    for name, rows in available.items():
        if options.only and name not in options.only:
            continue
        for row in rows(options.quick):
            results["rows"].append({key: float(x) if hasattr(x, "dtype") else x for key, x in row.items()})
            print(f"{row['name']}: {row['implementation']}, {row['size']}, {row['dtype']}", flush=True)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
    print("\n" + render(results))


main()
