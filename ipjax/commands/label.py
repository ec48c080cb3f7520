"""``ipjax label``: where are the objects in very many frames? Shard by shard, on as many machines as there are."""

import argparse
import re
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.bars import Bars
from ipjax.commands.interface.detection import parse_instances
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command, parse_camera, parse_count

EXAMPLES = """\
examples:
  ipjax label bop/ -o labels/ --objects objects/                       every image of the split test of a BOP data set
  ipjax label shards/ -o labels/ --objects mug.ipjax box.ipjax         tar files: KEY.rgb.jpg, KEY.depth.png …
  ipjax label scene/ -o labels/ --objects mug.ipjax --config fast --previews 50
  ipjax label bop/ -o labels/ --objects objects/ --seek --instances all          without masks: objects are sought
  sbatch --array=0-63 --wrap 'ipjax label bop/ -o labels/ --objects objects/ --shard $SLURM_ARRAY_TASK_ID/64'
  seq 0 7 | xargs -P 8 -I{} ipjax label bop/ -o labels/ --objects objects/ --shard {}/8 --quiet
  ipjax label bop/ -o labels/ --objects objects/ --merge               all shards as one data set: labels/merged/

SOURCE is a BOP data set, scene by scene or image by image; tar files of the latter (webdataset), one or a folder of
them; a folder of frames as 'ipjax estimate --frames' reads it; or a ROS 2 bag with depth aligned to the colours. Where
it has visible masks, these are used, or those of --detections; else, and with --seek, the objects are sought.

Every worker plans the same shards (labels/manifest.json: of what, by which code, weights and settings). Each shard is
labelled by one worker at a time and appears whole: labels/shards/000000/ with labels.csv (BOP's result file), scenes/
(scene_gt.json and the like), coco.json (masks as run lengths), table.parquet or .npz (covariances, confidences),
bad_frames.json and previews/. Killed at any moment, the same command goes on and makes the same files. A frame that
cannot be used is tried twice, listed with the reason, and stops nothing. How long frames took is in labels/logs/.

--merge refuses as long as a shard is missing. It writes labels/merged/: one BOP folder with models (and with --images
colours, depth and masks), coco.json, the table, and quality.html: confidences, poses that jump against their
neighbours, objects in one place, and the frames that a person should look at.
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands, "label", run, "label very many frames in shards that resume, and merge them", EXAMPLES
    )
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the frames")
    options.add_output(parser, "LABELS", "folder of the labels", required=True)
    parser.add_argument(
        "--objects", metavar="FILE|FOLDER", type=Path, nargs="+", required=True, help="object files, or folders of them"
    )
    parser.add_argument(
        "--obj-id",
        type=int,
        metavar="N",
        action="append",
        help="the number of each object in the source and in what is written; one for each object (default: from its "
        "name, obj_00000N, or from 1 on)",
    )
    parser.add_argument("--split", default="test", help="which split (default test)")
    parser.add_argument(
        "--detections",
        type=Path,
        metavar="FILE",
        help="masks to use: BOP's JSON, npz of CNOS or SAM-6D, or a folder of such",
    )
    parser.add_argument("--seek", action="store_true", help="use no masks: seek the objects in the whole frame")
    parser.add_argument(
        "--instances",
        type=parse_instances,
        metavar="N|all",
        default=1,
        help="without masks: how many of each object are sought (default 1)",
    )
    parser.add_argument("--camera", metavar="FILE", help="of a folder of frames that has none: a file, or fx,fy,cx,cy")
    parser.add_argument("--depth-scale", type=float, metavar="S", help="metres per depth unit, e.g. 0.001")
    parser.add_argument(
        "--free-size", action="store_true", help="estimate the size even where the reference photo measured it"
    )
    options.add_crop(parser)
    options.add_config(parser)
    options.add_seed(parser)
    parser.add_argument(
        "--shard",
        type=parse_part,
        metavar="I/N",
        default=(0, 1),
        help="only each N-th shard, from the I-th on (from 0)",
    )
    parser.add_argument(
        "--shard-size", type=parse_count, metavar="N", default=500, help="frames in a shard (default 500)"
    )
    parser.add_argument("--batch", metavar="N", type=parse_count, default=8, help="frames at once (default 8)")
    parser.add_argument(
        "--previews", type=int, metavar="N", default=100, help="draw each N-th frame; 0 = none (default 100)"
    )
    parser.add_argument("--merge", action="store_true", help="merge all shards, instead of labelling")
    parser.add_argument("--images", action="store_true", help="with --merge: write the images, too")
    parser.add_argument("--restart", action="store_true", help="forget the labels that are in the folder")
    options.add_weights(parser)
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Label what is left of a part, or merge; returns the exit status, 1 where no frame could be used."""
    options.check_folder(arguments.output)
    options.check_seed(arguments.seed)
    if arguments.previews < 0:
        raise ValueError(f"--previews is a number from 0 on, not {arguments.previews}")
    if arguments.seek and arguments.detections is not None:
        raise ValueError("--seek uses no masks, --detections gives them: one of them")
    if arguments.merge and arguments.restart:
        raise ValueError("--merge merges the labels that --restart would forget: one of them")
    if arguments.images and not arguments.merge:
        raise ValueError("--images belongs to --merge")
    if arguments.split in ("", "..") or Path(arguments.split).name != arguments.split:
        raise ValueError(f"--split is the name of a folder in the data set, not {arguments.split!r}")
    _check_places(arguments)
    from ipjax.labelling.sources.detections import WithDetections
    from ipjax.labelling.sources.opening import open_source

    paths = list_objects(arguments.objects)
    numbers = number_objects(paths, arguments.obj_id)
    source = open_source(
        arguments.source,
        numbers,
        split=arguments.split,
        use_masks=not arguments.seek and arguments.detections is None,
        camera=None if arguments.camera is None else parse_camera(arguments.camera),
        depth_scale=arguments.depth_scale,
    )
    if arguments.detections is not None:
        most = arguments.instances or 100
        source = WithDetections(source, arguments.detections, numbers, most)
    keys = source.keys()
    if not keys:
        raise ValueError(f"{arguments.source}: it has no frames")
    return (_merge if arguments.merge else _label)(arguments, messages, source, keys, paths, numbers)


