"""``ipjax score``: how good are the poses, or the detections, in BOP result files?"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax score results/ipjax_ycbv-test.csv ycbv/
  ipjax score mine.csv yours.csv theirs.csv ycbv/ --csv table.csv --page table.html      side by side
  ipjax score real/a.csv real/b.csv captured/ --beside made/a.csv made/b.csv rendered/ \\
      --names A B --titles real synthetic                                           real against synthetic
  ipjax score mine.csv ycbv/ --beside mine_pbr.csv ycbv/train_pbr/                   another split of a data set
  ipjax score mine.csv ycbv/ --metrics mssd mspd --against other.csv -o score.json
  ipjax score mine.csv ycbv/ --json | jq .all_frames.recalls
  ipjax score mine.csv ycbv/ --metrics ap --targets test_targets_bop24.json         6-D detection
  ipjax score detections_ycbv-test.json ycbv/                                       2-D detection: boxes and masks

Poses are CSVs, detections JSON (also .json.gz), npz of CNOS or SAM-6D, or a folder of such.

Of poses it tells BOP's recalls (--metrics) and, for each object, their mean and all targets: the areas under the
accuracy curves of ADD and ADD-S from 0 to 10 cm (exact; PoseCNN), the shares with ADD-S below 2 cm (DenseFusion) and
within 5° and 5 cm (of the symmetric poses, the one whose rotation is nearest counts), and the files' seconds for an
image. What a file lacks counts as infinitely wrong. On several data sets every participant has a file for each.

Of detections it tells COCO's average precisions (IoU 0.5 … 0.95) of boxes and of masks; what is less than a tenth
visible need not be found.
"""

DETECTIONS = (".json", ".gz", ".npz")


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands, "score", run, "score BOP result files against the annotations of a BOP data set", EXAMPLES
    )
    parser.add_argument(
        "results",
        type=Path,
        metavar="FILE",
        nargs="+",
        help="CSV of scene_id,im_id,obj_id,score,R,t,time (t in mm), or several, side by side; or JSON of detections",
    )
    options.add_dataset(parser)
    parser.add_argument(
        "--beside",
        type=Path,
        nargs="+",
        action="append",
        default=[],
        metavar=("CSV", "CSV … FOLDER"),
        help="the same participants, in the same order, on another data set, or on the split whose folder is given; "
        "once for each",
    )
    parser.add_argument(
        "--names", nargs="+", metavar="NAME", help="of the participants (default: of their files, less _DATASET-SPLIT)"
    )
    parser.add_argument("--titles", nargs="+", metavar="TITLE", help="of the data sets (default: NAME-SPLIT)")
    parser.add_argument(
        "--sizes",
        type=Path,
        metavar="CSV",
        help="its rows with a column scale, estimated over true size (default: CSV's .sized, if it is there)",
    )
    options.add_scoring(parser, None, "the first three", "leave damaged rows out and say so, instead of stopping")
    parser.add_argument(
        "--modal", action="store_true", help="of detections: boxes are of what is visible, not of whole silhouettes"
    )
    options.add_output(parser, "JSON", "also write the score, with every instance")
    parser.add_argument("--csv", type=Path, metavar="CSV", help="also write the figures by object as a table")
    parser.add_argument("--page", type=Path, metavar="HTML", help="also write them, with accuracy curves, as a page")
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Score and show the tables; returns the exit status."""
    _check_outputs(arguments)
    if arguments.dataset.is_file():
        raise ValueError(f"{arguments.dataset} is a file: the last word is the folder of the data set")
    dataset = options.open_dataset(arguments)
    if any(path.suffix.lower() in DETECTIONS or path.is_dir() for path in arguments.results):
        return _score_detections(dataset, arguments, messages)
    if arguments.modal:
        raise ValueError("--modal belongs to detections, not to poses")
    groups = [(dataset, arguments.results), *(_open_beside(words, arguments.models) for words in arguments.beside)]
    several = len(groups) > 1 or len(arguments.results) > 1
    for name in ("against", "sizes"):
        if several and getattr(arguments, name):
            raise ValueError(f"--{name} belongs to one result file; several are compared without it")
    if len(groups) > 1 and arguments.without:
        raise ValueError("--without belongs to one data set, and names its images")
    from ipjax.bop.dataset import parse_images
    from ipjax.bop.scoring.benchmark.participants import compare
    from ipjax.bop.scoring.benchmark.tables import format_benchmark, write_csv
    from ipjax.bop.scoring.tables import format_score
    from ipjax.inference.compilation_cache import use_compilation_cache

    use_compilation_cache()
    found = compare(
        groups,
        arguments.metrics or options.METRICS[:3],
        names=arguments.names,
        titles=arguments.titles,
        against=arguments.against,
        sizes=True if arguments.sizes is None else arguments.sizes,
        on_error="skip" if arguments.skip_bad else "raise",
        progress=sys.stderr.isatty(),
        without=parse_images(arguments.without),
    )
    scores = [entry.score for entry in found.entries]
    if not several:
        messages.say(format_score(scores[0]) + "\n")
    messages.say(format_benchmark(found))
    document: dict[str, Any] = {"scores": [one.to_dict() for one in scores]} if several else scores[0].to_dict()
    document["benchmark"] = found.to_dict()
    if arguments.output is not None:
        from ipjax.files.storage.writing import write_text

        write_text(arguments.output, json.dumps(document, indent=1))
    if arguments.csv is not None:
        write_csv(found, arguments.csv)
    if arguments.page is not None:
        from ipjax.bop.scoring.benchmark.page import write_page

        write_page(found, arguments.page)
    messages.finish(document)
    return 0


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse what cannot be written, and what would replace the results themselves."""
    given = {path.resolve() for path in (*arguments.results, *(word for words in arguments.beside for word in words))}
    for path, suffixes in (
        (arguments.output, (".json",)),
        (arguments.csv, (".csv",)),
        (arguments.page, (".html", ".htm")),
    ):
        if path is None:
            continue
        options.check_output(path, suffixes)
        if path.resolve() in given or (path.suffix.lower() == ".csv" and _holds_results(path)):
            raise ValueError(f"{path} holds results to be scored, and would be replaced by their table")


