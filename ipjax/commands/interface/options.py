"""Options that several commands share: each is spelled, explained and checked once."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.commands.interface import completion
from ipjax.commands.interface.parser import Renamed, parse_box, parse_count

METRICS = ("mssd", "mspd", "vsd", "add", "add_s", "ap")
PICTURES = (".png", ".jpg", ".jpeg")


# --- output -----------------------------------------------------------------------------------------------------------


def add_output(
    parser: Any, metavar: str, text: str, *, required: bool = False, default: Path | None = None
) -> argparse.Action:
    """``-o``, the file or folder that a command writes."""
    return parser.add_argument(
        "-o", "--output", type=Path, metavar=metavar, required=required, default=default, help=text
    )


def add_reporting(parser: Any, *, quiet: str | None = None) -> None:
    """``--json``; and ``--quiet``, where there are notes or progress bars to leave out."""
    parser.add_argument("--json", action="store_true", help="print the result as one JSON document; notes go to stderr")
    if quiet is not None:
        parser.add_argument("--quiet", action="store_true", help=quiet)


def check_output(path: Path, suffixes: tuple[str, ...]) -> Path:
    """Refuse a file that cannot be written before the work, not after it; ValueError says why."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise ValueError(f"{path}: a folder of this name is in the way")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: the folder {path.parent} cannot be written to")
    return path


def check_apart(outputs: Sequence[Path | None], inputs: Sequence[Path | str | None]) -> None:
    """Refuse to write over a file that is read, or two results into one file; ValueError says which."""
    read = {Path(one).resolve() for one in inputs if one is not None}
    written: set[Path] = set()
    for path in outputs:
        if path is None:
            continue
        if path.resolve() in read:
            raise ValueError(f"{path}: it is read and would be overwritten; write to another file")
        if path.resolve() in written:
            raise ValueError(f"{path}: two results cannot be written to one file")
        written.add(path.resolve())


def check_folder(path: Path) -> Path:
    """Refuse a folder that cannot be made or written to, as `check_output`."""
    there = next((place for place in (path, *path.parents) if place.exists()), None)
    if there is not None and not there.is_dir():
        raise ValueError(
            f"{path}: a file of this name is in the way" if there == path else f"{path}: {there} is a file"
        )
    if there is not None and not os.access(there, os.W_OK):
        raise ValueError(f"{path}: the folder {there} cannot be written to")
    return path


# --- settings ---------------------------------------------------------------------------------------------------------


def add_config(parser: Any) -> None:
    """``--config``, the settings of the estimate, and ``--set``, which changes some of them."""
    action = parser.add_argument(
        "--config",
        default="default",
        metavar="default|fast|paper|FILE",
        help="settings: the surest, the fastest, the paper's, or a JSON file of what differs from the default",
    )
    completion.attach(action, completion.complete_config)
    add_changes(parser, "Config", "match.views=4")
    parser.add_argument("--method", action=Renamed, help=argparse.SUPPRESS)


def add_changes(parser: Any, of: str, example: str) -> None:
    """``--set FIELD=VALUE``, as often as wanted, for the fields of this class of `ipjax.config`."""
    action = parser.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="FIELD=VALUE",
        help=f"change one setting, for instance {example}; once for each",
    )
    completion.attach(action, completion.complete_changes(of))


def read_config(arguments: argparse.Namespace) -> Any:
    """What ``--config`` and ``--set`` say; ValueError, in words, where there is no such setting."""
    from ipjax.files.settings import read_config

    return change(arguments, read_config(arguments.config))


def change(arguments: argparse.Namespace, config: Any) -> Any:
    """A configuration with what ``--set`` changes; ValueError, in words, where there is no such setting."""
    from ipjax.files.settings import override

    try:
        return override(arguments.changes, config)
    except ValueError as error:
        raise ValueError(f"--set: {error}") from None


def add_views(parser: Any, of: str) -> None:
    """``--directions`` and ``--rolls``: how many templates an object file gets."""
    parser.add_argument("--directions", type=parse_count, metavar="N", help=f"viewpoints of {of} (default 40)")
    parser.add_argument("--rolls", type=parse_count, metavar="N", help="in-plane rotations of each (default 10)")


def read_views(arguments: argparse.Namespace, *more: str) -> dict[str, Any]:
    """What `add_views`, and options named ``more``, say of an OnboardConfig; what is left out is left to it."""
    names = ("directions", "rolls", *more)
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def add_seed(parser: Any, text: str = "same seed, same answer") -> None:
    """``--seed``."""
    parser.add_argument("--seed", type=int, default=0, help=f"{text} (default 0)")