def _check_places(arguments: argparse.Namespace) -> None:
    """Refuse to write among what is read: --restart and --merge remove what was there."""
    from ipjax.labelling.merging.merge import MERGED
    from ipjax.labelling.shards.plan import SHARDS, WORK

    given = [arguments.source, *arguments.objects, *filter(None, [arguments.detections])]
    for name in (SHARDS, WORK, MERGED):
        place = (arguments.output / name).resolve()
        for path in given:
            if path.resolve().is_relative_to(place):
                raise ValueError(f"{path}: labels are to be written to {arguments.output / name}: choose another -o")


def _label(
    arguments: argparse.Namespace,
    messages: Messages,
    source: Any,
    keys: Any,
    paths: list[Path],
    numbers: list[int],
) -> int:
    import shutil

    from ipjax.files.objects.loading import load
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.labelling.batch import Labeller
    from ipjax.labelling.outputs.tables import has_parquet
    from ipjax.labelling.records import LabelSettings
    from ipjax.labelling.shards.plan import MANIFEST, SHARDS, WORK, LabelledObject, keep_manifest, make_manifest
    from ipjax.labelling.shards.working import Worker

    config = options.read_config(arguments)
    settings = LabelSettings(
        seed=arguments.seed,
        crop=arguments.crop,
        instances=arguments.instances,
        free_size=arguments.free_size,
    )
    objects = [load(path) for path in paths]
    known = [LabelledObject(n, path, info) for n, path, (_, info) in zip(numbers, paths, objects, strict=True)]
    encoder = _load_encoder(paths, [info.encoder for _, info in objects], arguments.weights)
    manifest = make_manifest(
        source,
        keys,
        known,
        encoder,
        config,
        settings=settings,
        shard_size=arguments.shard_size,
        batch=arguments.batch,
        previews=arguments.previews,
        detections=arguments.detections,
    )
    if arguments.restart and (arguments.output / MANIFEST).is_file():  # else what has these names is not of labels
        for name in (SHARDS, WORK):
            shutil.rmtree(arguments.output / name, ignore_errors=True)
    keep_manifest(arguments.output, manifest, restart=arguments.restart)
    messages.print_notes()
    if not has_parquet():
        messages.note("tables are written as npz: for Parquet, pip install 'ipjax[tables]'")
    use_compilation_cache()
    labeller = Labeller(encoder, objects, config, settings)
    worker = Worker(arguments.output, manifest, source, keys, labeller, known)
    with Bars(quiet=arguments.quiet) as bars:
        report = worker.run(arguments.shard, lambda done, total: bars.show("labelling", done, total))
    for name, reason in report.bad:
        messages.say(f"{name}: not used: {reason}")
    total = report.labelled + report.before + report.elsewhere
    told = f"{report.labelled} of {total} shards labelled now, {report.before} before"
    if report.elsewhere:
        told += f", {report.elsewhere} by other workers that are at it"
    messages.say(f"{arguments.output}: {told}; {report.frames} frames, {len(report.bad)} of them bad")
    bad = [{"frame": name, "reason": reason} for name, reason in report.bad]
    messages.finish(
        {
            "folder": str(arguments.output),
            "shards_labelled": report.labelled,
            "shards_before": report.before,
            "shards_elsewhere": report.elsewhere,
            "frames": report.frames,
            "bad": bad,
        }
    )
    return 1 if report.labelled and len(bad) >= report.frames > 0 else 0