def _holds_results(path: Path) -> bool:
    """Whether a file begins as a BOP result file does."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(24).lstrip(b"\xef\xbb\xbf").startswith(b"scene_id,im_id,obj_id")


def _open_beside(words: list[Path], models: Path | None) -> tuple[Any, list[Path]]:
    """A data set and its result files: the last word is its folder, or that of one of its splits."""
    from ipjax.bop.dataset import Dataset

    *files, folder = words
    if not files or folder.is_file():
        raise ValueError(
            f"--beside {' '.join(map(str, words))}: give result files and, as the last word, their data set's folder"
        )
    if folder.is_dir() and any(part.name.isdigit() and len(part.name) == 6 for part in folder.iterdir()):
        folder = folder.resolve()
        kind = folder.name.split("_")[0]
        # The targets of 2024 are those of test images, too; of other splits every visible instance is a target.
        targets = None if kind == "test" else f"{kind}_targets_bop19.json"
        return Dataset(folder.parent, folder.name, models=models, targets=targets), files
    return Dataset(folder, models=models), files


def _score_detections(dataset: Any, arguments: argparse.Namespace, messages: Messages) -> int:
    if len(arguments.results) > 1 or arguments.beside:
        raise ValueError("of detections one file at a time is scored, on one data set")
    results = arguments.results[0]
    for name in ("metrics", "against", "sizes", "without", "names", "titles", "csv", "page"):
        if getattr(arguments, name):
            raise ValueError(f"--{name} belongs to poses; {results} has detections")
    from ipjax.bop.scoring.overlaps import format_detections, score_detections

    found = score_detections(
        results,
        dataset,
        boxes="modal" if arguments.modal else "amodal",
        on_error="skip" if arguments.skip_bad else "raise",
    )
    messages.say(format_detections(found))
    if arguments.output is not None:
        found.write_json(arguments.output)
    messages.finish(found.to_dict())
    return 0