def check_seed(seed: int) -> int:
    """Refuse a seed that JAX does not take; ValueError says which it does."""
    if not 0 <= seed < 2**32:
        raise ValueError(f"--seed must be from 0 to {2**32 - 1}")
    return seed


def add_crop(parser: Any) -> None:
    """``--crop``."""
    parser.add_argument("--crop", choices=("square", "look_at"), default="square", help="how the query is cut out")


# --- the encoder ------------------------------------------------------------------------------------------------------


def add_weights(parser: Any) -> None:
    """``--weights``, where the object files say all else about their encoder."""
    text = "of the encoder (default: the best that is here)"
    action = parser.add_argument("--weights", metavar="NAME|FILE", help=text)
    completion.attach(action, completion.complete_weights)


def add_encoder(parser: Any) -> None:
    """``--weights``, and how the encoder is to be used."""
    add_weights(parser)
    parser.add_argument("--block", type=int, metavar="N", help="whose tokens are the features, from 0")
    parser.add_argument("--bfloat16", action="store_true", help="encode in bfloat16: faster on accelerators")


def load_encoder(arguments: argparse.Namespace) -> Any:
    """The encoder that the options of `add_encoder` name."""
    from ipjax.files.weights.encoder import load_encoder

    dtype = "bfloat16" if arguments.bfloat16 else "float32"
    return load_encoder(arguments.weights, block=arguments.block, dtype=dtype)


# --- images -----------------------------------------------------------------------------------------------------------


def add_depth(parser: Any, text: str) -> None:
    """``--depth`` and its unit, and the camera that both images share."""
    parser.add_argument("--depth", type=Path, metavar="FILE", help=text)
    parser.add_argument("--depth-scale", type=float, metavar="S", help="metres per depth unit, e.g. 0.001")
    parser.add_argument("--camera", metavar="FILE", help="BOP JSON, ROS CameraInfo, or fx,fy,cx,cy")
    parser.add_argument("--image", type=int, metavar="ID", help="which image of a BOP scene_camera.json")


def add_mask(parser: Any, mask_text: str, box_text: str, *, many: bool = False) -> None:
    """``--mask``, ``--mask-label`` and ``--box``: one of each or, for ``many`` objects, as many as there are."""
    action = "append" if many else "store"
    label = "which of the numbers in a mask of several objects" + ("; one for each object" if many else "")
    parser.add_argument("--mask", type=Path, metavar="FILE", action=action, help=mask_text)
    parser.add_argument("--mask-label", type=int, metavar="N", action=action, help=label)
    parser.add_argument("--box", type=parse_box, metavar="X,Y,W,H", action=action, help=box_text)


# --- data sets --------------------------------------------------------------------------------------------------------


def add_dataset(parser: Any) -> None:
    """The data set, as a positional argument, and which part of it."""
    parser.add_argument("dataset", type=Path, metavar="FOLDER", help="in BOP layout")
    parser.add_argument("--split", default="test", help="which split (default test)")
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="another data set, to take the models from")
    parser.add_argument(
        "--targets", metavar="NAME", help="the file of targets in it (default: test_targets_bop19.json, or bop24)"
    )


def open_dataset(arguments: argparse.Namespace) -> Any:
    """The data set that the options of `add_dataset` name; ValueError, in words, where it is not there."""
    from ipjax.bop.dataset import Dataset

    dataset = Dataset(arguments.dataset, arguments.split, models=arguments.models, targets=arguments.targets)
    if arguments.targets is not None and not dataset.targets_file.is_file():
        raise ValueError(f"{dataset.targets_file}: no such file of targets")
    return dataset


def add_scoring(parser: Any, default: tuple[str, ...] | None, default_text: str, skip_text: str) -> None:
    """What is measured, what it is compared with, and what is left out; the texts are for ``--help``."""
    parser.add_argument(
        "--metrics",
        nargs="+",
        choices=METRICS,
        metavar="METRIC",
        default=default,
        help=f"of {', '.join(METRICS)} (default: {default_text})",
    )
    parser.add_argument("--against", type=Path, metavar="CSV", help="another result file, compared object by object")
    parser.add_argument("--without", nargs="+", metavar="SCENE/IMAGE", help="also score without these images")
    parser.add_argument("--skip-bad", action="store_true", help=skip_text)
