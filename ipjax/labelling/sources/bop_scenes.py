"""A BOP data set whose scenes are folders."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.bop.dataset import VISIBLE, Dataset
from ipjax.files.weights.hashes import hash_file
from ipjax.labelling.sources.records import FrameKey, SourceError, SourceFrame


class BopScenes:
    """Every image of a split, with the annotated visible masks where the scenes have any.

    Args:
        path: the data set.
        split: of it.
        numbers: of the objects in the data set, in their order.
        use_masks: take the annotated masks.
    """

    kind = "BOP data set, scene by scene"

    def __init__(self, path: Path, split: str, numbers: Sequence[int], *, use_masks: bool = True):
        self.path = path
        self.dataset = Dataset(path, split)
        self.numbers = list(numbers)
        self.scenes = self.dataset.scenes()
        if not self.scenes:
            raise SourceError(f"{path / split}: it has no scenes")
        folder = path / split
        self.has_masks = use_masks and all(
            (folder / f"{scene:06d}" / "mask_visib").is_dir() and (folder / f"{scene:06d}" / "scene_gt.json").is_file()
            for scene in self.scenes
        )

    def keys(self) -> list[FrameKey]:
        """Scene by scene, image by image."""
        return [
            FrameKey(scene, image, f"{scene:06d}/{image:06d}")
            for scene in self.scenes
            for image in self.dataset.images(scene)
        ]

    def read(self, key: FrameKey) -> SourceFrame:
        """One image with its depth and masks."""
        frame = self.dataset.frame(key.scene, key.image)
        if frame.depth is None:
            raise ValueError(f"{self.dataset.image_path(key.scene, key.image)}: there is no depth image beside it")
        masks = None
        if self.has_masks:
            masks = tuple(
                (self.numbers.index(truth.obj_id), self.dataset.mask(key.scene, key.image, truth.index))
                for truth in self.dataset.truths(key.scene, key.image)
                if truth.obj_id in self.numbers and (truth.visible < 0 or truth.visible >= VISIBLE)
            )
        file = self.dataset.image_path(key.scene, key.image).relative_to(self.path).as_posix()
        return SourceFrame(frame.rgb, frame.depth, frame.camera, masks, file)

    def identity(self) -> dict[str, Any]:
        """The cameras and, where masks are used, the annotations of every scene, by their content."""
        names = ["scene_camera.json", *(["scene_gt.json", "scene_gt_info.json"] if self.has_masks else [])]
        folder = self.path / self.dataset.split
        files = {
            f"{scene:06d}/{name}": hash_file(folder / f"{scene:06d}" / name)[:16]
            for scene in self.scenes
            for name in names
            if (folder / f"{scene:06d}" / name).is_file()
        }
        return {"split": self.dataset.split, "masks": self.has_masks, "files": files}
