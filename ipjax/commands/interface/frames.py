"""The frames that a command line names: their files, which mask is of which object, and what is read from them."""

import argparse
import dataclasses
import logging
import re
import time
from pathlib import Path
from typing import Any

from ipjax.commands.interface.parser import parse_camera

COLOURS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
DEPTHS = (".png", ".tif", ".tiff", ".npy")
MASKS = (".png", ".npy", ".npz", ".json")
CAMERAS = ("scene_camera.json", "camera.json", "camera.yaml", "camera.yml", "camera.txt", "cam_K.txt")


@dataclasses.dataclass
class FrameFiles:
    """The files of one frame; a mask or a box for each object."""

    name: str
    rgb: Path
    depth: Path
    camera: str  # a file, or fx,fy,cx,cy
    masks: list[Path | None]
    boxes: list[tuple[float, ...] | None]
    error: str = ""  # why this frame cannot be used


@dataclasses.dataclass(frozen=True)
class Images:
    """What is read from the files of one frame."""

    rgb: Any  # h × w × 3
    depth: Any  # h × w, in the file's unit
    camera: Any
    candidates: list[Any]  # of each object the masks that may be its, best first (`interface.candidates`); or None
    seconds: float


def list_frames(arguments: argparse.Namespace) -> list[FrameFiles]:
    """The files of the frame that the options name, or of every frame in the folder ``--frames``.

    Raises ValueError, in words, for what is missing.
    """
    if arguments.frames is None:
        return [_single_frame(arguments)]
    for name in ("rgb", "depth", "mask", "box", "click"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} belongs to a single frame; leave it out with --frames")
    folder, count = arguments.frames, len(arguments.objects)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    found = sorted(p for p in (folder / "rgb").glob("*") if p.suffix.lower() in COLOURS)
    if not found:
        raise ValueError(f"{folder}: it has no images in rgb/")
    camera = arguments.camera
    if camera is None:
        camera = next((str(folder / name) for name in CAMERAS if (folder / name).is_file()), None)
        if camera is None:
            raise ValueError(f"{folder}: no camera file in it ({', '.join(CAMERAS)}); give --camera")
    masks = _mask_folder(folder)
    if masks is None and (_chosen_mask(arguments) or arguments.mask_is_rough):
        raise ValueError(f"{folder}: no masks in mask/, masks/ or mask_visib/")
    if masks is not None and arguments.instances != 1:
        raise ValueError(f"--instances is for objects that are sought, but {folder} has masks in {masks.name}/")
    if masks is not None and arguments.explain is not None:
        raise ValueError(f"--explain shows how objects are sought, but {folder} has masks in {masks.name}/")
    frames = []
    for path in found:
        depths = [folder / "depth" / f"{path.stem}{suffix}" for suffix in DEPTHS]
        depth = next((p for p in depths if p.is_file()), depths[0])
        frames.append(FrameFiles(path.stem, path, depth, camera, [None] * count, [None] * count))
    return frames


def _single_frame(arguments: argparse.Namespace) -> FrameFiles:
    count = len(arguments.objects)
    missing = [f"--{name}" for name in ("rgb", "depth", "camera") if getattr(arguments, name) is None]
    if missing:
        raise ValueError(f"a frame needs {', '.join(missing)} (or give --frames FOLDER)")
    masks, boxes = arguments.mask or [], arguments.box or []
    if not masks and (name := _chosen_mask(arguments)):
        raise ValueError(f"{name} says which of several masks: it needs a --mask")
    if len(masks) not in (0, count) or len(boxes) not in (0, count):
        raise ValueError(
            f"{count} object{'s need as many' if count > 1 else ' needs one'} --mask or --box, in the same order, or "
            f"none at all; got {len(masks)} and {len(boxes)}"
        )
    return FrameFiles(
        arguments.rgb.stem,
        arguments.rgb,
        arguments.depth,
        arguments.camera,
        masks or [None] * count,
        boxes or [None] * count,
    )


def _chosen_mask(arguments: argparse.Namespace) -> str:
    """The option that says which of several masks is the object's; "" where none does."""
    names = ("instance", "obj_id", "mask_label")
    return next((f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name)), "")


