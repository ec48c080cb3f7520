"""BOP data sets on disc: images, cameras, annotations, targets and models.

The format is https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, scene-wise. Files are in
millimetres; everything returned here is in metres. Everything is read when asked for. What cannot be read raises
`DatasetError`: one sentence that names the file.
"""

import math
from collections.abc import Iterable
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.bop.records import MM, DatasetError, Frame, ModelInfo, Target, TargetRow, Truth, check_rotation
from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb, read_size
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import Mesh, move
from ipjax.files.storage.parsing import read_json
from ipjax.metrics.symmetries import SYMMETRY_STEP, discretise_symmetries
from ipjax.transforms import Similarity

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
TARGETS = ("test_targets_bop19.json", "test_targets_bop24.json")
VISIBLE = 0.1  # share of an instance that must be visible for it to be a target (enumerate_test_targets.py)


def parse_images(names: Iterable[str] | None) -> list[tuple[int, int]]:
    """``["3/138"]`` as [(3, 138)]; ValueError names what is wrong."""
    found = []
    for name in names or ():
        scene, slash, image = name.partition("/")
        if not (slash and scene.isdigit() and image.isdigit()):
            raise ValueError(f"{name}: give SCENE/IMAGE, for instance 3/138")
        found.append((int(scene), int(image)))
    return found


