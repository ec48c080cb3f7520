"""``python -m benchmarks.evaluation DATA [DATA …]``: every method on every data set, and the page of results.

In one process, for each data set in BOP layout and each quality of its meshes: `Config.paper()`, `Config()`, and the
classical baseline where Open3D is installed, on the annotated masks. Objects are onboarded once, into the cache or the
folder that --objects names; the methods share what was loaded and described. Results stay under --output: killed and
called again it goes on, and results of another state of the code or of other settings are made anew. Ends with the
page (see `benchmarks.results_page`), in Markdown and HTML: ``make results`` lets it be benchmarks/results/accuracy.md.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from benchmarks.classical import Classical, import_open3d, read_bodies
from benchmarks.results_page.page import write_page
from benchmarks.results_page.runs import read_studies
from ipjax.bop.dataset import Dataset
from ipjax.bop.estimator import DatasetEstimator
from ipjax.bop.evaluation import evaluate
from ipjax.bop.objects import parse_numbered, prepare_objects
from ipjax.bop.records import DatasetError
from ipjax.bop.scoring.summaries import Score
from ipjax.bop.scoring.tables import format_score
from ipjax.files.settings import read_config
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.compilation_cache import use_compilation_cache

METRICS = ("mssd", "mspd", "vsd", "add", "add_s")
# Where a data set's own notes doubt an annotation: reported with and without.
DOUBTFUL = {"ycbv": [(3, 138)]}
QUALITIES = {0: "scans"} | {level: f"meshes degraded to level {level}" for level in range(1, 5)}


def lacks_open3d() -> str:
    """Why the classical baseline cannot run; empty where it can."""
    try:
        import_open3d()
    except SystemExit as reason:
        return str(reason)
    return ""


def doubtful(dataset: Dataset) -> list[tuple[int, int]]:
    """Its target images whose annotation is known to be off."""
    there = {(t.scene_id, t.im_id) for t in dataset.targets}
    return [image for image in DOUBTFUL.get(dataset.name, []) if image in there]


class Study:
    """One data set and one set of meshes; its methods, run one after another."""

    def __init__(self, title: str, dataset: Dataset, folder: Path, options: argparse.Namespace, **meshes: Any):
        self.title, self.dataset, self.folder, self.options, self.meshes = title, dataset, folder, options, meshes
        self.loaded: DatasetEstimator | None = None  # with its objects, for all methods

    @property
    def objects(self) -> list[int] | None:
        """What is asked for; of a reconstruction, its object alone."""
        return list(self.meshes["meshes"]) if "meshes" in self.meshes else self.options.only

    def run(self, encoder: Any, methods: list[str]) -> list[Path]:
        """The folders of results, in the order of the methods."""
        print(f"\n== {self.title}", flush=True)
        scores: list[Score] = []
        folders = []
        for method in methods:
            start = time.perf_counter()
            folder = self.folder / Path(method).stem
            estimator, objects, name = self.estimator(encoder, method)
            found = evaluate(
                self.dataset,
                objects,
                estimator,
                folder,
                method=name,
                settings=estimator.settings(),
                alignments=estimator.alignments,
                aligned_by=estimator.aligned_by,
                metrics=METRICS,
                on_error="skip",
                progress=not self.options.quiet,
                against=scores[0] if scores else None,
                without=doubtful(self.dataset),
                restart="changed",
            )
            scores.append(found)
            folders.append(folder)
            print(f"\n{format_score(found)}\n({time.perf_counter() - start:.0f} s)", flush=True)
            for line in estimator.refused:
                print(f"not found: {line}")
        return folders

    def estimator(self, encoder: Any, method: str) -> tuple[Any, list[int], str]:
        """What runs, on which objects, and the name in the tables."""
        seed = self.options.seed
        if method == "classical":
            bodies = read_bodies(self.dataset, objects=self.objects, **self.meshes)
            return Classical(bodies, seed=seed), list(bodies), "classical"
        config = read_config(method)
        if self.loaded is None:
            objects = prepare_objects(
                self.dataset,
                encoder,
                folder=self.options.objects,
                objects=self.objects,
                progress=not self.options.quiet,
                **self.meshes,
            )
            estimator = self.loaded = DatasetEstimator(objects, encoder, config, seed=seed, share=True)
        else:
            estimator = self.loaded.with_config(config)
        return estimator, list(estimator.objects), f"ipjax-{Path(method).stem}"


def plan(options: argparse.Namespace) -> list[Study]:
    """What is asked for, checked before anything takes time."""
    datasets: dict[Path, Dataset] = {}
    models: Path | None = options.models
    for root in options.data:
        own = (root / "models").is_dir()
        if own and models is None:
            models = root
        if not own and models is None:
            raise DatasetError(
                f"{root}: it has no models; name them with --models, or name a data set with models first"
            )
        datasets[root] = Dataset(root, models=None if own else models)
    found = []
    for dataset in datasets.values():
        for level in options.levels:
            title = f"{dataset.name}, {QUALITIES[level]}"
            folder = options.output / dataset.name / (f"level{level}" if level else "scans")
            found.append(Study(title, dataset, folder, options, quality=level))
    for root, number, mesh, alignment in options.reconstruction or ():
        if Path(root) not in datasets:
            raise DatasetError(f"--reconstruction {root}: name the data set itself too")
        dataset, path = datasets[Path(root)], Path(mesh)
        given = parse_numbered([f"{number}={mesh}"], "--reconstruction")
        aligned = parse_numbered([f"{number}={alignment}"], "--reconstruction")
        title, folder = f"{dataset.name}, object {number} from {path.name}", options.output / dataset.name / path.stem
        found.append(Study(title, dataset, folder, options, meshes=given, alignments=aligned))
    return found


def main(arguments: list[str] | None = None) -> None:
    """Run what is missing, print the tables, write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.evaluation", description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, nargs="+", metavar="DATA", help="in BOP layout")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/evaluation"), help="folder of all results")
    parser.add_argument(
        "--methods", nargs="+", default=["paper", "default", "auto"], metavar="paper|fast|default|classical|FILE"
    )
    parser.add_argument(
        "--levels",
        type=int,
        nargs="*",
        default=[0],
        choices=range(5),
        help="qualities of the meshes; none: only --reconstruction",
    )
    parser.add_argument(
        "--reconstruction",
        nargs=4,
        action="append",
        metavar=("DATA", "N", "MESH", "JSON"),
        help="a reconstructed mesh of object N and its similarity to the model (for evaluation only)",
    )
    parser.add_argument(
        "--models", type=Path, help="for data sets without: another one (default: the first with models)"
    )
    parser.add_argument(
        "--objects", type=Path, help="folder of object files; missing ones are added (default: the cache)"
    )
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="only these objects")
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    parser.add_argument("--page", type=Path, default=Path("out/accuracy"), help="the page, without .md, .html")
    options = parser.parse_args(arguments)
    if not options.levels and not options.reconstruction:
        parser.error("--levels names none and there is no --reconstruction: nothing to evaluate")
    methods = [m for m in options.methods if m != "auto"]
    reason = lacks_open3d() if {"auto", "classical"} & set(options.methods) else ""
    if reason and "classical" in methods:
        raise SystemExit(reason)
    if "auto" in options.methods and reason:
        print(f"left out: {reason}")
    elif "auto" in options.methods:
        methods.append("classical")
    start = time.perf_counter()
    try:
        planned = plan(options)
        for method in methods:
            if method != "classical":
                read_config(method)
        use_compilation_cache()
        encoder = None
        if any(method != "classical" for method in methods):
            encoder = load_encoder(options.weights)
            print(f"encoder: {encoder.identity}")
        manifest = []
        for study in planned:
            folders = study.run(encoder, methods)
            manifest.append(
                {
                    "title": study.title,
                    "data": str(study.dataset.root),
                    "models": str(study.dataset.models_root),
                    "runs": [str(folder) for folder in folders],
                }
            )
            study.loaded = None  # its templates are large
        write_text(options.output / "studies.json", json.dumps(manifest, indent=1), parents=True)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    write_page(read_studies(options.output / "studies.json"), options.page)
    print(f"{time.perf_counter() - start:.0f} s in all")


if __name__ == "__main__":
    main()
