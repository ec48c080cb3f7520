"""``python -m benchmarks.ablation DATA [--levels 0 2]``: what each step beyond the paper's method is worth.

From the paper's recipe to `Config()`, one step added after the other, on scans and on degraded meshes (``--levels``) or
on a reconstructed one (``--reconstruction``). Settings of each step are written as JSON next to the results, so a step
can be run alone: ``ipjax evaluate DATA --config FILE``. Killed and called again it goes on. Ends with the
two tables of the page: --page benchmarks/results/ablation.md, or table.md in the folder of results.
"""

import json
import sys
from pathlib import Path

from benchmarks import evaluation
from benchmarks.measure import commit, describe_device
from benchmarks.results_page.runs import Study, read_studies
from benchmarks.results_page.tables import markdown_table, median_cells, percent
from ipjax.files.storage.writing import write_text

BY_DEPTH = {"ranking": "render", "power": 0.0, "alternates": 0, "drawn": 0}  # candidates compared by depth alone
TRUSTED = {"settle": False}  # the mesh
STEPS = {
    "01_paper": {"from": "paper"},
    "02_views_by_cosine": {"from": "paper", "match": {"ranking": "cosine", "centred": True, "cycle": 1.5}},
    "03_more_pairs_and_gates": {"refine": {"steps": 0}, "score": {"ranking": "inliers"}},
    "04_chosen_by_depth": {"refine": {"steps": 0}, "score": BY_DEPTH},
    "05_and_by_features": {"refine": {"steps": 0}, "score": {"alternates": 0, "drawn": 0}},
    "06_refined_to_the_depth": {"refine": TRUSTED | {"silhouette_weight": 0.0}, "score": {"alternates": 0, "drawn": 0}},
    "07_and_to_the_outline": {"refine": TRUSTED, "score": {"alternates": 0, "drawn": 0}},
    "08_tried_turned": {"refine": TRUSTED, "score": {"drawn": 0}},
    "09_drawn_again": {"refine": TRUSTED, "score": {"colour_weight": 0.0}},
    "10_and_compared_in_colour": {"refine": TRUSTED},
    "11_proportions_give_way": {"refine": {"forgiveness": 0.0}},
    "12_bumps_are_forgiven": {},  # Config()
}


HEAD = """# What each step beyond the paper is worth

Made by `{command}`; do not edit by hand. Measured on: {device}, {cores} cores, jax {jax}, commit {commit}.

Each row adds one step to the row above, from the paper's recipe to `Config()`. Levels are those of `ipjax degrade`;
given masks, unknown scale; AR in %, with 95 % bootstrap intervals over images. Settings were chosen on the targets of
YCB-V's mini set. The encoder is that of [accuracy.md](accuracy.md).

"""


def main(arguments: list[str] | None = None) -> None:
    """Write the settings, run them all, print the tables."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or "-h" in arguments or "--help" in arguments:
        print(__doc__)
        print(
            "options are those of benchmarks.evaluation, but for --methods; -o defaults to out/ablation, and "
            "--page is a file.md"
        )
        return
    if "--methods" in arguments:
        raise SystemExit("error: --methods is what an ablation is about; see benchmarks.evaluation to choose them")
    folder = Path("out/ablation")
    for flag in ("-o", "--output"):
        if flag in arguments:
            folder = Path(arguments[arguments.index(flag) + 1])
    settings = folder / "settings"
    settings.mkdir(parents=True, exist_ok=True)
    files = []
    for name, changes in STEPS.items():
        files.append(settings / f"{name}.json")
        write_text(files[-1], json.dumps(changes, indent=1) + "\n", parents=True)
    page = folder / "table.md"
    if "--page" in arguments:
        at = arguments.index("--page")
        page = Path(arguments[at + 1])
        del arguments[at : at + 2]
    evaluation.main([*arguments, "-o", str(folder), "--page", str(folder / "page"), "--methods", *map(str, files)])
    text = HEAD.format(
        command=f"python -m benchmarks.ablation {' '.join(arguments)}", commit=commit(), **describe_device()
    )
    text += table(read_studies(folder / "studies.json"))
    write_text(page, text, parents=True)
    print(text)


def table(studies: list[Study]) -> str:
    """Two tables, a row for each step and a column for each study: AR of all frames with its interval, and medians."""
    shares = [["AR, %", *(s.title for s in studies)]]
    medians = [["medians: rotation ° / translation mm / scale %", *shares[0][1:]]]
    for index, run in enumerate(studies[0].runs):
        step = run["method"].removeprefix("ipjax-").replace("_", " ")
        all_of = [study.runs[index] for study in studies]
        frames = [run["all_frames"] for run in all_of]
        shares.append([step, *(percent(f["recalls"].get("ar"), f["intervals"].get("ar")) for f in frames)])
        medians.append([step, *(" / ".join(median_cells(run)) for run in all_of)])
    return "\n".join([*markdown_table(shares), "", *markdown_table(medians)]) + "\n"


if __name__ == "__main__":
    main()
