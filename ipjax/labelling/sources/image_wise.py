"""A folder of frames in BOP's image-wise form."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.files.storage.budget import check_budget
from ipjax.labelling.sources.records import FrameKey, SourceError, SourceFrame, hash_plain
from ipjax.labelling.sources.samples import COLOURS, number_samples, read_sample, split_name


class ImageWise:
    """Every frame of a folder, by its key; see `ipjax.labelling.sources.samples`.

    Args:
        path: the folder.
        numbers: of the objects in the data set, in their order.
        use_masks: take the visible masks, where there are any.
    """

    kind = "BOP data set, image by image"

    def __init__(self, path: Path, numbers: Sequence[int], *, use_masks: bool = True):
        self.path, self.numbers, self.use_masks = path, list(numbers), use_masks
        self.parts: dict[str, dict[str, str]] = {}
        for file in sorted(path.iterdir()):
            known = split_name(file.name)
            if known is not None:
                self.parts.setdefault(known[0], {})[known[1]] = file.name
        if not self.parts:
            raise SourceError(f"{path}: it has no frames KEY.rgb.png, KEY.depth.png, KEY.camera.json")

    def keys(self) -> list[FrameKey]:
        """In the order of their names."""
        return number_samples(self.parts)

    def read(self, key: FrameKey) -> SourceFrame:
        """One frame from its files."""
        where = str(self.path / key.name)
        return read_sample(where, self.parts[key.name], self._load, self.numbers, use_masks=self.use_masks)

    def identity(self) -> dict[str, Any]:
        """The names and sizes of all files."""
        sizes = [(name, (self.path / name).stat().st_size) for some in self.parts.values() for name in some.values()]
        return {"masks": self.use_masks, "files": hash_plain(sizes)}

    def _load(self, name: str) -> bytes:
        path = self.path / name
        check_budget(path.stat().st_size, str(path))
        return path.read_bytes()


def is_image_wise(path: Path) -> bool:
    """Whether a folder has this form."""
    return any(next(path.glob(f"*.{ending}"), None) is not None for ending in COLOURS)
