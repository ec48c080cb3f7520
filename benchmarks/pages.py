"""Every page of results at one commit: ``python -m benchmarks.pages [PAGE …]``, or ``make results``.

    python -m benchmarks.pages --list                  the pages, and the commands that make each
    python -m benchmarks.pages                         all of them; hours of a machine that does nothing else
    python -m benchmarks.pages accuracy captures       only these

Takes a checkout without changes, so that every page names the commit that made it, and leaves it with the new pages.
What was measured stays in out/pages/COMMIT: killed and called again, finished commands are not run twice and the one
that was cut off goes on, as far as it can. A command that fails is told with the last line of its log, and the
other pages are made all the same. Figures of time want a quiet machine: they come first. GPU pages, which need
another machine, and logs of what was tried are not among them.
"""

import argparse
import dataclasses
import json
import shlex
import subprocess
import sys
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measure import changed_files, commit, describe_device
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text
from ipjax.files.wording import abbreviate

ROOT = Path(__file__).resolve().parents[1]
RESULTS = "benchmarks/results"


@dataclasses.dataclass(frozen=True)
class Page:
    """A page, and the modules of `benchmarks` with their arguments that make it, in order.

    A command is a line of `commands`, and goes on in lines that are indented further. In them ``{out}`` stands for the
    folder of what was measured at this commit, ``{objects}`` for that of object files in it, which are onboarded by the
    first page that wants them, ``{results}`` for that of the pages, ``{data}`` for the data sets', ``{captures}`` for
    ten seeds, and ``{weights}`` for the option that names the encoder's, where they were given.
    """

    name: str
    commands: str
    needs: tuple[str, ...] = ()  # of the folder of data sets

    def missing(self, data: Path) -> list[str]:
        """What it needs and the folder of data sets lacks."""
        return [name for name in self.needs if not (data / name).exists()]

    def expand(self, out: Path, data: Path, weights: str | None) -> list[list[str]]:
        """The words of each command, with folders in place."""
        given = {
            "out": [str(out)],
            "objects": [str(out / "objects")],
            "results": [RESULTS],
            "data": [str(data)],
            "captures": [str(seed) for seed in range(5101, 5111)],
            "weights": ["--weights", weights] if weights else [],
        }
        commands: list[list[str]] = []
        for line in textwrap.dedent(self.commands).strip().splitlines():
            words = []
            for word in line.split():
                name = word.strip("{}")
                words += (
                    given[name] if word == f"{{{name}}}" else [word.format(**{k: v[0] for k, v in given.items() if v})]
                )
            if line[0].isspace():
                commands[-1] += words
            else:
                commands.append(words)
        return commands


