"""BOP data sets, detections and result files; and folders of one's own captures.

The format is https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, scene-wise. Files are in
millimetres; everything returned here is in metres, except `ResultRow`, which is a line of a BOP file as it stands.
Everything is read when asked for. What cannot be read raises `DatasetError`: one sentence that names the file.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import as_mask, read_mask
from ipjax.files.images.opening import BYTES_PER_PIXEL, read_rgb, read_size
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import Mesh, move
from ipjax.files.storage.budget import check_budget
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text
from ipjax.metrics import SYMMETRY_STEP, discretise_symmetries

MM = 1e-3  # metres
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
HEADER = "scene_id,im_id,obj_id,score,R,t,time"
SIZED_HEADER = HEADER + ",scale"  # ours: x_camera = scale · R · x_model + t
ROTATION_SLACK = 0.01  # how far the singular values of a rotation may be from 1
VISIBLE = 0.1  # share of an instance that must be visible for it to be a target (enumerate_test_targets.py)


class DatasetError(ValueError):
    """A file of a data set, or of results, is missing or damaged; the message names it and says what is wrong."""


@dataclass(frozen=True)
class Frame:
    """One RGB-D image as its sensor took it."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"] | None  # metres along z, 0 = unknown; None where the data set has none
    camera: Float[np.ndarray, "3 3"]  # K, pixels; the first pixel's centre is at (0, 0)
    scene_id: int = 0
    im_id: int = 0
    name: str = ""


@dataclass(frozen=True)
class Target:
    """One instance to be found in a frame."""

    obj_id: int
    mask: Bool[np.ndarray, "h w"] | None = None  # where to look; None where no mask is given
    score: float = 1.0  # of the detection


@dataclass(frozen=True)
class Estimate:
    """A pose found for an object: x_camera = scale · rotation · x_object + translation, metres."""

    obj_id: int
    score: float
    rotation: np.ndarray  # 3 × 3
    translation_m: np.ndarray  # 3
    scale: float = 1.0  # metres per metre of the model; a BOP row cannot hold it


@dataclass(frozen=True)
class Truth:
    """An annotated instance."""

    obj_id: int
    index: int  # among the image's annotations; names the mask
    rotation: np.ndarray  # 3 × 3, float64
    translation: np.ndarray  # 3, metres, float64
    visible: float = 1.0  # share of the silhouette that is visible (visib_fract); −1 = unknown
    box: tuple[int, int, int, int] | None = None  # visible, x y width height


@dataclass(frozen=True)
class TargetRow:
    """A line of the file of test targets."""

    scene_id: int
    im_id: int
    obj_id: int
    count: int = 1


@dataclass(frozen=True)
class ModelInfo:
    """What models_info.json says about an object, in metres."""

    obj_id: int
    diameter: float
    symmetry_rotations: np.ndarray  # [s, 3, 3]; the first is the identity
    symmetry_translations: np.ndarray  # [s, 3]


