"""``python -m benchmarks [--only NAME] [--json FILE] [--quick]``: measure on this machine, print the table.

``--json FILE`` keeps the rows: `benchmarks.table` makes the pages benchmarks/results/cpu_2_cores.md and, of those of
``--only query``, query_cpu_2_cores.md from them. Without ``--only``, all but "query", which compiles whole queries for
as long as all others take.
``--trace FOLDER`` writes a profile of warm estimates instead; https://ui.perfetto.dev opens its ``.json.gz``.
"""

import argparse
import json
import time
from pathlib import Path

from benchmarks.measure import commit, describe_device
from benchmarks.table import render
from ipjax.files.storage.writing import write_text


def benchmarks():
    """Name → function of ``quick`` that yields rows."""
    from benchmarks import geometry, neighbours, queries, stages

    return {
        "neighbours": neighbours.rows,
        "baselines": neighbours.baseline_rows,
        "umeyama": geometry.umeyama_rows,
        "consensus": geometry.consensus_rows,
        "estimate": stages.rows,
        "query": queries.rows,
    }


def main():
    available = benchmarks()
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.split("\n")[0])
    only = "measure this one; may be repeated; without it, all but query"
    parser.add_argument("--only", choices=list(available), action="append", help=only)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results here")
    parser.add_argument("--quick", action="store_true", help="small sizes, few runs: does it work?")
    parser.add_argument("--trace", type=Path, metavar="FOLDER", help="write a profile of warm estimates here instead")
    options = parser.parse_args()
    if options.trace:
        from benchmarks.stages import write_trace

        write_trace(options.trace)
        print(*sorted(options.trace.rglob("*.json.gz")))
        return
    begin = time.perf_counter()
    results = {**describe_device(), "date": time.strftime("%Y-%m-%d"), "commit": commit()}
    results |= {"quick": options.quick, "rows": []}
    for name, rows in available.items():
        if name not in (options.only or [known for known in available if known != "query"]):
            continue
        for row in rows(options.quick):
            results["rows"].append({key: float(x) if hasattr(x, "dtype") else x for key, x in row.items()})
            print(f"{row['name']}: {row['implementation']}, {row['size']}, {row['dtype']}", flush=True)
    results["seconds"] = round(time.perf_counter() - begin, 1)
    if options.json:
        write_text(options.json, json.dumps(results, indent=1, ensure_ascii=False) + "\n", parents=True)
    print(f"\n{results['seconds']:.0f} s in all\n\n" + render(results))


main()
