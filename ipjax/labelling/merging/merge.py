"""All shards of a folder of labels as one data set in BOP's layout, with COCO's file, a table, and a page."""

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.bop.records import MM
from ipjax.files.meshes.mesh import make_mesh
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.folders import writing_folder
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text, writing
from ipjax.inference.drawing import write_image
from ipjax.labelling.entries import Entry
from ipjax.labelling.merging.consistency import Collision, Jump, find_collisions, find_jumps
from ipjax.labelling.merging.page import write_page
from ipjax.labelling.merging.poses import Poses, gather_poses, read_entries
from ipjax.labelling.merging.sampling import choose_frames
from ipjax.labelling.outputs.bop_files import labels_of, metres_per_unit
from ipjax.labelling.outputs.coco import write_coco
from ipjax.labelling.outputs.tables import as_columns, has_parquet, write_table
from ipjax.labelling.shards.plan import SHARDS, Shard, plan_shards, read_manifest
from ipjax.labelling.shards.working import is_finished
from ipjax.labelling.sources.records import FrameKey, Source
from ipjax.records import Templates

MERGED = "merged"
DEPTH_SCALE = 0.1  # millimetres per number of the depth images
_NAMED = 8  # missing shards that are named
_SURFACE = 400  # points of an object that are compared


@dataclasses.dataclass(frozen=True)
class Merged:
    """What was merged."""

    folder: Path
    frames: int
    labels: int
    bad: int
    jumps: int
    collisions: int


def merge(
    folder: Path,
    objects: Mapping[int, tuple[Templates, ObjectInfo]],
    source: Source | None = None,
    keys: Sequence[FrameKey] = (),
    *,
    images: bool = False,
    pictures: int = 18,
    split: str = "test",
    progress: Callable[[str, int, int], None] | None = None,
) -> Merged:
    """Merge all shards into ``FOLDER/merged``, whole or not at all; one that is there gives way.

    Args:
        folder: of the labels.
        objects: by their numbers, as they were labelled.
        source: of the frames, for pictures and images; None = without.
        keys: of its frames.
        images: write the images, too, so that the result is a whole data set.
        pictures: frames on the page.
        split: the folder of the scenes.
        progress: told what is done, and how much of it.

    Returns:
        What was merged.

    Raises:
        ValueError: shards are missing (named), the objects are others, or a file is damaged.
        OSError: something cannot be written.
    """
    manifest = read_manifest(folder)
    plan = plan_shards(manifest["frames"], manifest["shard_size"])
    missing = [shard.name for shard in plan if not is_finished(folder, shard)]
    if missing:
        named = ", ".join(missing[:_NAMED]) + (" …" if len(missing) > _NAMED else "")
        raise ValueError(
            f"{folder}: {len(missing)} of {len(plan)} shards are not labelled: {named}; run 'ipjax label' again"
        )
    if images and source is None:
        raise ValueError("images are written from the source, which is not given")
    tell = progress or (lambda part, done, total: None)
    infos = {number: info for number, (_, info) in objects.items()}
    names = {number: info.name for number, info in infos.items()}
    read = None if source is None else (lambda place: source.read(keys[place]))
    with writing_folder(folder / MERGED, replace=True) as merged:
        every = lambda: _entries(folder, plan)
        for suffix in ("csv", "sized"):
            _join_lines(merged / f"labels.{suffix}", [folder / SHARDS / s.name / f"labels.{suffix}" for s in plan])
        write_coco(merged / "coco.json", names, lambda: ((place + 1, entry) for place, entry in every()))
        parts = (as_columns(read_entries(folder, shard), names) for shard in plan)
        write_table(merged / "table", _told(parts, len(plan), lambda done, total: tell("table", done, total)),
                    parquet=has_parquet())  # fmt: skip
        bad = [one for shard in plan for one in read_json(folder / SHARDS / shard.name / "bad_frames.json")]
        write_text(merged / "bad_frames.json", json.dumps(bad) + "\n")
        _write_scenes(folder, merged / split, plan, images)
        _write_about(merged, split, every, infos, manifest)
        if read is not None and images:
            _write_images(merged / split, every, read, len(keys), lambda *done: tell("images", *done))
        mesh_from_object = {number: info.object_from_mesh.to_numpy().inverse() for number, info in infos.items()}
        poses = gather_poses(every(), mesh_from_object)
        surfaces = {number: _surface(templates) for number, (templates, _) in objects.items()}
        (jumps, unrelated), collisions = find_jumps(poses, surfaces), find_collisions(poses, surfaces)
        chosen = choose_frames(poses, jumps, collisions, pictures)
        wanted = {int(poses.place[row]) for one in jumps for row in (one.row,)}
        wanted |= {int(poses.place[one.first]) for one in collisions} | {one.place for one in chosen}
        kept = {place: entry for place, entry in every() if place in wanted}
        frame_name = lambda place: kept[place]["name"]
        doubts = _count_notes(entry for _, entry in every())
        write_text(merged / "quality.json", _quality(poses, jumps, collisions, unrelated, doubts, frame_name))
        reasons = [(one["frame"], one["reason"]) for one in bad]
        about = folder.resolve().name, manifest["frames"], poses, infos, jumps, collisions, reasons
        sample = [(one, kept[one.place]) for one in chosen]
        write_page(merged / "quality.html", *about, sample, read, frame_name, unrelated=unrelated, doubts=doubts)
    labels = int(poses.present.sum())
    return Merged(folder / MERGED, manifest["frames"], labels, len(bad), len(jumps), len(collisions))


