"""``python -m benchmarks.results_page RUN [RUN …] --data DATA [-o PAGE]``: the page of results, in Markdown and HTML.

``--studies FILE`` instead of folders makes the page of all that `benchmarks.evaluation` ran.
"""

import argparse
from pathlib import Path

from benchmarks.results_page.page import write_page
from benchmarks.results_page.runs import Study, read_run, read_studies


def main(arguments: list[str] | None = None) -> None:
    """Read the runs, write the pages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.results_page", description=__doc__.split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN", help="folders that 'ipjax evaluate' wrote")
    parser.add_argument("--data", type=Path, help="their data set, for the photos")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from")
    parser.add_argument("--studies", type=Path, metavar="FILE", help="studies.json of benchmarks.evaluation, instead")
    parser.add_argument("-o", "--page", type=Path, default=Path("out/accuracy"), help="without .md, .html")
    options = parser.parse_args(arguments)
    if (options.studies is None) == (not options.runs) or (options.runs and options.data is None):
        parser.error("give folders of results and their --data, or --studies")
    if options.studies is not None:
        studies = read_studies(options.studies)
    else:
        runs = [read_run(folder) for folder in options.runs]
        studies = [Study(runs[0]["dataset"], options.data, options.models, runs)]
    write_page(studies, options.page)


if __name__ == "__main__":
    main()