PAGES = (
    Page(
        "query_cpu_2_cores",
        """
        benchmarks --only query --json {results}/query_cpu_2_cores.json
        benchmarks.table {results}/cpu_2_cores.json {results}/query_cpu_2_cores.json --into README.md
        """,
    ),
    Page(
        "cpu_2_cores",
        """
        benchmarks --json {results}/cpu_2_cores.json
        benchmarks.table {results}/cpu_2_cores.json {results}/query_cpu_2_cores.json --into README.md
        """,
    ),
    Page(
        "grasps",
        """
        benchmarks.grasps {data}/ycbv --studies true physics knowledge {weights} -o {out}/grasps
        benchmarks.grasp_rule {out}/grasps
        benchmarks.grasps {data}/ycbv -o {out}/grasps --page {results}/grasps.md
        """,
        ("ycbv",),
    ),
    Page("hand_eye", "benchmarks.hand_eye --page {results}/hand_eye.md"),
    Page("grasp_planning", "benchmarks.grasp_planning -o {results}/grasp_planning.md"),
    Page("labelling_costs", "benchmarks.labelling_costs --page {results}/labelling_costs.md"),
    Page(
        "labelling",
        """
        benchmarks.labelling throughput --frames 8 {weights} --output {out}/labelling
        benchmarks.labelling run --frames 2000 {weights} --output {out}/labelling
        benchmarks.labelling soak --frames 120 {weights} --output {out}/labelling
        benchmarks.labelling page --output {out}/labelling --page {results}/labelling.md
        """,
    ),
    Page("compiling", "benchmarks.compiling --page {results}/compiling.md"),
    Page("bias", "benchmarks.bias --scenes 200 --frames 24 --page {results}/bias.md"),
    Page(
        "accuracy",
        """
        benchmarks.evaluation {data}/ycbv {data}/dexycb {data}/realsense --levels 0 1 2 3 4 --objects {objects}
          {weights} -o {out}/evaluation --page {results}/accuracy --reconstruction {data}/dexycb 5
          {data}/dexycb/instantmesh_mustard.obj {data}/dexycb/instantmesh_mustard_to_obj_000005.json
        """,
        ("ycbv", "dexycb", "realsense"),
    ),
    Page(
        "ablation",
        """
        benchmarks.ablation {data}/ycbv {data}/dexycb --levels 0 2 3 --objects {objects} {weights} -o {out}/ablation
          --page {results}/ablation.md
        """,
        ("ycbv", "dexycb"),
    ),
    Page(
        "reconstructions",
        """
        benchmarks.reconstructions made {weights} -o {out}/reconstructions
        benchmarks.reconstructions real --data {data} {weights} -o {out}/reconstructions
        benchmarks.reconstructions page -o {out}/reconstructions --page {results}/reconstructions.md
        """,
        ("lrm", "ycbv", "dexycb", "realsense"),
    ),
    Page(
        "photos_rgb",
        """
        benchmarks.photo_pairs synthetic --pairs 200 --data {data}/ycbv --methods rgb --directions 1 --rolls 1 {weights}
          --output {out}/synthetic_pairs.jsonl
        benchmarks.photo_pairs ycbv --data {data}/ycbv --methods rgb --directions 1 --rolls 1 {weights}
          --output {out}/ycbv_pairs.jsonl
        benchmarks.photo_pairs across --data {data}/ycbv --others {data}/dexycb {data}/realsense --methods rgb
          --directions 1 --rolls 1 {weights} --output {out}/pairs_across.jsonl
        benchmarks.photo_pairs table {out}/synthetic_pairs.jsonl {out}/ycbv_pairs.jsonl {out}/pairs_across.jsonl
          --page {results}/photos_rgb.md
        """,
        ("ycbv", "dexycb", "realsense"),
    ),
    Page(
        "photos",
        """
        benchmarks.photo_pairs synthetic --pairs 200 --data {data}/ycbv --methods rgbd scan {weights}
          --output {out}/synthetic_photos.jsonl
        benchmarks.photo_pairs table {out}/synthetic_photos.jsonl --page {results}/photos.md
        """,
        ("ycbv",),
    ),
    Page(
        "confidence",
        """
        benchmarks.photo_pairs synthetic --queries 5 --pairs 100 --methods rgbd rgb scan level2 level3 {weights}
          --output {out}/confidence.jsonl
        benchmarks.calibration {out}/confidence.jsonl --page {results}/confidence
        """,
    ),
    Page(
        "shapes",
        """
        benchmarks.photo_shapes made --data {data}/ycbv --seed 2 --output {out}/shapes.jsonl
        benchmarks.photo_shapes real --data {data} --output {out}/shapes.jsonl
        benchmarks.photo_shapes page --output {out}/shapes.jsonl --page {results}/shapes.md
        """,
        ("lrm", "ycbv", "dexycb"),
    ),
    Page(
        "focal",
        "benchmarks.photo_focal --data {data}/ycbv {weights} --output {out}/focal.jsonl --page {results}/focal.md",
        ("ycbv",),
    ),
    Page(
        "proposals",
        "benchmarks.proposals {data}/ycbv {data}/dexycb --page {results}/proposals.md",
        ("ycbv", "dexycb"),
    ),
    Page(
        "detection",
        """
        benchmarks.detection {data}/ycbv --objects {objects} {weights} --output {out}/detection
          --page {results}/detection.md
        """,
        ("ycbv",),
    ),
    Page(
        "searches",
        """
        benchmarks.searches hints {data}/ycbv --images 4 --objects {objects} {weights} --output {out}/searches
        benchmarks.searches hints {data}/dexycb --models {data}/ycbv --objects {objects} {weights}
          --output {out}/searches
        benchmarks.searches instances {data}/ycbv --only 2 5 15 --objects {objects} {weights} --output {out}/searches
        benchmarks.searches masks {data}/ycbv --images 7 --objects {objects} {weights} --output {out}/searches
        benchmarks.searches page --output {out}/searches --page {results}/searches.md
        """,
        ("ycbv", "dexycb"),
    ),
    Page(
        "captures",
        """
        benchmarks.captures poses --seeds {captures} --output {out}/captures.jsonl
        benchmarks.captures poses --real {data}/captures --output {out}/captures.jsonl
        benchmarks.captures refine --seeds {captures} --output {out}/captures.jsonl
        benchmarks.captures refine --real {data}/captures --output {out}/captures.jsonl
        benchmarks.captures page --output {out}/captures.jsonl --page {results}/captures.md
        """,
        ("captures",),
    ),
    Page(
        "capture_depth",
        """
        benchmarks.captures depth --seeds {captures} --output {out}/capture_depth.jsonl
        benchmarks.captures depth --real {data}/captures --output {out}/capture_depth.jsonl
        benchmarks.captures page --output {out}/capture_depth.jsonl --page {results}/capture_depth.md
        """,
        ("captures",),
    ),
    Page(
        "capture_models",
        """
        benchmarks.capture_models measure {captures} -o {out}/capture_models.jsonl
        benchmarks.capture_models page {out}/capture_models.jsonl --page {results}/capture_models.md
        """,
    ),
    Page(
        "capture_views",
        """
        benchmarks.capture_views measure 5301 5302 5303 --views 16 --size 320 240 -o {out}/capture_views.jsonl
        benchmarks.capture_views page {out}/capture_views.jsonl --page {results}/capture_views.md
        """,
    ),
)


