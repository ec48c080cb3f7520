"""``ipjax evaluate``: estimate every target of a BOP data set, and score the result."""

import argparse
import re
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax evaluate ycbv/ -o results/default
  ipjax evaluate ycbv/ -o results/paper --config paper --against results/default/ipjax-default_ycbv-test.csv
  ipjax evaluate ycbv/ -o results/four_views --set match.views=4
  ipjax evaluate ycbv/ -o results/cnos --detections cnos_ycbv-test.json      on other people's masks
  ipjax evaluate ycbv/ -o results/sought --detect               without masks: objects are sought in the whole frame
  ipjax evaluate ycbv/ -o results/level2 --mesh-quality 2        on meshes made worse; see 'ipjax degrade'
  ipjax evaluate dexycb/ -o results/mustard --models ycbv/ --only 5 \\
      --mesh 5=instantmesh_mustard.obj --alignment 5=instantmesh_mustard_to_obj_000005.json

Objects are onboarded from the data set's models/ where that has not been done yet, and kept: in your cache, shared by
all configurations, or in the folder that --objects names.
Stop it at any moment and call it again: finished images are not done twice. Results of other settings, or of another
state of the code, are not continued; --restart begins anew.
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands,
        "evaluate",
        run,
        "estimate every target of a BOP data set with its annotated masks or detections, and score the result",
        EXAMPLES,
    )
    options.add_dataset(parser)
    parser.add_argument(
        "--objects",
        metavar="auto|FOLDER",
        default="auto",
        help="object files named by number (obj_000001.ipjax); missing ones are added (default: the cache)",
    )
    options.add_output(parser, "RESULTS", "folder for the results", required=True)
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="only these objects")
    options.add_config(parser)
    parser.add_argument(
        "--mesh-quality", type=int, default=0, choices=range(5), help="degrade the models first: 1 … 4 (default 0: not)"
    )
    parser.add_argument("--mesh", action="append", metavar="N=FILE", help="a mesh of your own for object N")
    parser.add_argument(
        "--alignment", action="append", metavar="N=JSON", help="its similarity to the model: scale, R, t; to score it"
    )
    parser.add_argument(
        "--detections",
        type=Path,
        metavar="FILE",
        help="masks to use: BOP's JSON, npz of CNOS or SAM-6D, or a folder of such (default: the annotated ones)",
    )
    parser.add_argument(
        "--detect",
        nargs="?",
        const="targets",
        choices=("targets", "all"),
        help="use no masks: seek the objects that the targets name, or all of them in every image (as where they name "
        "none); also writes detections.json, masks and boxes",
    )
    parser.add_argument("--known-size", action="store_true", help="tell the method each object's true diameter")
    options.add_crop(parser)
    options.add_scoring(
        parser, options.METRICS[:5], "all but the last", "count damaged images as misses, instead of stopping"
    )
    options.add_views(parser, "new object files")
    options.add_seed(parser)
    parser.add_argument("--restart", action="store_true", help="forget what is in the folder of results")
    options.add_encoder(parser)
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Onboard what is missing, estimate, score and show the table; returns the exit status."""
    options.check_folder(arguments.output)
    options.check_seed(arguments.seed)
    if arguments.detect is not None and arguments.detections is not None:
        raise ValueError("--detect seeks masks, --detections gives them: one of them")
    if arguments.against is not None and not arguments.against.is_file():
        raise ValueError(f"{arguments.against}: no such result file")
    from ipjax.bop.dataset import parse_images
    from ipjax.bop.detections import read_detections
    from ipjax.bop.estimator import DatasetEstimator
    from ipjax.bop.evaluation import evaluate
    from ipjax.bop.objects import parse_numbered, prepare_objects
    from ipjax.bop.scoring.tables import format_score
    from ipjax.config import OnboardConfig
    from ipjax.inference.compilation_cache import use_compilation_cache

    config = options.read_config(arguments)
    meshes = parse_numbered(arguments.mesh, "--mesh")
    alignments = parse_numbered(arguments.alignment, "--alignment")
    dataset = options.open_dataset(arguments)
    detections = None if arguments.detections is None else read_detections(arguments.detections)
    if detections is not None and not any(one.segmentation is not None for one in detections):
        raise ValueError(f"{arguments.detections}: its detections have boxes, but no masks")
    encoder = options.load_encoder(arguments)
    messages.print_notes()
    use_compilation_cache()
    objects = prepare_objects(
        dataset,
        encoder,
        folder=None if arguments.objects == "auto" else arguments.objects,
        objects=arguments.only,
        config=OnboardConfig(**options.read_views(arguments)),
        quality=arguments.mesh_quality,
        seed=arguments.seed,
        meshes=meshes,
        alignments=alignments,
        progress=not arguments.quiet,
    )
    given = {"crop": arguments.crop, "seed": arguments.seed, "known_size": arguments.known_size}
    masks = arguments.output / "detections"
    if arguments.detect is None:
        estimator = DatasetEstimator(objects, encoder, config, **given)
    else:
        from ipjax.bop.detector import DatasetDetector

        # Where the targets do not say what is in an image (BOP 2024), it may be anything.
        everything = arguments.detect == "all" or not dataset.names_objects
        estimator = DatasetDetector(objects, encoder, config, **given, everything=everything, folder=masks)
    found = evaluate(
        dataset,
        list(objects),
        estimator,
        arguments.output,
        method=_method(arguments),
        settings=estimator.settings() | _describe(detections),
        detections=detections,
        alignments=estimator.alignments,
        aligned_by=estimator.aligned_by,
        on_error="skip" if arguments.skip_bad else "raise",
        progress=not arguments.quiet,
        metrics=arguments.metrics,
        against=arguments.against,
        without=parse_images(arguments.without),
        restart="always" if arguments.restart else "never",
    )
    if arguments.detect is not None:
        from ipjax.bop.detector import join_detections
        from ipjax.bop.evaluation import targets_of

        join_detections(masks, arguments.output / "detections.json", targets_of(dataset, list(objects)))
    messages.say(format_score(found))
    for line in estimator.refused:
        messages.say(f"not found: {line}")
    messages.finish({**found.to_dict(), "not_found": estimator.refused})
    return 0


def _describe(detections: list[Any] | None) -> dict[str, Any]:
    """What a resumed run must agree in, of detections."""
    if detections is None:
        return {}
    import hashlib

    content = repr([(*vars(one).values(),) for one in detections])
    return {"detections": hashlib.sha256(content.encode()).hexdigest()}


def _method(arguments: argparse.Namespace) -> str:
    """What the results are called: all that was not the default, in words that a file name may have."""
    chosen = (Path(arguments.config).stem, *arguments.changes)
    parts = ["ipjax", *(re.sub(r"[^\w.]+", "-", words) for words in chosen)]
    if arguments.detections is not None:
        parts.append(re.sub(r"[^\w.]+", "-", arguments.detections.name.split(".")[0]))
    if arguments.detect is not None:
        parts.append("sought" if arguments.detect == "targets" else "sought-all")
    if arguments.mesh_quality:
        parts.append(f"level{arguments.mesh_quality}")
    if arguments.known_size:
        parts.append("known-size")
    return "-".join(parts)
