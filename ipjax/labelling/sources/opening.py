"""Opening a source of frames, whatever form it has."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.labelling.sources.bop_scenes import BopScenes
from ipjax.labelling.sources.frame_folder import FrameFolder
from ipjax.labelling.sources.image_wise import ImageWise, is_image_wise
from ipjax.labelling.sources.records import Source, SourceError
from ipjax.labelling.sources.ros_bag import RosBag, is_bag
from ipjax.labelling.sources.tar_shards import TarShards


def open_source(
    path: str | Path,
    numbers: Sequence[int],
    *,
    split: str = "test",
    use_masks: bool = True,
    camera: Any = None,
    depth_scale: float | None = None,
) -> Source:
    """Frames on disc, of the form that the folder or file has.

    Args:
        path: a BOP data set, scene-wise (with a folder of the split) or image-wise; tar files of the latter, one or a
            folder of them; a folder of frames with ``rgb/``; a ROS 2 bag.
        numbers: of the objects in the source's annotations, in the order of the objects.
        split: of a BOP data set.
        use_masks: take the source's own masks, where it has any; else the objects are to be sought.
        camera, depth_scale: of a folder of frames, where its files do not say so.

    Raises:
        SourceError: nothing there, or of no form that is known; one sentence.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"{path}: no such folder or file")
    if is_bag(path):
        return RosBag(path)
    if path.is_file() and path.suffix == ".tar":
        return TarShards(path, numbers, use_masks=use_masks)
    if path.is_dir():
        if (path / "rgb").is_dir():
            return FrameFolder(path, numbers, use_masks=use_masks, camera=camera, depth_scale=depth_scale)
        if is_image_wise(path):
            return ImageWise(path, numbers, use_masks=use_masks)
        for folder in (path, path / split):
            if folder.is_dir() and next(folder.glob("*.tar"), None) is not None:
                return TarShards(folder, numbers, use_masks=use_masks)
        if (path / split).is_dir() and is_image_wise(path / split):
            return ImageWise(path / split, numbers, use_masks=use_masks)
        if (path / split).is_dir():
            return BopScenes(path, split, numbers, use_masks=use_masks)
    raise SourceError(
        f"{path}: no frames are recognised: expected are a BOP data set with a folder {split}/ (--split), tar files, "
        "frames KEY.rgb.jpg with KEY.depth.png and KEY.camera.json, a folder with rgb/ and depth/, or a ROS 2 bag"
    )