def _mask_folder(folder: Path) -> Path | None:
    # BOP's mask/ holds whole silhouettes, in which occluders lie over the object: mask_visib/ is the one to use.
    names = ("mask_visib", "mask", "masks") if (folder / "scene_gt.json").is_file() else ("mask", "masks", "mask_visib")
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def choose_masks(frames: list[FrameFiles], names: list[str], arguments: argparse.Namespace) -> None:
    """Fill in the masks of a folder's frames; a frame without a usable mask says why in its ``error``. In a folder
    that has no masks at all the objects are sought, and nothing is filled in.

    Args:
        frames: of `list_frames`.
        names: of the objects, in the order of the command line.

    Raises ValueError where nothing says which mask is of which object.
    """
    from ipjax.files.storage.parsing import read_json

    folder, count = arguments.frames, len(names)
    masks = _mask_folder(folder)
    if masks is None:  # the objects are sought without
        return
    truth, about = folder / "scene_gt.json", folder / "scene_gt_info.json"
    scene = read_json(truth) if truth.is_file() and not arguments.instance else None
    shares = read_json(about) if about.is_file() else {}
    ids = arguments.obj_id
    for frame in frames:
        plain = next((p for p in (masks / f"{frame.name}{end}" for end in MASKS) if p.is_file()), None)
        numbered = sorted(p for p in masks.glob(f"{frame.name}_*.png") if p.stem[len(frame.name) + 1 :].isdigit())
        if plain is not None and plain.suffix != ".png":
            frame.masks = [plain] * count  # detections say of which object they are, or are tried
        elif scene is None and ids:
            raise ValueError(f"{folder}: --obj-id needs a scene_gt.json, or detections as masks, and no --instance")
        elif arguments.instance:
            frame.masks = [masks / f"{frame.name}_{number:06d}.png" for number in arguments.instance]
        elif plain is not None and (count == 1 or arguments.mask_label):
            frame.masks = [plain] * count
        elif scene is not None and numbered:
            if ids is None:
                ids = _object_ids(names, scene, truth)
            try:
                chosen = [_choose_instance(scene, shares, frame.name, number, truth) for number in ids]
                frame.masks = [masks / f"{frame.name}_{number:06d}.png" for number in chosen]
            except ValueError as error:
                frame.error = str(error)
        elif len(numbered) > count:
            raise ValueError(
                f"{masks}: {frame.name} has {len(numbered)} masks, and {count} object{'s are' if count > 1 else ' is'} "
                "wanted: say which mask is whose with --instance N, the number in its name, once for each object"
            )
        else:
            expected = [masks / f"{frame.name}_{i:06d}.png" for i in range(count)]
            frame.masks = [*expected] if count > 1 or expected[0].is_file() else [masks / f"{frame.name}.png"]


def _object_ids(names: list[str], scene: Any, path: Path) -> list[int]:
    """The numbers in scene_gt.json of objects that are named as BOP names their files."""
    found = []
    for name in names:
        match = re.fullmatch(r"obj_?(\d+)", name)
        if match is None:
            try:
                there = sorted({int(item["obj_id"]) for items in scene.values() for item in items})
            except (AttributeError, KeyError, TypeError, ValueError):
                raise ValueError(f"{path}: for each image, a list of instances with obj_id is expected") from None
            raise ValueError(
                f"{path}: it has the objects {', '.join(map(str, there))}: say with --obj-id which is {name}, or with "
                "--instance which mask, once for each object"
            )
        found.append(int(match[1]))
    return found


def _choose_instance(scene: Any, shares: Any, stem: str, number: int, path: Path) -> int:
    """The mask of an object in an image: of its instance, or of the most visible of several."""
    try:
        image = str(int(stem))
        items = [int(item["obj_id"]) for item in scene.get(image, [])]
        about = shares.get(image, [])
        visible = [float(item.get("visib_fract", 0)) for item in about] if len(about) == len(items) else None
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ValueError(f"{path}: image {stem}: a list of instances with obj_id is expected") from None
    found = [i for i, obj_id in enumerate(items) if obj_id == number]
    if not found:
        raise ValueError(f"{path}: there is no object {number} in image {stem}")
    if len(found) == 1:
        return found[0]
    if visible is None:
        raise ValueError(
            f"{path}: there are {len(found)} of object {number} in image {stem}: say which with --instance"
        )
    best = max(found, key=lambda i: visible[i])
    logging.getLogger("ipjax").warning(
        "image %s: of %d of object %d, the most visible is taken (mask %06d)", stem, len(found), number, best
    )
    return best


def read_frame(files: FrameFiles, arguments: argparse.Namespace, names: list[str]) -> Images:
    """Read the files of one frame; ValueError or OSError, in words, for what cannot be used.

    ``names`` are those of the objects.
    """
    from ipjax.commands.interface.candidates import Choice, read_masks
    from ipjax.files.cameras.reading import read_camera
    from ipjax.files.images.depth import read_depth
    from ipjax.files.images.opening import read_rgb

    if files.error:
        raise ValueError(files.error)
    start = time.perf_counter()
    image = arguments.image
    if image is None and files.name.isdigit():
        image = int(files.name)
    rgb, depth = read_rgb(files.rgb), read_depth(files.depth)
    camera = read_camera(parse_camera(files.camera), image)
    scene = files.rgb.absolute().parent.parent.name  # a number where the folders are BOP's
    candidates: list[Any] = []
    for i, (path, name) in enumerate(zip(files.masks, names, strict=True)):
        if path is None:
            candidates.append(None)
            continue
        label, category, instance = (
            None if given is None else given[i]
            for given in (arguments.mask_label, arguments.obj_id, arguments.instance)
        )
        # In a folder of images a number names one of them, or is looked up in scene_gt.json.
        if arguments.frames is not None and path.suffix == ".png":
            category = instance = None
        choice = Choice(name, label, category, instance, arguments.candidates)
        candidates.append(read_masks(path, choice, rgb.shape[:2], image, int(scene) if scene.isdigit() else None))
    return Images(rgb, depth, camera, candidates, round(time.perf_counter() - start, 6))
