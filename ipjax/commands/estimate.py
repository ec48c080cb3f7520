"""``ipjax estimate``: where are the objects in a frame, or in every frame of a folder?"""

import argparse
import time
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.candidates import MOST, estimate_best
from ipjax.commands.interface.checks import check, check_objects, read_first
from ipjax.commands.interface.detection import (
    Found,
    detect_frame,
    is_without_masks,
    make_detector,
    mend_mask,
    parse_instances,
)
from ipjax.commands.interface.frames import FrameFiles, Images, choose_masks, list_frames, read_frame
from ipjax.commands.interface.messages import Messages, in_one_line
from ipjax.commands.interface.outputs import compare_photos, draw_frame, mesh_paths, write_mesh
from ipjax.commands.interface.parser import add_command, parse_click, parse_count

EXAMPLES = """\
examples:
  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json -o pose.json --overlay out.png
  ipjax estimate mug.ipjax box.ipjax --rgb rgb.png --depth depth.png --camera camera.json --instances all
  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json --click 312,240 --explain why.html
  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json --mask mask.png -o pose.json
  ipjax estimate mug.ipjax box.ipjax --rgb rgb.png --depth depth.png --camera camera.json \\
      --mask mug.png --mask box.png --overlay out.png       several objects: one mask (or box) each, in their order
  ipjax estimate mug.ipjax --rgb a.png --depth a.npy --camera 600,600,320,240 --box 210,130,90,120
  ipjax estimate mug.ipjax --rgb a.png --depth a.png --camera camera.json --mask detections.json --obj-id 5
  ipjax estimate mug.ipjax --frames scene/ -o poses.json --overlay pictures/
  ipjax estimate mug.ipjax --frames scene/ --config fast --set match.views=4 --json | jq .frames[].objects

Without a mask or a box the objects are sought: the image is cut up by depth and colour into pieces that may be things,
those most like an object are estimated, and the mask is taken from the surest pose. --instances says how many of each.
A mask, a box, a click on it (--click X,Y) and a known size (--diameter) make it surer; --explain writes a page of what
was tried and why it was rejected. --mask-is-rough mends a mask that is too wide, or cut off.

A mask is an image of any kind, or a file of detections: JSON of BOP, COCO, SAM or Grounded-SAM, npz of CNOS or SAM-6D,
a stack of masks as npy, an image of labels. Of several masks without a class each is tried, and the one of highest
confidence kept: one estimate for each, of the 16 first by score, or by size (--candidates). --obj-id picks a class,
--instance one mask by its number in the file.

A folder of frames holds rgb/ and depth/ with one file of the same name per frame, mask/ (or masks/, mask_visib/) with
NAME.png (or NAME.json, .npz, .npy) for one object or NAME_000000.png, NAME_000001.png … for several, and a camera file:
scene_camera.json (BOP), camera.json, camera.yaml (ROS CameraInfo) or camera.txt (fx fy cx cy, or nine numbers). In a
scene of BOP, scene_gt.json says which of the masks is of which object: obj_000005.ipjax is its object 5, for other
names --obj-id says it.

Depth of whole numbers needs a unit: --depth-scale 0.001 for millimetres, unless the camera file has BOP's depth_scale.
The pose in the JSON maps the coordinates of your mesh file to camera metres; every frame and unit is named there.
For an object made from a photo it also has the pose relative to that photo. Where that photo had depth, the size it
measured is kept; --size says another, --free-size lets it be found.

  ipjax estimate mug.ipjax --rgb rgb.png --depth depth.png --camera camera.json --mask mask.png \\
      --compare compare.png --mesh-out mug.ply

An object made from a photo without depth is found through that photo. --compare shows the image as the photo's camera
would have seen it, beside the photo (which may have had depth): where the pose is right, the two fit together. Without
depth, --mesh-out has, in place of the front that was guessed, the one that was measured.
"""


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands, "estimate", run, "find objects in an RGB-D frame, or in a folder of frames", EXAMPLES
    )
    parser.add_argument("objects", metavar="OBJ.ipjax", type=Path, nargs="+", help="object files, from 'ipjax onboard'")
    parser.add_argument("--rgb", type=Path, metavar="FILE", help="colour image")
    options.add_depth(parser, "depth aligned to it: 16-bit PNG, TIFF or npy")
    options.add_mask(
        parser,
        "the object's visible pixels: an image, npy, or detections (JSON, npz)",
        "instead of a mask, pixels",
        many=True,
    )
    parser.add_argument(
        "--click",
        type=parse_click,
        metavar="X,Y",
        action="append",
        help="a pixel that shows the object: it is sought only there; one for each object",
    )
    parser.add_argument("--frames", type=Path, metavar="FOLDER", help="a folder of frames instead of a single one")
    parser.add_argument(
        "--instance",
        type=int,
        metavar="N",
        action="append",
        help="the number of the object's mask in a file of several, from 0, or in the name of its image with --frames; "
        "one for each object",
    )
    parser.add_argument(
        "--obj-id",
        type=int,
        metavar="N",
        action="append",
        help="which object of the detections, or of scene_gt.json with --frames; one for each object (default: from "
        "its name, obj_00000N)",
    )
    parser.add_argument(
        "--candidates",
        type=parse_count,
        metavar="N",
        default=MOST,
        help=f"of several masks that may be the object's, try the N best, one estimate each (default {MOST})",
    )
    parser.add_argument(
        "--instances",
        type=parse_instances,
        metavar="N|all",
        default=1,
        help="without masks: how many of each object are sought (default 1)",
    )
    parser.add_argument(
        "--mask-is-rough",
        action="store_true",
        help="estimate again in the mask of the pose, and say how much the given one was off",
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--size", type=float, metavar="MM", help="the object's true diameter in millimetres, if known")
    size.add_argument("--diameter", type=float, metavar="METRES", help="the same in metres")
    size.add_argument(
        "--free-size", action="store_true", help="estimate the size even where the reference photo measured it"
    )
    options.add_crop(parser)
    options.add_config(parser)
    options.add_seed(parser)
    options.add_output(parser, "JSON", "where the poses go (default: a line for each object on the screen)")
    parser.add_argument("--overlay", type=Path, metavar="PNG", help="a picture of the result (with --frames: a folder)")
    parser.add_argument(
        "--explain",
        type=Path,
        metavar="HTML",
        help="without masks: a page of what was proposed, ranked and verified, and why it was taken or rejected (with "
        "--frames: a folder)",
    )
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="PNG",
        help="of objects made from a photo: the photo, and the image drawn into its view (with --frames: a folder)",
    )
    parser.add_argument(
        "--mesh-out",
        type=Path,
        metavar="MESH",
        help="the mesh at its pose: .ply, .glb, .obj or .stl, metres, in the camera's axes (with --frames or several "
        "objects: a folder, of .ply)",
    )
    options.add_weights(parser)
    options.add_reporting(parser, quiet="no notes on stderr")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Estimate, print and draw; returns the exit status, 1 where no object is present in any frame."""
    frames = list_frames(arguments)
    check(arguments)
    from ipjax.config import DetectConfig
    from ipjax.files.objects.loading import load
    from ipjax.files.weights.matching import load_matching_encoder
    from ipjax.inference.compilation_cache import use_compilation_cache

    config = options.read_config(arguments)
    many = arguments.frames is not None
    objects = [load(path) for path in arguments.objects]
    names = [info.name for _, info in objects]
    first = read_first(frames[0], arguments, names) if not many else None
    check_objects(objects, arguments)
    if many:
        choose_masks(frames, names, arguments)
    identities = [info.encoder for _, info in objects]
    encoder = load_matching_encoder(arguments.objects, identities, arguments.weights)
    messages.print_notes()
    use_compilation_cache()
    from ipjax.files.storage.writing import write_text
    from ipjax.inference.estimator import Estimator
    from ipjax.inference.reports import CONVENTIONS, to_json

    sought = any(is_without_masks(files) for files in frames if not files.error)
    if sought:  # in all frames or in none
        config = DetectConfig().with_confidence(config)
    estimator = Estimator(
        objects, encoder, config, quick=not many, crop=arguments.crop, depth_scale=arguments.depth_scale
    )
    detector = None
    if sought or arguments.mask_is_rough:
        detector = make_detector(objects, encoder, quick=not many, crop=arguments.crop)
    entries: list[dict[str, Any]] = []
    for files in frames:
        try:
            entries.append(_estimate_frame(files, first, estimator, detector, arguments, messages))
        except (ValueError, OSError) as error:
            if not many:
                raise
            entries.append({"frame": files.name, "error": in_one_line(error)})
            messages.note(f"{files.name}: {in_one_line(error)}")
            continue
        messages.print_notes()
        if arguments.output is None or not arguments.quiet:
            for one in entries[-1]["objects"]:
                messages.say(_summary(files.name, one))
    if many and all("error" in entry for entry in entries):
        raise ValueError(f"{arguments.frames}: no frame could be used; the first: {entries[0]['error']}")
    text = to_json(
        {
            "format": "ipjax poses 1",
            "conventions": CONVENTIONS,
            "config": arguments.config,
            "set": arguments.changes,
            "seed": arguments.seed,
            "frames": entries,
        }
    )
    if arguments.output is not None:
        write_text(arguments.output, text)
    messages.finish(text)
    found = [one["present"] for entry in entries for one in entry.get("objects", ())]
    return 0 if any(found) else 1


def _estimate_frame(
    files: FrameFiles,
    images: Images | None,
    estimator: Any,
    detector: Any,
    arguments: argparse.Namespace,
    messages: Messages,
) -> dict[str, Any]:
    """Estimate the objects of one frame and draw its overlay; returns its entry in the result.

    ``images``: the frame, where it has been read already. ``detector``: for frames without masks, or with rough ones.
    """
    warned = len(messages.warnings)
    infos = [info for _, info in estimator.objects]
    if images is None:
        images = read_frame(files, arguments, [info.name for info in infos])
    # A reference photo with depth has measured the size; else it is free, unless the user knows it.
    given = arguments.diameter is not None or arguments.free_size
    diameters = [arguments.diameter if given else info.measured_diameter for info in infos]
    detection = None
    if is_without_masks(files):
        found, detection = detect_frame(files.name, images, detector, estimator, diameters, arguments, messages)
        entries = [_entry(one, infos, arguments) | {"mask": None, "detected": one.about} for one in found]
    else:
        found, entries = _estimate_masks(files, images, estimator, detector, diameters, arguments, messages)
    results = [one.result for one in found if one.result is not None]
    for result in results:
        for line in result.warnings:
            messages.keep(line, is_warning=True)
    entry: dict[str, Any] = {
        "frame": files.name,
        "rgb": str(files.rgb),
        "read_seconds": images.seconds,
        "warnings": list(dict.fromkeys(messages.warnings[warned:])),
        "objects": entries,
    }
    if detection is not None:
        entry["detection"] = detection
    if arguments.overlay is not None:
        start = time.perf_counter()
        masks = [one.mask for one in found if one.result is not None]
        entry["overlay"] = str(draw_frame(files.name, images, results, masks, estimator.config, arguments))
        entry["draw_seconds"] = round(time.perf_counter() - start, 6)
    if arguments.compare is not None and results:
        entry["comparison"] = str(compare_photos(files.name, results, arguments))
    if arguments.mesh_out is not None:
        paths = mesh_paths(files.name, len(entries), arguments)
        for one, known, path in zip(entries, found, paths, strict=True):
            one["mesh_written"] = None if known.result is None else write_mesh(known.result, path, messages)
    return entry


def _entry(found: Found, infos: list[Any], arguments: argparse.Namespace) -> dict[str, Any]:
    """What is told of one object in one frame."""
    from ipjax.inference.reports import estimate_as_json, nothing_as_json

    path, result = arguments.objects[found.index], found.result
    if result is None:
        return {"object_file": str(path), **nothing_as_json(infos[found.index].name)}
    return {
        "object_file": str(path),
        **estimate_as_json(result.estimate, result.templates, result.info),
        "size_given_mm": None if found.diameter is None else 1e3 * found.diameter,
        "stage_seconds": {name: round(value, 6) for name, value in ({"frame": found.seconds} | result.seconds).items()},
    }


def _estimate_masks(
    files: FrameFiles,
    images: Images,
    estimator: Any,
    detector: Any,
    diameters: list[float | None],
    arguments: argparse.Namespace,
    messages: Messages,
) -> tuple[list[Found], list[dict[str, Any]]]:
    """Estimate each object in the mask, box or masks that were given for it; and what is told of each."""
    infos = [info for _, info in estimator.objects]
    crops = []
    for i, (candidates, box) in enumerate(zip(images.candidates, files.boxes, strict=True)):
        # Several masks are cut out one after the other, as each is estimated.
        if candidates is not None and len(candidates) > 1:
            crops.append(None)
            continue
        mask = None if candidates is None else candidates[0].mask
        start = time.perf_counter()
        crop = estimator.frame(i, images.rgb, images.depth, mask, images.camera, box)
        crops.append((crop, time.perf_counter() - start))
    found, entries, sight = [], [], None
    for i, cut in enumerate(crops):
        info = infos[i]
        options: dict[str, Any] = {"seed": arguments.seed, "diameter": diameters[i]}
        start, tried = time.perf_counter(), None
        masks = images.candidates[i]
        if cut is None:
            messages.print_notes()
            messages.note(f"{files.name}: {info.name}: {len(masks)} masks may be the object's: each is tried")
            result, seconds, tried = estimate_best(estimator, i, images, masks, files.boxes[i], **options)
        else:
            crop, seconds = cut
            result = estimator.run(i, *crop, **options)
        mended, mask = None, None
        if arguments.mask_is_rough and masks is not None:
            messages.print_notes()
            chosen = 0 if tried is None else next(k for k, one in enumerate(tried) if one["chosen"])
            if sight is None:
                sight = detector.look(images.rgb, images.depth, images.camera, arguments.depth_scale)
            about = files.name, images, sight, detector, estimator, i, result, masks[chosen].mask, messages
            result, mended, mask = mend_mask(*about, **options)
        found.append(Found(i, result, mask, seconds, diameters[i], None))
        path = None if files.masks[i] is None else str(files.masks[i])
        entries.append({"mask": path} | _entry(found[-1], infos, arguments))
        if mended is not None:
            entries[-1]["mended_mask"] = mended
        if tried is not None:
            entries[-1]["candidates"] = tried
            entries[-1]["candidates_seconds"] = round(time.perf_counter() - start, 6)
            messages.note(f"{files.name}: {info.name}: {_told(tried, entries[-1]['candidates_seconds'])}")
    return found, entries


def _told(tried: list[dict[str, Any]], seconds: float) -> str:
    """One sentence about the masks that were tried."""
    used = [one for one in tried if one["confidence"] is not None]
    best = next(one for one in tried if one["chosen"])
    left = f", {len(tried) - len(used)} could not be used" if len(used) < len(tried) else ""
    return f"mask {best['index']} has the highest confidence; {len(used)} tried in {seconds:.1f} s{left} (--instance)"


def _summary(frame: str, one: dict[str, Any]) -> str:
    """One line about one object in one frame."""
    if not one["success"]:
        return f"{frame}: {one['object']}: no pose found"
    from ipjax.inference.reports import AMBIGUOUS_TURN

    turn = one["ambiguity"]["std_deg"]
    ending = f"; may be turned (± {turn:.0f}° about one axis)" if turn > AMBIGUOUS_TURN else ""
    if not one["present"]:
        ending += "; NOT HERE, or not seen well enough: the pose is a guess"
    x, y, z = (1e3 * v for v in one["camera_from_object"]["translation_m"])
    size = one["size_mm"]
    # A size that was told, or that the photo's depth measured, was not estimated: ± 0 would say that it is exact.
    spread = f" ± {size['diameter_std']:.1f} mm" if one["size_given_mm"] is None else " mm (given)"
    return (
        f"{frame}: {one['object']}: centre ({x:.0f}, {y:.0f}, {z:.0f}) mm, diameter {size['diameter']:.1f}{spread}, "
        f"{one['inliers']} inliers, confidence {one['confidence']:.2f}{ending}"
    )
