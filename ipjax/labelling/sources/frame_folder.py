"""A folder of frames, as ``ipjax estimate --frames`` has it: rgb/, depth/, a camera file, and masks, if any."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.bop.dataset import VISIBLE
from ipjax.capture.reading.files import CAMERAS, COLOURS, DEPTHS, list_images
from ipjax.detection.crops import read_scene, undistort_mask
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb
from ipjax.files.storage.parsing import read_json
from ipjax.files.weights.hashes import hash_file
from ipjax.labelling.sources.records import FrameKey, SourceError, SourceFrame, hash_plain, number_frames

_CAMERAS = ("scene_camera.json", *CAMERAS)
_MASKS = ("mask", "masks", "mask_visib")


class FrameFolder:
    """Every image of ``rgb/``, with the depth image of the same name.

    Masks are in mask/, masks/ or mask_visib/: NAME.png of one object, or NAME_000000.png, NAME_000001.png … of the
    objects in their order; where there is a scene_gt.json, it says which is of which.

    Args:
        path: the folder.
        numbers: of the objects in scene_gt.json, in their order.
        use_masks: take the masks, where there are any.
        camera: a file or numbers, as `read_camera` takes them; None = the folder's own.
        depth_scale: metres per number of the depth images; None = as the camera's file says.
    """

    kind = "folder of frames"

    def __init__(
        self,
        path: Path,
        numbers: Sequence[int],
        *,
        use_masks: bool = True,
        camera: Any = None,
        depth_scale: float | None = None,
    ):
        self.path, self.numbers, self.depth_scale = path, list(numbers), depth_scale
        self.colours = list_images(path / "rgb", COLOURS)
        if not self.colours:
            raise SourceError(f"{path}: it has no images in rgb/")
        self.depths = list_images(path / "depth", DEPTHS)
        own = next((path / name for name in _CAMERAS if (path / name).is_file()), None)
        if camera is None and own is None:
            raise SourceError(f"{path}: no camera file in it ({', '.join(_CAMERAS)}); give --camera")
        self.camera: Any = camera if camera is not None else own
        truth = path / "scene_gt.json"
        # BOP's mask/ holds whole silhouettes, in which occluders lie over the object: mask_visib/ is the one to use.
        kinds = reversed(_MASKS) if truth.is_file() else _MASKS
        self.masks = next((path / kind for kind in kinds if (path / kind).is_dir()), None) if use_masks else None
        self.truth = read_json(truth) if self.masks is not None and truth.is_file() else None
        about = path / "scene_gt_info.json"
        self.about = read_json(about) if self.truth is not None and about.is_file() else None

    def keys(self) -> list[FrameKey]:
        """In the order of their names."""
        return number_frames(self.colours)

    def read(self, key: FrameKey) -> SourceFrame:
        """One frame from its files, undistorted."""
        path = self.colours[key.name]
        if key.name not in self.depths:
            raise ValueError(f"{path}: there is no depth image of this name in {self.path / 'depth'}")
        rgb, depth = read_rgb(path), read_depth(self.depths[key.name])
        intrinsics = self._camera(key)
        scene = read_scene(rgb, depth, intrinsics, self.depth_scale)
        masks = None
        if self.masks is not None:
            masks = tuple((obj, undistort_mask(read_mask(file), intrinsics)) for obj, file in self._list_masks(key))
        return SourceFrame(scene.rgb, scene.depth, scene.matrix, masks, path.relative_to(self.path).as_posix())

    def identity(self) -> dict[str, Any]:
        """The names and sizes of the images, the camera, and the annotations that are used."""
        files = [*self.colours.values(), *self.depths.values()]
        if self.masks is not None:
            files += sorted(self.masks.iterdir())
        sizes = [(file.relative_to(self.path).as_posix(), file.stat().st_size) for file in files]
        is_file = isinstance(self.camera, str | Path) and Path(self.camera).is_file()
        camera = hash_file(Path(self.camera))[:16] if is_file else str(self.camera)
        about = {"masks": self.masks is not None, "files": hash_plain(sizes), "camera": camera}
        for name, document in (("scene_gt.json", self.truth), ("scene_gt_info.json", self.about)):
            if document is not None:
                about[name] = hash_file(self.path / name)[:16]
        return about | {"depth_scale": self.depth_scale}

    def _camera(self, key: FrameKey) -> Intrinsics:
        return read_camera(self.camera, int(key.name) if key.name.isdecimal() else None)

    def _list_masks(self, key: FrameKey) -> list[tuple[int, Path]]:
        """The place of each mask's object among the objects, and its file."""
        assert self.masks is not None
        plain = self.masks / f"{key.name}.png"
        if plain.is_file():
            return [(0, plain)]
        numbered = {
            int(file.stem[len(key.name) + 1 :]): file
            for file in sorted(self.masks.glob(f"{key.name}_*.png"))
            if file.stem[len(key.name) + 1 :].isdecimal()
        }
        if self.truth is None:
            return [(place, file) for place, file in sorted(numbered.items()) if place < len(self.numbers)]
        try:
            image = str(int(key.name))
            items = [int(item["obj_id"]) for item in self.truth[image]]
            shares = [float(item.get("visib_fract", 1)) for item in self.about[image]] if self.about else [1.0]
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
            raise ValueError(f"{self.path / 'scene_gt.json'}: it has no list of instances of {key.name}") from None
        shares = shares if len(shares) == len(items) else [1.0] * len(items)
        return [
            (self.numbers.index(number), numbered[place])
            for place, number in enumerate(items)
            if number in self.numbers and place in numbered and shares[place] >= VISIBLE
        ]