@dataclass(frozen=True)
class Detection:
    """A detection or segmentation in BOP's JSON form; the mask is decoded when asked for."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    box: tuple[float, float, float, float] | None
    time: float
    segmentation: dict | None = field(repr=False, default=None)

    @cached_property
    def mask(self) -> np.ndarray | None:
        """The segmentation as bool [h, w]; None where there is only a box."""
        return None if self.segmentation is None else decode_rle(self.segmentation)


@dataclass(frozen=True)
class ResultRow:
    """A line of a BOP result file, in its own units: millimetres and seconds."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    rotation: tuple[float, ...]  # nine numbers, row-major
    translation: tuple[float, ...]  # three numbers, mm
    time: float = -1.0  # for the whole image; −1 = unknown
    line: int | None = field(default=None, compare=False)  # where it was read
    scale: float | None = field(default=None, compare=False)  # estimated over true size; None = unknown


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
        targets: name of the file of targets.

    Raises DatasetError where there is no such folder.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "test",
        *,
        sensor: str = "",
        models: str | Path | None = None,
        targets: str = "test_targets_bop19.json",
    ):
        self.root = Path(root)
        self.split = split
        self.sensor = sensor
        self.models_root = Path(models) if models is not None else self.root
        self.targets_file = self.root / targets
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
            visible, box = shares[index] if shares is not None and index < len(shares) else (-1.0, None)
            found.append(Truth(item["obj_id"], index, rotation, translation, visible, box))
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
        rows = self._json(self.targets_file)
        if not isinstance(rows, list):
            raise DatasetError(f"{self.targets_file}: a list of targets is expected")
        found, seen = [], set()
        for number, row in enumerate(rows):
            try:
                target = TargetRow(
                    int(row["scene_id"]), int(row["im_id"]), int(row["obj_id"]), int(row.get("inst_count", 1))
                )
            except (KeyError, TypeError, ValueError, AttributeError):
                raise DatasetError(
                    f"{self.targets_file}, entry {number}: scene_id, im_id and obj_id must be there and be integers"
                ) from None
            key = (target.scene_id, target.im_id, target.obj_id)
            if key in seen:
                raise DatasetError(f"{self.targets_file}, entry {number}: scene, image and object occur twice: {key}")
            seen.add(key)
            found.append(target)
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
        found = []
        for scene in self.scenes():
            for image in self.images(scene):
                counts: dict[int, int] = {}
                for truth in self.truths(scene, image):
                    if truth.visible < 0 or truth.visible >= VISIBLE:
                        counts[truth.obj_id] = counts.get(truth.obj_id, 0) + 1
                found += [TargetRow(scene, image, obj, count) for obj, count in sorted(counts.items())]
        return found

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
            found[int(key)] = ModelInfo(int(key), diameter * MM, rotations, translations * MM)
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

    def _visible(self, scene_id: int, im_id: int) -> list[tuple[float, tuple[int, int, int, int] | None]] | None:
        path = self._file(scene_id, "scene_gt_info")
        if not path.is_file():
            return None
        entry, where = self._entry(scene_id, im_id, "scene_gt_info", list)
        try:
            return [
                (float(item.get("visib_fract", -1.0)), tuple(item["bbox_visib"]) if "bbox_visib" in item else None)
                for item in entry
            ]
        except (TypeError, ValueError, AttributeError):
            raise DatasetError(f"{where}: visib_fract must be a number") from None


# COCO run-length masks (https://github.com/cocodataset/cocoapi/blob/master/common/maskApi.c describes the text form)


def decode_rle(segmentation: dict) -> np.ndarray:
    """Bool mask [h, w] of a COCO run-length encoding ``{"size": [h, w], "counts": …}``.

    ``counts`` is a list of run lengths, or COCO's compressed text; runs go down the columns and begin with background.
    Raises ValueError where the runs do not fill the image.
    """
    try:
        height, width = (int(x) for x in segmentation["size"])
        counts = segmentation["counts"]
    except (KeyError, TypeError, ValueError):
        raise ValueError("a run-length mask needs size [height, width] and counts") from None
    # No mask is larger than an image may be.
    check_budget(BYTES_PER_PIXEL * max(height, 0) * max(width, 0), f"a run-length mask of {width} × {height} pixels")
    runs = np.asarray(_decompress(counts) if isinstance(counts, str | bytes) else counts)
    if runs.ndim != 1 or (runs.size and runs.dtype.kind not in "ui") or (runs < 0).any():
        raise ValueError("the counts of a run-length mask must be whole numbers, not negative")
    # A single run beyond the mask could make the sum overflow.
    longest = int(runs.max(initial=0))
    covered = longest if longest > max(height * width, 0) else int(runs.sum())
    if height < 1 or width < 1 or covered != height * width:
        raise ValueError(f"the runs of a mask cover {covered} pixels, its size {height} × {width} needs more or less")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(width, height).T


def encode_rle(mask: np.ndarray, *, compressed: bool = True) -> dict:
    """COCO run-length encoding of a mask [h, w]; the inverse of `decode_rle`."""
    mask = as_mask(mask)
    flat = mask.T.reshape(-1)
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    if flat.size and flat[0]:
        runs.insert(0, 0)
    return {"size": list(mask.shape), "counts": _compress(runs) if compressed else runs}


def _decompress(text: str | bytes) -> list[int]:
    """Run lengths from COCO's text: five bits a character, from the third on as differences to the one before last."""
    data = text.encode("ascii", "replace") if isinstance(text, str) else text
    runs: list[int] = []
    at = 0
    while at < len(data):
        value, shift, more = 0, 0, True
        while more:
            if at >= len(data):
                raise ValueError("a compressed mask ends in the middle of a number")
            bits = data[at] - 48
            if not 0 <= bits < 64:
                raise ValueError("a compressed mask holds a character that is none of COCO's")
            value |= (bits & 31) << shift
            more = bool(bits & 32)
            at += 1
            shift += 5
            if not more and bits & 16:
                value |= -1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
    return runs