def _merge(
    arguments: argparse.Namespace,
    messages: Messages,
    source: Any,
    keys: Any,
    paths: list[Path],
    numbers: list[int],
) -> int:
    from ipjax.files.objects.loading import load
    from ipjax.files.weights.hashes import hash_file
    from ipjax.labelling.merging.merge import merge
    from ipjax.labelling.shards.ledger import in_words
    from ipjax.labelling.shards.plan import check_source, read_manifest

    manifest = read_manifest(arguments.output)
    check_source(manifest, source, keys)
    made = {one["number"]: one["sha256"] for one in manifest["objects"]}
    if made != {number: hash_file(path) for number, path in zip(numbers, paths, strict=True)}:
        raise ValueError(f"{arguments.output}: it was labelled with other objects than those of --objects")
    objects = {number: load(path) for number, path in zip(numbers, paths, strict=True)}
    messages.print_notes()
    with Bars(quiet=arguments.quiet) as bars:
        about = {"images": arguments.images, "split": arguments.split, "progress": bars.show}
        try:
            told = merge(arguments.output, objects, source, keys, **about)
        except OSError as error:
            raise in_words(error, arguments.output) from error
    messages.say(
        f"{told.folder}: {told.frames} frames, {told.labels} labels, {told.bad} bad frames, {told.jumps} poses that "
        f"jump, {told.collisions} pairs of objects in one place; see {told.folder / 'quality.html'}"
    )
    document = {name: getattr(told, name) for name in ("frames", "labels", "bad", "jumps", "collisions")}
    messages.finish({"folder": str(told.folder), "page": str(told.folder / "quality.html"), **document})
    return 0


def _load_encoder(paths: list[Path], identities: list[str], weights: Any) -> Any:
    from ipjax.files.weights.matching import load_matching_encoder

    return load_matching_encoder(paths, identities, weights)


def list_objects(given: list[Path]) -> list[Path]:
    """Object files, those of a folder by name. Raises ValueError where there are none."""
    found: list[Path] = []
    for path in given:
        inside = sorted(path.glob("*.ipjax")) if path.is_dir() else [path]
        if not inside:
            raise ValueError(f"{path}: there are no object files (.ipjax) in this folder")
        found += inside
    for path in found:
        if not path.is_file():
            raise ValueError(f"{path}: no such object file")
    return found


def number_objects(paths: list[Path], given: list[int] | None) -> list[int]:
    """The number of each object: as given, as in the names of files where each has one, or from 1 on.

    Raises ValueError where these are not as many, or two are the same.
    """
    if given is not None:
        if len(given) != len(paths):
            raise ValueError(f"--obj-id is given once for each object, in their order: {len(given)} for {len(paths)}")
        numbers = list(given)
    else:
        matches = [re.fullmatch(r"obj_?(\d+)", path.stem) for path in paths]
        named = [int(match[1]) for match in matches if match is not None]
        numbers = named if len(named) == len(paths) else list(range(1, len(paths) + 1))
    if len(set(numbers)) != len(numbers) or min(numbers) < 0:
        raise ValueError(f"objects have numbers of their own, from 0 on, not {', '.join(map(str, numbers))} (--obj-id)")
    return numbers


def parse_part(text: str) -> tuple[int, int]:
    """``I/N``, I from 0 to N − 1; argparse.ArgumentTypeError, in words, otherwise."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not int(match[1]) < int(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r} is no part: give I/N, I from 0 to N - 1, for instance 0/8")
    return int(match[1]), int(match[2])