def _entries(folder: Path, plan: Sequence[Shard]) -> Iterator[tuple[int, Entry]]:
    """The entries of all shards with their places."""
    for shard in plan:
        yield from enumerate(read_entries(folder, shard), shard.start)


def _told(parts: Iterator[Any], total: int, tell: Callable[[int, int], None]) -> Iterator[Any]:
    for done, part in enumerate(parts):
        tell(done, total)
        yield part
    tell(total, total)


def _join_lines(path: Path, parts: Sequence[Path]) -> None:
    """Files of lines under one headline, which all of them have."""
    with writing(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as file:
        for place, part in enumerate(parts):
            head, *rows = part.read_text(encoding="utf-8").split("\n")
            if place == 0:
                file.write(head)
            file.writelines(f"\n{row}" for row in rows if row)


def _write_scenes(folder: Path, target: Path, plan: Sequence[Shard], images: bool) -> None:
    """The annotations of every scene, from all shards that have a part of it."""
    scenes: dict[str, list[Path]] = {}
    for shard in plan:
        for place in sorted((folder / SHARDS / shard.name / "scenes").glob("*")):
            scenes.setdefault(place.name, []).append(place)
    for name, places in sorted(scenes.items()):
        for kind in ("scene_camera", "scene_gt", "scene_gt_info"):
            document: dict[str, Any] = {}
            for place in places:
                document |= read_json(place / f"{kind}.json")
            if kind == "scene_camera" and images:
                document = {image: entry | {"depth_scale": DEPTH_SCALE} for image, entry in document.items()}
            write_text(target / name / f"{kind}.json", json.dumps(document) + "\n", parents=True)


def _write_about(
    merged: Path,
    split: str,
    every: Callable[[], Iterator[tuple[int, Entry]]],
    infos: Mapping[int, ObjectInfo],
    manifest: Mapping[str, Any],
) -> None:
    """camera.json, the targets, the models, and what the labels were made of."""
    first: Entry | None = None
    targets = []
    for _, entry in every():
        if entry["error"]:
            continue
        first = first or entry
        counts: dict[int, int] = {}
        for one in labels_of(entry):
            counts[one["number"]] = counts.get(one["number"], 0) + 1
        what = {"scene_id": entry["scene"], "im_id": entry["image"]}
        targets += [what | {"obj_id": number, "inst_count": count} for number, count in sorted(counts.items())]
    write_text(merged / f"{split}_targets_bop19.json", json.dumps(targets) + "\n")
    if first is not None:
        (height, width), matrix = first["size"], np.reshape(first["camera"], (3, 3))
        camera = {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
        about = camera | {"width": width, "height": height, "depth_scale": DEPTH_SCALE}
        write_text(merged / "camera.json", json.dumps(about) + "\n")
    told = {"objects": {str(number): info.name for number, info in infos.items()}, "made_of": dict(manifest)}
    write_text(merged / "dataset_info.json", json.dumps(told, indent=1) + "\n")
    units, models = metres_per_unit(infos), {}
    for number, info in infos.items():
        if info.vertices is None or info.faces is None:
            continue
        vertices = info.object_from_mesh.to_numpy().inverse() @ np.asarray(info.vertices, np.float64)
        vertices = vertices * (units[number] / MM)
        low, high = vertices.min(0), vertices.max(0)
        models[str(number)] = {
            "diameter": units[number] / MM / info.mesh_scale,
            **{f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")},
            **{f"size_{axis}": float((high - low)[k]) for k, axis in enumerate("xyz")},
        }
        (merged / "models").mkdir(exist_ok=True)
        mesh = make_mesh(vertices, np.asarray(info.faces), colours=info.colours)
        save_mesh(mesh, merged / "models" / f"obj_{number:06d}.ply")
    if models:
        write_text(merged / "models" / "models_info.json", json.dumps(models) + "\n")


def _write_images(
    target: Path,
    every: Callable[[], Iterator[tuple[int, Entry]]],
    read: Callable[[int], Any],
    total: int,
    tell: Callable[[int, int], None],
) -> None:
    """Colours, depth and visible masks of every usable frame."""
    from ipjax.files.images.run_lengths import decode_rle

    for place, entry in every():
        tell(place, total)
        if entry["error"]:
            continue
        scene = target / f"{entry['scene']:06d}"
        for kind in ("rgb", "depth", "mask_visib"):
            (scene / kind).mkdir(exist_ok=True)
        frame, name = read(place), f"{entry['image']:06d}"
        depth = np.round(np.asarray(frame.depth, np.float64) / (MM * DEPTH_SCALE))
        depth = np.where(depth <= 65535, depth, 0).astype(np.uint16)  # what is farther is not known
        write_image(scene / "rgb" / f"{name}.png", frame.rgb)
        write_image(scene / "depth" / f"{name}.png", depth)
        for instance, one in enumerate(labels_of(entry)):
            mask = decode_rle({"size": entry["size"], "counts": one["mask"]})
            write_image(scene / "mask_visib" / f"{name}_{instance:06d}.png", mask.astype(np.uint8) * 255)
    tell(total, total)


def _surface(templates: Templates) -> np.ndarray:
    """Some points of an object's surface."""
    points = np.asarray(templates.surface.points, np.float64)
    return points[np.linspace(0, len(points) - 1, min(_SURFACE, len(points))).astype(int)]


def _count_notes(entries: Iterable[Entry]) -> list[tuple[str, int]]:
    """What was said of instances, the most frequent first; sentences that differ in numbers alone are one."""
    counts: Counter[str] = Counter()
    first: dict[str, str] = {}
    for entry in entries:
        for one in entry["instances"]:
            if one["note"]:
                kind = re.sub(r"\d[\d.]*", "#", one["note"])
                first.setdefault(kind, one["note"])
                counts[kind] += 1
    return [(first[kind], count) for kind, count in counts.most_common()]


def _quality(
    poses: Poses,
    jumps: Sequence[Jump],
    collisions: Sequence[Collision],
    unrelated: Sequence[int],
    doubts: Sequence[tuple[str, int]],
    name: Callable[[int], str],
) -> str:
    """What the page tells, all of it, for programs."""
    what = lambda row: {"frame": name(int(poses.place[row])), "number": int(poses.number[row])}
    found = {
        "labels": int(poses.present.sum()),
        "not_believed": int((~poses.present).sum()),
        "jumps": [what(one.row) | {"diameters": one.moved, "rad": one.turned} for one in jumps],
        "collisions": [
            what(one.first) | {"other": int(poses.number[one.second]), "share": one.share} for one in collisions
        ],
        "scenes_without_sequence": list(unrelated),
        "notes": [{"first": said, "count": count} for said, count in doubts],
    }
    return json.dumps(found, indent=1) + "\n"