def main() -> int:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pages", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="only these; default: all")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the data sets")
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("--list", action="store_true", help="list the pages and their commands, and end")
    options = parser.parse_args()
    known = {page.name: page for page in PAGES}
    if unknown := [name for name in options.pages if name not in known]:
        parser.error(f"there is no page {', '.join(unknown)}; there are {', '.join(known)}")
    chosen = [known[name] for name in options.pages] or list(PAGES)
    if options.list:
        for page in chosen:
            commands = page.expand(Path("OUT"), options.data, options.weights)
            print(page.name, *(f"    python -m {shlex.join(words)}" for words in commands), sep="\n")
        return 0
    if changed := changed_files():
        parser.error(
            f"files differ from the commit that the pages would name ({abbreviate(changed)}): commit them first"
        )
    out = ROOT / "out" / "pages" / commit()
    print(f"pages of commit {commit()} go to {RESULTS}, what is measured to {out.relative_to(ROOT)}", flush=True)
    print(", ".join(f"{key}: {value}" for key, value in describe_device().items()), flush=True)
    failed = make(chosen, out, options.data, options.weights)
    for line in failed:
        print(line, file=sys.stderr)
    return 1 if failed else 0


def make(pages: Sequence[Page], out: Path, data: Path, weights: str | None) -> list[str]:
    """Make pages, each command once; returns a line for each page that could not be made."""
    out.mkdir(parents=True, exist_ok=True)
    journal = out / "done.json"
    done: dict[str, float] = read_json(journal) if journal.exists() else {}
    failed = []
    for page in pages:
        if lacking := page.missing(data):
            failed.append(f"{page.name}: not made, {data} has no {', '.join(lacking)}")
            continue
        for words in page.expand(out, data, weights):
            key = shlex.join(words)
            if key in done:
                continue
            print(f"{page.name}: python -m {key}", flush=True)
            start = time.perf_counter()
            status, said = run(words)
            log = write_text(out / f"{page.name}.log", "\n".join(said) + "\n")
            if status:
                last = next((line for line in reversed(said) if line.strip()), "it said nothing")
                failed.append(f"{page.name}: {words[0]} ended with status {status}: {last.strip()} ({log})")
                break
            done[key] = round(time.perf_counter() - start, 1)
            write_text(journal, json.dumps(done, indent=1) + "\n")
            print(f"{page.name}: {done[key]:.0f} s", flush=True)
    return failed


def run(words: Sequence[str]) -> tuple[int, list[str]]:
    """Run a module, its lines shown as they come; its exit status, and the lines."""
    said = []
    with subprocess.Popen(
        [sys.executable, "-m", *words], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line.rstrip("\n"))
            print(f"    {said[-1]}", flush=True)
    return process.returncode, said


if __name__ == "__main__":
    sys.exit(main())