class Dataset:
    """A BOP data set on disc.

    Args:
        root: the folder that holds the splits, the models and ``test_targets_bop19.json``.
        split: its folder's name, with the type if there is one ("test", "test_primesense", "val").
        sensor: suffix of the sensor's files where there are several ("photoneo": ``rgb_photoneo``,
            ``scene_camera_photoneo.json``); files without the suffix are the fallback.
        models: another root to take ``models``, ``models_eval`` from.
        targets: name of the file of targets; default: that of 2019 to 2023 (scene, image, object, count), or of 2024
            (scene, image) where there is only this one.

    Raises DatasetError where there is no such folder.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "test",
        *,
        sensor: str = "",
        models: str | Path | None = None,
        targets: str | None = None,
    ):
        self.root = Path(root)
        self.split = split
        self.sensor = sensor
        self.models_root = Path(models) if models is not None else self.root
        listed = [name for name in TARGETS if (self.root / name).is_file()]
        self.targets_file = self.root / (targets or (listed or TARGETS)[0])
        self.name = self.root.name
        if not self.root.is_dir():
            raise DatasetError(f"{self.root}: no such data set folder")
        if not (self.root / split).is_dir():
            there = ", ".join(sorted(p.name for p in self.root.iterdir() if p.is_dir())) or "nothing"
            raise DatasetError(f"{self.root / split}: no such split; the data set has {there}")
        self._json = lru_cache(maxsize=64)(_read_json)
        self._models: dict[str, dict[int, ModelInfo]] = {}

    def __repr__(self) -> str:
        return f"Dataset({str(self.root)!r}, {self.split!r})"

    # Images

    def scenes(self) -> list[int]:
        """Scene numbers of the split."""
        return sorted(int(p.name) for p in (self.root / self.split).iterdir() if p.is_dir() and p.name.isdigit())

    def images(self, scene_id: int) -> list[int]:
        """Image numbers of a scene, those in its camera file."""
        return sorted(self._entries(scene_id, "scene_camera"))

    def camera(self, scene_id: int, im_id: int) -> tuple[np.ndarray, float]:
        """K [3, 3] in pixels and metres per unit of the depth image."""
        entry, where = self._entry(scene_id, im_id, "scene_camera")
        K = _numbers(entry, "cam_K", 9, where).reshape(3, 3)
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            raise DatasetError(f"{where}: the focal lengths of cam_K must be positive, got {K[0, 0]:g} and {K[1, 1]:g}")
        scale = entry.get("depth_scale", 1.0)
        if not isinstance(scale, int | float) or not scale > 0:
            raise DatasetError(f"{where}: depth_scale must be a positive number, got {scale!r}")
        return K, float(scale) * MM

    def truths(self, scene_id: int, im_id: int) -> list[Truth]:
        """The annotated instances of an image, in the order of the file."""
        entry, where = self._entry(scene_id, im_id, "scene_gt", list)
        shares = self._visible(scene_id, im_id)
        found = []
        for index, item in enumerate(entry):
            at = f"{where}, instance {index}"
            if not isinstance(item, dict) or not isinstance(item.get("obj_id"), int):
                raise DatasetError(f"{at}: obj_id is missing or no integer")
            rotation = _numbers(item, "cam_R_m2c", 9, at).reshape(3, 3)
            try:
                check_rotation(rotation)
            except ValueError as error:
                raise DatasetError(f"{at}: cam_R_m2c: {error}") from None
            translation = _numbers(item, "cam_t_m2c", 3, at) * MM
            about = shares[index] if shares is not None and index < len(shares) else (-1.0, None, None)
            found.append(Truth(item["obj_id"], index, rotation, translation, *about))
        return found

    def frame(self, scene_id: int, im_id: int) -> Frame:
        """The colour (or grey) image and the depth image, with their camera."""
        K, scale = self.camera(scene_id, im_id)
        rgb = _checked(read_rgb, self.image_path(scene_id, im_id))
        return Frame(rgb, self.depth(scene_id, im_id, scale), K, scene_id, im_id, f"{scene_id:06d}/{im_id:06d}")

    def depth(self, scene_id: int, im_id: int, scale: float | None = None) -> np.ndarray | None:
        """Depth along z in metres, float32, 0 = unknown; None where the scene has no depth images."""
        if not self.has_depth(scene_id):
            return None
        path = self._find(scene_id, "depth", f"{im_id:06d}")
        if path is None:
            raise DatasetError(f"{self._folder(scene_id, 'depth') / f'{im_id:06d}.png'}: no such depth image")
        if scale is None:
            scale = self.camera(scene_id, im_id)[1]
        depth = _checked(read_depth, path).astype(np.float64) * scale
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)

    def has_depth(self, scene_id: int) -> bool:
        """Whether the scene has a folder of depth images."""
        return self._folder(scene_id, "depth").is_dir()

    def has_silhouettes(self, scene_id: int) -> bool:
        """Whether the scene has a folder of masks of whole silhouettes."""
        return self._folder(scene_id, "mask").is_dir()

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """The file of the colour image, or of the grey one where there is no colour."""
        for kind in ("rgb", "gray"):
            path = self._find(scene_id, kind, f"{im_id:06d}")
            if path is not None:
                return path
        raise DatasetError(f"{self._folder(scene_id, 'rgb') / f'{im_id:06d}.png'}: no such image (rgb or gray)")

    def image_size(self, scene_id: int, im_id: int) -> tuple[int, int]:
        """(width, height) from the image's header, or from ``camera.json`` where the images are not there."""
        try:
            path = self.image_path(scene_id, im_id)
        except DatasetError:
            whole = self.root / "camera.json"
            if not whole.is_file():
                raise
            entry = self._json(whole)
            size = {"size": [entry.get("width"), entry.get("height")]}
            width, height = _numbers(size, "size", 2, str(whole))
            return int(width), int(height)
        return _checked(read_size, path)

    def mask(self, scene_id: int, im_id: int, index: int, *, visible: bool = True) -> np.ndarray:
        """Mask of annotated instance ``index``: what is visible of it, or its whole silhouette."""
        kind = "mask_visib" if visible else "mask"
        path = self._find(scene_id, kind, f"{im_id:06d}_{index:06d}")
        if path is None:
            raise DatasetError(f"{self._folder(scene_id, kind) / f'{im_id:06d}_{index:06d}.png'}: no such mask")
        return _checked(read_mask, path)

    # Targets

    @cached_property
    def targets(self) -> list[TargetRow]:
        """What the benchmark asks for: the file of targets, or, where there is none, every instance of the split that
        is visible to a tenth or more."""
        if not self.targets_file.is_file():
            return self._derived_targets()
        found, seen = [], set()
        for number, row in enumerate(self._target_rows):
            where = f"{self.targets_file}, entry {number}"
            if "obj_id" not in row:
                found += self._visible_targets(row["scene_id"], row["im_id"])
                continue
            target = TargetRow(row["scene_id"], row["im_id"], row["obj_id"], row.get("inst_count", 1))
            key = (target.scene_id, target.im_id, target.obj_id)
            if key in seen:
                raise DatasetError(f"{where}: scene, image and object occur twice: {key}")
            seen.add(key)
            found.append(target)
        return found

    @cached_property
    def target_images(self) -> list[tuple[int, int]]:
        """(scene, image) of every image that the benchmark asks for, also of those that show no target."""
        if not self.targets_file.is_file():
            return sorted(self.targets_by_image())
        return sorted({(row["scene_id"], row["im_id"]) for row in self._target_rows})

    @cached_property
    def names_objects(self) -> bool:
        """Whether a method is told which objects an image shows (6-D localisation), or not (6-D detection)."""
        return not self.targets_file.is_file() or all("obj_id" in row for row in self._target_rows)

    @cached_property
    def _target_rows(self) -> list[dict[str, int]]:
        rows = self._json(self.targets_file)
        if not isinstance(rows, list):
            raise DatasetError(f"{self.targets_file}: a list of targets is expected")
        found = []
        for number, row in enumerate(rows):
            try:
                names = ("scene_id", "im_id", "obj_id", "inst_count")
                needed = names[: 3 if "inst_count" in row else 2]
                kept = {name: int(row[name]) for name in names if name in row or name in needed}
            except (KeyError, TypeError, ValueError):
                raise DatasetError(
                    f"{self.targets_file}, entry {number}: scene_id, im_id and obj_id (in 2024 the first two) must "
                    "be there and be integers"
                ) from None
            found.append(kept)
        return found

    def targets_by_image(self) -> dict[tuple[int, int], list[TargetRow]]:
        """Targets of each (scene, image), in the order of the file."""
        grouped: dict[tuple[int, int], list[TargetRow]] = {}
        for row in self.targets:
            grouped.setdefault((row.scene_id, row.im_id), []).append(row)
        return grouped

    def given_targets(self, scene_id: int, im_id: int, *, masks: bool = True) -> list[Target]:
        """The targets of an image with the annotated visible masks (the most visible instances of each object)."""
        truths = self.truths(scene_id, im_id)
        found = []
        for row in self.targets_by_image().get((scene_id, im_id), []):
            instances = [t for t in truths if t.obj_id == row.obj_id]
            instances.sort(key=lambda t: -t.visible)
            for truth in instances[: row.count]:
                found.append(Target(row.obj_id, self.mask(scene_id, im_id, truth.index) if masks else None))
        return found

    def _derived_targets(self) -> list[TargetRow]:
        return [
            t for scene in self.scenes() for image in self.images(scene) for t in self._visible_targets(scene, image)
        ]

    def _visible_targets(self, scene: int, image: int) -> list[TargetRow]:
        counts: dict[int, int] = {}
        for truth in self.truths(scene, image):
            if truth.visible < 0 or truth.visible >= VISIBLE:
                counts[truth.obj_id] = counts.get(truth.obj_id, 0) + 1
        return [TargetRow(scene, image, obj, count) for obj, count in sorted(counts.items())]

    # Models

    def models(self, kind: str = "models_eval") -> dict[int, ModelInfo]:
        """Diameters and symmetries by object; ``models`` serves where there is no ``models_eval``."""
        folder = self._models_folder(kind)
        if folder.name in self._models:
            return self._models[folder.name]
        path = folder / "models_info.json"
        entries = self._json(path)
        if not isinstance(entries, dict):
            raise DatasetError(f"{path}: a dictionary of objects is expected")
        found = {}
        for key, entry in entries.items():
            where = f"{path}, object {key}"
            if not str(key).isdigit() or not isinstance(entry, dict):
                raise DatasetError(f"{where}: objects are named by numbers and described by dictionaries")
            diameter = entry.get("diameter")
            if not isinstance(diameter, int | float) or not (math.isfinite(diameter) and diameter > 0):
                raise DatasetError(f"{where}: the diameter must be a positive number, got {diameter!r}")
            try:
                rotations, translations = discretise_symmetries(
                    [np.asarray(s, np.float64) for s in entry.get("symmetries_discrete", [])],
                    [(np.asarray(s["axis"]), np.asarray(s["offset"])) for s in entry.get("symmetries_continuous", [])],
                    SYMMETRY_STEP,
                )
            except (KeyError, TypeError, ValueError) as error:
                raise DatasetError(f"{where}: the symmetries cannot be read ({error})") from None
            symmetries = Similarity(rotations, translations * MM, np.ones(len(rotations)))
            found[int(key)] = ModelInfo(int(key), diameter * MM, symmetries)
        self._models[folder.name] = found
        return found

    def model_path(self, obj_id: int, kind: str = "models_eval") -> Path:
        """The PLY file of an object."""
        path = self._models_folder(kind) / f"obj_{obj_id:06d}.ply"
        if not path.is_file():
            raise DatasetError(f"{path}: no such model")
        return path

    def mesh(self, obj_id: int, kind: str = "models_eval") -> Mesh:
        """The model of an object, in metres, in the frame of the annotations."""
        return move(_checked(load_mesh, self.model_path(obj_id, kind)), np.eye(3), scale=MM)

    def _models_folder(self, kind: str) -> Path:
        folder = self.models_root / kind
        if not folder.is_dir() and kind == "models_eval":
            folder = self.models_root / "models"
        if not folder.is_dir():
            raise DatasetError(f"{self.models_root / kind}: no such folder of models")
        return folder

    # Files

    def _folder(self, scene_id: int, kind: str) -> Path:
        scene = self.root / self.split / f"{scene_id:06d}"
        if self.sensor and (scene / f"{kind}_{self.sensor}").is_dir():
            return scene / f"{kind}_{self.sensor}"
        return scene / kind

    def _find(self, scene_id: int, kind: str, stem: str) -> Path | None:
        folder = self._folder(scene_id, kind)
        for extension in IMAGES:
            path = folder / (stem + extension)
            if path.is_file():
                return path
        return None

    def _file(self, scene_id: int, name: str) -> Path:
        scene = self.root / self.split / f"{scene_id:06d}"
        if not scene.is_dir():
            raise DatasetError(f"{scene}: no such scene")
        special = scene / f"{name}_{self.sensor}.json"
        return special if self.sensor and special.is_file() else scene / f"{name}.json"

    def _entries(self, scene_id: int, name: str) -> dict[int, Any]:
        path = self._file(scene_id, name)
        entries = self._json(path)
        if not isinstance(entries, dict) or not all(k.isdigit() for k in entries):
            raise DatasetError(f"{path}: a dictionary with image numbers as keys is expected")
        return {int(k): v for k, v in entries.items()}

    def _entry(self, scene_id: int, im_id: int, name: str, kind: type = dict) -> tuple[Any, str]:
        path = self._file(scene_id, name)
        entry = self._entries(scene_id, name).get(im_id)
        if entry is None:
            raise DatasetError(f"{path}: there is no image {im_id}")
        where = f"{path}, image {im_id}"
        if not isinstance(entry, kind):
            raise DatasetError(f"{where}: a {kind.__name__} is expected")
        return entry, where

    def _visible(self, scene_id: int, im_id: int) -> list[tuple[float, Any, Any]] | None:
        path = self._file(scene_id, "scene_gt_info")
        if not path.is_file():
            return None
        entry, where = self._entry(scene_id, im_id, "scene_gt_info", list)
        try:
            box = lambda item, name: tuple(item[name]) if name in item else None
            return [
                (float(item.get("visib_fract", -1.0)), box(item, "bbox_visib"), box(item, "bbox_obj")) for item in entry
            ]
        except (TypeError, ValueError, AttributeError):
            raise DatasetError(f"{where}: visib_fract must be a number") from None


def _checked(read: Any, path: Path) -> Any:
    """A reader's ValueError as a DatasetError that names the whole path."""
    try:
        return read(path)
    except (ValueError, OSError) as error:
        message = str(error)
        raise DatasetError(message if message.startswith(str(path)) else f"{path}: {message}") from None


def _read_json(path: Path) -> Any:
    try:
        return read_json(path)
    except ValueError as error:
        raise DatasetError(str(error)) from None


def _numbers(entry: dict, key: str, count: int, where: str) -> np.ndarray:
    try:
        values = np.asarray(entry[key], np.float64).reshape(-1)
    except KeyError:
        raise DatasetError(f"{where}: {key} is missing") from None
    except (TypeError, ValueError):
        raise DatasetError(f"{where}: {key} must be {count} numbers") from None
    if values.size != count:
        raise DatasetError(f"{where}: {key} must be {count} numbers, got {values.size}")
    if not np.isfinite(values).all():
        raise DatasetError(f"{where}: {key} holds a number that is not finite")
    return values