def _compress(runs: Sequence[int]) -> str:
    text = []
    for index, run in enumerate(runs):
        value = run - (runs[index - 2] if index > 2 else 0)
        more = True
        while more:
            bits = value & 31
            value >>= 5
            more = value != -1 if bits & 16 else value != 0
            text.append(chr((bits | 32 if more else bits) + 48))
    return "".join(text)


def read_detections(path: str | Path) -> list[Detection]:
    """Detections or segmentations in BOP's JSON form (scene_id, image_id, category_id, score, bbox, segmentation)."""
    path = Path(path)
    entries = _read_json(path)
    if not isinstance(entries, list):
        raise DatasetError(f"{path}: a list of detections is expected")
    found = []
    for number, entry in enumerate(entries):
        where = f"{path}, entry {number}"
        try:
            box = entry.get("bbox")
            detection = Detection(
                int(entry["scene_id"]),
                int(entry["image_id"]),
                int(entry["category_id"]),
                float(entry.get("score", 1.0)),
                None if box is None else (float(box[0]), float(box[1]), float(box[2]), float(box[3])),
                float(entry.get("time", -1.0)),
                entry.get("segmentation"),
            )
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise DatasetError(
                f"{where}: a detection needs scene_id, image_id, category_id, score ({error!r})"
            ) from None
        if not math.isfinite(detection.score):
            raise DatasetError(f"{where}: the score is not a finite number")
        found.append(detection)
    return found


def detected_targets(detections: Iterable[Detection], rows: Sequence[TargetRow]) -> list[Target]:
    """For each target row of one image its best detections, as many as it has instances."""
    detections = list(detections)
    found = []
    for row in rows:
        mine = [d for d in detections if (d.scene_id, d.im_id, d.obj_id) == (row.scene_id, row.im_id, row.obj_id)]
        mine.sort(key=lambda d: -d.score)
        found += [Target(d.obj_id, d.mask, d.score) for d in mine[: row.count]]
    return found


# Results


