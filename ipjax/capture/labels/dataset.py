"""A labelled capture as a data set in BOP's layout.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, scene-wise, millimetres::

    camera.json, dataset_info.json, test_targets_bop19.json
    models/obj_000001.ply …, models_info.json        models_eval/ the same
    test/000000/rgb, depth, mask, mask_visib
    test/000000/scene_camera.json, scene_gt.json, scene_gt_info.json
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.bop.dataset import VISIBLE
from ipjax.capture.labels.masks import FrameLabels
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.files.meshes.mesh import diameter, move
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.storage.folders import writing_folder
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text, writing

DEPTH_SCALE = 0.1  # millimetres per number of the depth images: up to 6.5 m


def write_dataset(
    root: str | Path,
    models: Sequence[ObjectModel],
    frames: Sequence[PosedFrame],
    labels: Sequence[FrameLabels],
    *,
    split: str = "test",
    scene: int = 0,
    replace: bool = False,
    about: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the data set, whole or not at all; objects are numbered from 1 in the order of the models.

    Args:
      root: the folder.
      replace: a folder that is there gives way.
      about: what else ``dataset_info.json`` says.

    Raises:
      OSError: the folder is there already, or cannot be written.
      ValueError: frames and labels are not as many.
    """
    if len(frames) != len(labels):
        raise ValueError(f"{len(frames)} frames have {len(labels)} labels")
    with writing_folder(root, replace=replace) as folder:
        _write_models(folder, models)
        place = folder / split / f"{scene:06d}"
        for kind in ("rgb", "depth", "mask", "mask_visib"):
            (place / kind).mkdir(parents=True)
        cameras, truths, infos, targets = {}, {}, {}, []
        for number, (frame, label) in enumerate(zip(frames, labels, strict=True)):
            _write_images(place, number, frame, label)
            pose = frame.camera_from_world
            cameras[str(number)] = {
                "cam_K": frame.camera.ravel().tolist(),
                "depth_scale": DEPTH_SCALE,
                "cam_R_w2c": pose.rotation.ravel().tolist(),
                "cam_t_w2c": (1000 * pose.translation).tolist(),
            }
            truths[str(number)] = [
                {
                    "cam_R_m2c": pose.rotation.ravel().tolist(),
                    "cam_t_m2c": (1000 * pose.translation).tolist(),
                    "obj_id": index + 1,
                }
                for index, pose in enumerate(label.camera_from_model)
            ]
            infos[str(number)] = _describe(frame, label)
            targets += [
                {"scene_id": scene, "im_id": number, "obj_id": index + 1, "inst_count": 1}
                for index, share in enumerate(label.shares)
                if share >= VISIBLE
            ]
            if progress is not None:
                progress(number + 1, len(frames))
        for name, document in (("scene_camera", cameras), ("scene_gt", truths), ("scene_gt_info", infos)):
            write_text(place / f"{name}.json", json.dumps(document))
        width, height = frames[0].size
        K = frames[0].camera
        camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": width, "height": height}
        write_text(folder / "camera.json", json.dumps({**camera, "depth_scale": DEPTH_SCALE}, indent=1))
        write_text(folder / "test_targets_bop19.json", json.dumps(targets))
        names = {str(index + 1): model.name for index, model in enumerate(models)}
        told = {"objects": names, "frames": [frame.name for frame in frames], **(about or {})}
        write_text(folder / "dataset_info.json", json.dumps(told, indent=1))
    return Path(root)


def _write_models(folder: Path, models: Sequence[ObjectModel]) -> None:
    infos = {}
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
            (folder / kind).mkdir(exist_ok=True)
            save_mesh(move(mesh, np.eye(3), scale=1000.0), folder / kind / f"obj_{index + 1:06d}.ply")
    for kind in ("models", "models_eval"):
        write_text(folder / kind / "models_info.json", json.dumps(infos, indent=1))


def _write_images(place: Path, number: int, frame: PosedFrame, label: FrameLabels) -> None:
    depth = np.clip(np.round(frame.depth.astype(np.float64) * 1000 / DEPTH_SCALE), 0, 65535).astype(np.uint16)
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
