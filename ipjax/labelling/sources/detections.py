"""A source whose objects lie in masks that a detector or segmenter found."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.bop.detections import Detection, read_detections
from ipjax.labelling.sources.records import FrameKey, Source, SourceError, SourceFrame


class WithDetections:
    """The frames of a source with other masks: of each object the surest detections in its image.

    Args:
        source: of the frames; its own masks are not used.
        path: of the detections, as `ipjax.bop.detections.read_detections` reads them.
        numbers: of the objects there, in their order.
        most: instances of an object in a frame.

    Raises:
        SourceError: there are no masks in the file.
    """

    def __init__(self, source: Source, path: Path, numbers: Sequence[int], most: int):
        self.source, self.kind, self.path = source, source.kind, source.path
        self.numbers, self.most = list(numbers), most
        self.found: dict[tuple[int, int], list[Detection]] = {}
        for one in read_detections(path):
            if one.segmentation is not None and one.obj_id in self.numbers:
                self.found.setdefault((one.scene_id, one.im_id), []).append(one)
        if not self.found:
            raise SourceError(f"{path}: it has no masks of the objects {', '.join(map(str, self.numbers))}")

    def keys(self) -> Sequence[FrameKey]:
        """Those of the source."""
        return self.source.keys()

    def read(self, key: FrameKey) -> SourceFrame:
        """One frame with the masks that were found in it."""
        frame = self.source.read(key)
        mine = sorted(self.found.get((key.scene, key.image), ()), key=lambda one: -one.score)
        masks = []
        for obj, number in enumerate(self.numbers):
            for one in [one for one in mine if one.obj_id == number][: self.most]:
                mask = one.mask
                if mask is not None:
                    masks.append((obj, mask))
        return SourceFrame(frame.rgb, frame.depth, frame.camera, tuple(masks), frame.file)

    def identity(self) -> dict[str, Any]:
        """That of the source; the file of detections is told beside it."""
        return self.source.identity()