def read_results(path: str | Path, *, problems: list[str] | None = None) -> list[ResultRow]:
    """The rows of a BOP result file.

    A file of ours with the sizes (see `write_results`) has an eighth column, ``scale``.

    Raises DatasetError (file, line, what is wrong) for a wrong header, a wrong number of columns or numbers, values
    that are not finite, an R that is no rotation, rows that occur twice, or times that are negative or differ within
    an image. Give a list as ``problems`` to have such rows left out, and the sentences collected there, instead.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file") from None
    header = lines[0].strip().replace(" ", "") if lines else ""
    if header not in (HEADER, SIZED_HEADER):
        first = lines[0].strip()[:80] if lines else "nothing"
        raise DatasetError(f"{path}, line 1: the header must be {HEADER!r}, not {first!r}")
    rows: list[ResultRow] = []
    first_line: dict[tuple, int] = {}
    times: dict[tuple[int, int], tuple[float, int]] = {}
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip():
            continue
        try:
            row = _parse_row(line, number, header)
            key = (row.scene_id, row.im_id, row.obj_id, row.score, row.rotation, row.translation)
            if key in first_line:
                raise ValueError(f"the row is the same as that of line {first_line[key]}")
            time, at = times.setdefault((row.scene_id, row.im_id), (row.time, number))
            if abs(time - row.time) > 1e-3:
                raise ValueError(
                    f"time is for the whole image: {row.time:g} s here, but {time:g} s in line {at} (same image)"
                )
            first_line[key] = number
        except ValueError as error:
            message = f"{path}, line {number}: {error}"
            if problems is None:
                raise DatasetError(message) from None
            problems.append(message)
        else:
            rows.append(row)
    return rows


def _parse_row(line: str, number: int, header: str = HEADER) -> ResultRow:
    columns = line.strip().split(",")
    expected = header.count(",") + 1
    if len(columns) != expected:
        raise ValueError(f"{expected} columns are expected ({header}), got {len(columns)}")
    whole = []
    for name, text in zip(("scene_id", "im_id", "obj_id"), columns[:3], strict=True):
        if not re.fullmatch(r"\s*\d+\s*", text):
            raise ValueError(f"{name} must be a whole number, got {text!r}")
        whole.append(int(text))
    score = _parse_numbers(columns[3], 1, "score")[0]
    rotation = _parse_numbers(columns[4], 9, "R")
    translation = _parse_numbers(columns[5], 3, "t")
    check_rotation(rotation)
    time = _parse_numbers(columns[6], 1, "time")[0]
    if time < 0 and time != -1:
        raise ValueError(f"time must be seconds, or -1 where it is unknown, got {time:g}")
    scale = _parse_numbers(columns[7], 1, "scale")[0] if expected == 8 else None
    if scale is not None and not scale > 0:
        raise ValueError(f"scale must be positive, got {scale:g}")
    return ResultRow(whole[0], whole[1], whole[2], score, rotation, translation, time, number, scale)


def check_rotation(rotation: Sequence[float] | np.ndarray) -> None:
    """Nothing where nine numbers are a rotation, row by row, up to rounding (official result files have determinants
    within 0.003 of 1). Raises ValueError, in words, for what scales, mirrors or shears.
    """
    matrix = np.asarray(rotation, np.float64).reshape(3, 3)
    stretch, det = np.linalg.svd(matrix, compute_uv=False), float(np.linalg.det(matrix))
    if np.abs(stretch - 1).max() <= ROTATION_SLACK and det > 0:
        return
    if np.ptp(stretch) <= ROTATION_SLACK * max(stretch.max(), 1) and stretch.mean() > ROTATION_SLACK:
        way = f"it scales by {stretch.mean():.4g}" if det > 0 else "it mirrors"
    else:
        way = "its rows are not at right angles and of length 1"
    raise ValueError(f"R is no rotation: {way} (det R = {det:.4g}, where 1 is expected)")


def _parse_numbers(text: str, count: int, name: str) -> tuple[float, ...]:
    parts = text.split()
    if len(parts) != count:
        raise ValueError(f"{name} must hold {count} number{'s' if count > 1 else ''}, got {len(parts)}")
    try:
        numbers = tuple(float(part) for part in parts if "_" not in part)
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise ValueError(f"{name} holds something that is no number: {text.strip()[:60]!r}")
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} holds a number that is not finite: {text.strip()[:60]!r}")
    return numbers


def format_row(row: ResultRow) -> str:
    """One line of a result file, without its end; numbers are written so that reading them gives them back."""
    if len(row.rotation) != 9 or len(row.translation) != 3:
        raise ValueError(f"a row needs 9 and 3 numbers, got {len(row.rotation)} and {len(row.translation)}")
    numbers = (row.score, *row.rotation, *row.translation, row.time)
    if not all(math.isfinite(x) for x in numbers):
        raise ValueError(f"a result of scene {row.scene_id}, image {row.im_id}, object {row.obj_id} is not finite")
    R = " ".join(repr(float(x)) for x in row.rotation)
    t = " ".join(repr(float(x)) for x in row.translation)
    time = "-1" if row.time == -1 else repr(float(row.time))
    return f"{row.scene_id},{row.im_id},{row.obj_id},{float(row.score)!r},{R},{t},{time}"


def write_results(path: str | Path, rows: Iterable[ResultRow], *, scales: Sequence[float] | None = None) -> Path:
    """Write a result file as BOP's toolkit does (no newline at the end), whole or not at all.

    With ``scales`` (estimated over true size, one for each row) it is no BOP file but one of ours, with a column more;
    `sized_path` says where it belongs. Raises ValueError for a scale that is not positive and finite.
    """
    if scales is None:
        return write_text(path, "\n".join([HEADER, *map(format_row, rows)]), parents=True)
    lines = [SIZED_HEADER]
    for row, scale in zip(rows, scales, strict=True):
        if not 0 < scale < math.inf:
            raise ValueError(f"scene {row.scene_id}, image {row.im_id}, object {row.obj_id}: its scale is {scale}")
        lines.append(f"{format_row(row)},{float(scale)!r}")
    return write_text(path, "\n".join(lines), parents=True)


def sized_path(path: str | Path) -> Path:
    """Where the sizes of a BOP result file are kept: beside it, as ``.sized``, which nobody takes for a BOP file."""
    return Path(path).with_suffix(".sized")


def as_row(scene_id: int, im_id: int, estimate: Estimate, time: float = -1.0) -> ResultRow:
    """An estimate as a row: metres become millimetres. A BOP row has no place for the scale."""
    rotation = np.asarray(estimate.rotation, np.float64).reshape(9)
    translation = np.asarray(estimate.translation_m, np.float64).reshape(3) * 1000
    return ResultRow(
        scene_id, im_id, estimate.obj_id, float(estimate.score), tuple(rotation), tuple(translation), float(time)
    )


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
