"""A labelled capture as a data set in BOP's layout.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, scene-wise, millimetres::

    camera.json, dataset_info.json, test_targets_bop19.json
    models/obj_000001.ply …, models_info.json        models_eval/ the same
    test/000000/rgb, depth, mask, mask_visib
    test/000000/scene_camera.json, scene_gt.json, scene_gt_info.json
"""

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ipjax.bop.dataset import VISIBLE
from ipjax.capture.labels.masks import FrameLabels
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import diameter, move
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.storage.folders import writing_folder
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text, writing

DEPTH_SCALE = 0.1  # millimetres per number of the depth images: up to 6.5 m; what is farther is left out
# What `write_dataset` makes; anything else in the folder is somebody's.
_MADE = {"camera.json", "dataset_info.json", "models", "models_eval", "test", "test_targets_bop19.json"}


@dataclasses.dataclass(frozen=True)
class LabelledScene:
    """One scene of a data set."""

    frames: Sequence[PosedFrame]
    labels: Sequence[FrameLabels]
    # Of each entry of the labels, its model's place in the data set's; None = the same order.
    which: tuple[int, ...] | None = None
    # Further images of every frame, by the name of their folder.
    beside: Mapping[str, Sequence[UInt8[np.ndarray, "h w"]]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if len(self.frames) != len(self.labels):
            raise ValueError(f"{len(self.frames)} frames have {len(self.labels)} labels")

    def number(self, entry: int) -> int:
        """The object's number of an entry of the labels."""
        return 1 + (entry if self.which is None else self.which[entry])


def write_dataset(
    root: str | Path,
    models: Sequence[ObjectModel],
    frames: Sequence[PosedFrame],
    labels: Sequence[FrameLabels],
    *,
    split: str = "test",
    replace: bool = False,
    about: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """`write_scenes` of one scene, in which every model stands once.

    Raises:
      OSError: the folder is there already, or cannot be written.
      ValueError: frames and labels are not as many.
    """
    scene = LabelledScene(frames, labels)
    return write_scenes(root, models, [scene], split=split, replace=replace, about=about, progress=progress)


def write_scenes(
    root: str | Path,
    models: Sequence[ObjectModel],
    scenes: Sequence[LabelledScene],
    *,
    split: str = "test",
    replace: bool = False,
    about: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the data set, whole or not at all; objects are numbered from 1 in the order of the models.

    Args:
      root: the folder.
      models: none = there is no folder of models.
      replace: a folder that is there gives way.
      about: what else ``dataset_info.json`` says.

    Raises:
      OSError: the folder is there already, or cannot be written.
    """
    targets, total, done = [], sum(len(scene.frames) for scene in scenes), 0
    with writing_folder(root, replace=replace) as folder:
        if models:
            _write_models(folder, models)
        for number, scene in enumerate(scenes):
            place = folder / split / f"{number:06d}"
            for kind in ("rgb", "depth", "mask", "mask_visib", *scene.beside):
                (place / kind).mkdir(parents=True)
            tell = None if progress is None else lambda now, done=done: progress(done + now, total)
            targets += _write_scene(place, number, scene, tell)
            done += len(scene.frames)
        first = scenes[0].frames[0]
        (width, height), K = first.size, first.camera
        camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": width, "height": height}
        write_text(folder / "camera.json", json.dumps({**camera, "depth_scale": DEPTH_SCALE}, indent=1))
        write_text(folder / "test_targets_bop19.json", json.dumps(targets))
        names = {str(index + 1): model.name for index, model in enumerate(models)}
        frames = [frame.name for scene in scenes for frame in scene.frames]
        told = {"objects": names, "frames": frames, **(about or {})}
        write_text(folder / "dataset_info.json", json.dumps(told, indent=1))
    return Path(root)


def _write_scene(
    place: Path, number: int, scene: LabelledScene, tell: Callable[[int], None] | None
) -> list[dict[str, int]]:
    """One scene's images and documents; returns its targets."""
    cameras, truths, infos, targets = {}, {}, {}, []
    for image, (frame, label) in enumerate(zip(scene.frames, scene.labels, strict=True)):
        _write_images(place, image, frame, label)
        for kind, images in scene.beside.items():
            _write_image(place / kind / f"{image:06d}.png", images[image])
        pose = frame.camera_from_world
        cameras[str(image)] = {
            "cam_K": frame.camera.ravel().tolist(),
            "depth_scale": DEPTH_SCALE,
            "cam_R_w2c": pose.rotation.ravel().tolist(),
            "cam_t_w2c": (1000 * pose.translation).tolist(),
        }
        truths[str(image)] = [
            {
                "cam_R_m2c": pose.rotation.ravel().tolist(),
                "cam_t_m2c": (1000 * pose.translation).tolist(),
                "obj_id": scene.number(entry),
            }
            for entry, pose in enumerate(label.camera_from_model)
        ]
        infos[str(image)] = _describe(frame, label)
        shown = Counter(scene.number(entry) for entry, share in enumerate(label.shares) if share >= VISIBLE)
        targets += [
            {"scene_id": number, "im_id": image, "obj_id": thing, "inst_count": count}
            for thing, count in sorted(shown.items())
        ]
        if tell is not None:
            tell(image + 1)
    for name, document in (("scene_camera", cameras), ("scene_gt", truths), ("scene_gt_info", infos)):
        write_text(place / f"{name}.json", json.dumps(document))
    return targets


def _write_models(folder: Path, models: Sequence[ObjectModel]) -> None:
    infos = {}
    for kind in ("models", "models_eval"):
        (folder / kind).mkdir()
    for index, model in enumerate(models):
        mesh = model.mesh
        low, high = 1000 * mesh.vertices.min(0), 1000 * mesh.vertices.max(0)
        infos[str(index + 1)] = {
            "diameter": 1000 * diameter(mesh),
            **{f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")},
            **{f"size_{axis}": float((high - low)[k]) for k, axis in enumerate("xyz")},
            **model.symmetries.to_bop(),
        }
        for kind in ("models", "models_eval"):
            save_mesh(move(mesh, np.eye(3), scale=1000.0), folder / kind / f"obj_{index + 1:06d}.ply")
    for kind in ("models", "models_eval"):
        write_text(folder / kind / "models_info.json", json.dumps(infos, indent=1))


def _write_images(place: Path, number: int, frame: PosedFrame, label: FrameLabels) -> None:
    depth = np.round(frame.depth.astype(np.float64) * 1000 / DEPTH_SCALE)
    depth = np.where(depth <= 65535, depth, 0).astype(np.uint16)  # what is farther is not known, rather than nearer
    _write_image(place / "rgb" / f"{number:06d}.png", frame.rgb)
    _write_image(place / "depth" / f"{number:06d}.png", depth)
    for index, (whole, visible) in enumerate(zip(label.whole, label.visible, strict=True)):
        _write_image(place / "mask" / f"{number:06d}_{index:06d}.png", whole.astype(np.uint8) * 255)
        _write_image(place / "mask_visib" / f"{number:06d}_{index:06d}.png", visible.astype(np.uint8) * 255)


def _write_image(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    with writing(path) as temporary:
        Image.fromarray(image).save(temporary, compress_level=1)


def _describe(frame: PosedFrame, label: FrameLabels) -> list[dict[str, Any]]:
    entries = []
    for index in range(len(label.visible)):
        entries.append(
            {
                "bbox_obj": list(label.box[index]),
                "bbox_visib": list(label.visible_boxes[index]),
                "px_count_all": int(label.drawn[index]),
                "px_count_valid": int((label.whole[index] & (frame.depth > 0)).sum()),
                "px_count_visib": int(label.visible[index].sum()),
                "visib_fract": float(label.shares[index]),
            }
        )
    return entries


def read_made_of(root: str | Path) -> str | None:
    """What `write_dataset` was told that a data set is made of; None where there is none that it wrote."""
    try:
        document = read_json(Path(root) / "dataset_info.json")
        return str(document["made_of"])
    except (ValueError, KeyError, TypeError):
        return None


def check_dataset(dataset: Path) -> None:
    """Refuse to replace a folder that is no data set of ours, or holds anything else.

    Raises:
      CaptureError: it is there, and somebody's; or it has no name of its own.
    """
    if dataset.name in ("", ".."):  # the folder where one stands cannot be written beside it and put in its place
        raise CaptureError(f"{dataset}: the data set needs a folder of its own; give its name")
    if not dataset.exists():
        return
    if not dataset.is_dir():
        raise CaptureError(f"{dataset}: a file of this name is in the way")
    there = sorted(path.name for path in dataset.iterdir() if path.name[0] != ".")
    if there and read_made_of(dataset) is None:
        raise CaptureError(
            f"{dataset}: it is there, and no data set of ipjax capture; it is not replaced: give another name"
        )
    others = [name for name in there if name not in _MADE]
    if others:
        raise CaptureError(
            f"{dataset}: it would be replaced, but has {others[0]} in it, which ipjax capture did not make; move that "
            "away, or give another name"
        )
